// The page: what was chosen goes to the worker, and what comes back is drawn.

import { CAUSES, Track } from "./track.js";
import { GroundMap, seenPart } from "./map.js";
import { CameraView } from "./camera.js";

const $ = id => document.getElementById(id);
const SAMPLE = { video: "sample/drive.mp4", camera: "sample/camera.yaml", rig: "sample/rig.toml" };

/// The map of the page of a live run, which fetches its tiles from a server. Here the worker sends
/// them.
class LocalMap extends GroundMap {
  put(metresPerPixel, tiles, all) {
    const current = this.layers.at(-1);
    const layer = all || current?.metresPerPixel !== metresPerPixel ? { metresPerPixel, tiles: new Map(), wanted: new Map() } : current;
    for (const tile of tiles) layer.tiles.set(`${tile.column}/${tile.row}`, { ...tile, seen: seenPart(tile.image) });
    this.layers = [layer];
    this.fit();
    document.body.dataset.tiles = this.tileCount;
  }

  clear() { this.layers = []; this.setFollow(true); this.drawn = null; this.at = -1; this.changed = true; }
}

let track = new Track(), module = null, worker = null, camera = null, chosen = null;
const map = new LocalMap($("map"), track);

// ---- start

$("unserved").remove();

const phase = name => { document.body.dataset.phase = name; };
const say = (text, tone = "wait") => { const state = $("state"); if (state.textContent !== text) state.textContent = text; state.dataset.tone = tone; };
function warn(text) { $("message").hidden = !text; $("message").textContent = text || ""; }

async function fetched(name) {
  const answer = await fetch(name).catch(() => null);
  if (!answer?.ok) throw new Error(`${name} is not beside this page: docs/try/build.sh makes it, and a web server must serve it.`);
  return answer;
}

async function load() {
  try {
    if (!("WebAssembly" in globalThis) || !("OffscreenCanvas" in globalThis)) throw new Error("This browser is too old for this page: it has no WebAssembly or no OffscreenCanvas.");
    module = await WebAssembly.compile(await (await fetched("odograph.wasm")).arrayBuffer());
    say("ready");
    phase("setup");
    document.body.dataset.ready = "yes";
  } catch (error) {
    say("cannot start", "bad");
    warn(error instanceof WebAssembly.CompileError ? "This browser is too old for this page: it has no 128-bit vectors of WebAssembly." : error.message);
    $("sample").disabled = $("start").disabled = true;
  }
}

/// A worker made of a text is bound by the page's policy, too: it connects to nothing else.
function makeWorker() {
  const text = `import ${JSON.stringify(new URL("worker.js", location.href).href)};`;
  const address = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
  const made = new Worker(address, { type: "module" });
  made.onmessage = event => told[event.data.kind](event.data);
  made.onerror = () => failed("The page could not start its worker; a current Chromium, Firefox or Safari can.");
  return made;
}

function begin(title, file, settings) {
  warn("");
  endWorker();
  track = map.track = new Track();
  map.clear();
  lostFrames = 0; distances = { count: 0, sum: 0 }; last = -1;
  chosen = { file, settings };
  $("title").textContent = title;
  for (const id of ["setup", "files", "again", "outcome", "downloads"]) $(id).hidden = true;
  for (const id of ["stop", "eye", "pose"]) $(id).hidden = false;
  $("stop").disabled = false;
  for (const id of ["took", "took99"]) $(id).textContent = "–";
  $("follow").setAttribute("aria-pressed", "true");
  phase("running");
  say("opening the video");
  worker = makeWorker();
  worker.postMessage({ kind: "start", module, file, settings });
  $("stop").focus();
}

function endWorker() {
  player?.pause();
  worker?.terminate();
  worker = null;
}

async function beginSample() {
  try {
    $("sample").disabled = true;
    const [video, camera, rig] = await Promise.all(Object.values(SAMPLE).map(fetched));
    begin("Sample drive", await video.blob(), { camera_file: await camera.text(), rig_file: await rig.text() });
  } catch (error) {
    warn(error.message);
  } finally {
    $("sample").disabled = false;
  }
}

async function beginOwn() {
  const file = $("video").files[0], byFile = byCameraFile(), height = $("height").value, rig = $("rig").files[0];
  const missing = [
    [!file, "video", "Choose a video."],
    [byFile && !$("camera-file").files[0], "camera-file", "Choose a camera file, or give the ground in view."],
    [!byFile && !$("view").value.trim(), "view", "Give the ground in view, such as 1.20x0.90, or choose a camera file."],
    [byFile && !rig && !height.trim(), "height", "Give the height of the camera above the ground, such as 75cm."],
  ].find(([is]) => is);
  for (const id of ["view", "height"]) $(id).removeAttribute("aria-invalid");
  if (missing) {
    warn(missing[2]);
    $(missing[1]).setAttribute("aria-invalid", "true");
    return $(missing[1]).focus();
  }
  const text = async file => file ? await file.text() : "";
  begin(file.name, file, {
    camera_file: byFile ? await text($("camera-file").files[0]) : "",
    field_of_view: byFile ? "" : $("view").value,
    height,
    rig_file: await text(rig),
  });
}

const byCameraFile = () => document.querySelector("input[name=camera]:checked").value === "file";

/// Shows the form again, with what was chosen in it.
function setup() {
  endWorker();
  for (const id of ["stop", "files", "again", "eye", "pose", "outcome", "downloads", "progress"]) $(id).hidden = true;
  $("setup").hidden = false;
  $("title").textContent = "odograph";
  phase("setup");
  say("ready");
  map.clear();
  map.track = track = new Track();
  $("sample").focus();
}

// ---- what the worker says

const told = {
  begun({ width, height, count }) {
    camera = new CameraView($("camera"), width, height);
    $("of").textContent = count ? `of ${count}` : "";
    $("progress").hidden = !count;
    $("progress").max = count || 1;
    $("progress").value = 0;
  },
  again({ found }) {
    warn(found ? `In this drive, ${found}. The video is tracked again with that.` : "The video is tracked again.");
    track = map.track = new Track();
    map.clear();
    lostFrames = 0; distances = { count: 0, sum: 0 }; last = -1;
  },
  frames({ first, values, median, high }) {
    track.add(first, values);
    $("took").textContent = median.toFixed(1);
    $("took99").textContent = high.toFixed(1);
    $("progress").value = track.count;
    document.body.dataset.records = track.count;
    document.body.dataset.median = median.toFixed(2);
  },
  picture({ bitmap, tracks }) { camera.paint(bitmap, tracks); bitmap.close(); },
  ground({ metresPerPixel, tiles, all }) { map.put(metresPerPixel, tiles, all); },
  finishing() { say("closing loops", "warn"); $("stop").disabled = true; },
  finished({ summary, values, files, message }) {
    track = map.track = new Track();
    track.add(0, values);
    map.drawn = null;
    lostFrames = 0; distances = { count: 0, sum: 0 }; last = -1;
    show(summary);
    offer(files);
    warn(message);
    for (const id of ["stop", "progress"]) $(id).hidden = true;
    for (const id of ["files", "again", "outcome"]) $(id).hidden = false;
    phase("finished");
    map.showAll();
    $("files").focus();
  },
  failed({ message }) { failed(message); },
  // Not a format that WebCodecs can be given: the browser's player may be able to.
  player() { play(); },
  play() { player.currentTime = 0; player.play().catch(error => unplayable(error)); },
  pause() { player.pause(); },
  next() { unanswered--; },
};

function failed(message) {
  setup();
  warn(message);
  say("failed", "bad");
  document.body.dataset.failed = "yes";
}

function show({ frames, tracked, keyframes, loops, distance_m: distance, correction_m: correction, found }) {
  const length = metres => metres < .01 ? `${(1000 * metres).toFixed(1)} mm` : metres < 1 ? `${(100 * metres).toFixed(1)} cm` : `${metres.toFixed(2)} m`;
  const lines = [
    `${length(distance)} of path, ${tracked === frames ? `all ${frames} frames` : `${tracked} of ${frames} frames`} with a pose, ${keyframes} keyframes`,
    loops ? `ground recognised ${loops === 1 ? "once" : `${loops} times`}; the path moved by up to ${length(correction)}` : "no ground recognised again: the path is as it was tracked",
  ];
  if (found) lines.push(found[0].toUpperCase() + found.slice(1));
  $("outcome").querySelector("ul").replaceChildren(...lines.map(line => Object.assign(document.createElement("li"), { textContent: line })));
  document.body.dataset.distance = distance;
  document.body.dataset.loops = loops;
}

let offered = [];
function offer(files) {
  offered.forEach(URL.revokeObjectURL);
  const size = bytes => bytes > 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${Math.ceil(bytes / 1e3)} kB`;
  $("downloads").querySelector("ul").replaceChildren(...files.map(({ name, blob }) => {
    const item = document.createElement("li"), link = document.createElement("a"), small = document.createElement("small");
    link.href = URL.createObjectURL(blob); link.download = name; link.textContent = name;
    small.textContent = ` ${size(blob.size)}`;
    item.append(link, small);
    return item;
  }));
  offered = [...$("downloads").querySelectorAll("a")].map(link => link.href);
}

// ---- the browser's player, for what WebCodecs is not given

let player = null, unanswered = 0;

function unplayable() {
  const mime = player?.error?.message ? ` (${player.error.message})` : "";
  failed(`This browser cannot play the video${mime}. MP4 with H.264 is played by all; ffmpeg -i VIDEO -c:v libx264 OUT.mp4 makes it.`);
}

function play() {
  player = document.createElement("video");
  Object.assign(player, { muted: true, playsInline: true, preload: "auto", src: URL.createObjectURL(chosen.file) });
  if (!player.requestVideoFrameCallback || !("VideoFrame" in globalThis)) return failed("This browser gives a page no single frames of a video; a current Chromium, Firefox or Safari does.");
  let presented = 0;
  const mine = worker;
  const came = (_, { mediaTime, presentedFrames }) => {
    if (worker !== mine) return;
    // A frame of every moment is wanted: where some were passed over, the player goes slower.
    if (presented && presentedFrames > presented + 1 || unanswered > 2) player.playbackRate = Math.max(.25, .8 * player.playbackRate);
    presented = presentedFrames;
    const frame = new VideoFrame(player, { timestamp: Math.round(1e6 * mediaTime) });
    unanswered++;
    worker.postMessage({ kind: "played", frame, time: mediaTime }, [frame]);
    player.requestVideoFrameCallback(came);
  };
  player.onloadedmetadata = () => {
    unanswered = 0;
    worker?.postMessage({ kind: "start", module, ...chosen, player: { width: player.videoWidth, height: player.videoHeight } });
    player.requestVideoFrameCallback(came);
  };
  player.onended = () => worker?.postMessage({ kind: "played", ended: true });
  player.onerror = unplayable;
}

// ---- figures

let lostFrames = 0, distances = { count: 0, sum: 0 }, last = -1;

/// Adds up the path and the lost frames of what has come since the last call.
function addUp() {
  for (let k = distances.count; k < track.count; k++) {
    if (track.get(k, "state") > 0) lostFrames++;
    const step = k && track.get(k, "segment") === track.get(k - 1, "segment") ? Math.hypot(track.get(k, "x") - track.get(k - 1, "x"), track.get(k, "y") - track.get(k - 1, "y")) : 0;
    if (Number.isFinite(step)) distances.sum += step;
  }
  distances.count = track.count;
}

function showFigures(at) {
  addUp();
  const known = Number.isFinite(track.get(at, "x")), set = (id, text) => { $(id).textContent = known ? text : "–"; $(id).parentElement.classList.toggle("unknown", !known); };
  const rounded = (value, digits) => (+value.toFixed(digits) || 0).toFixed(digits), degrees = track.get(at, "heading") * 180 / Math.PI;
  set("heading", `${rounded(((degrees + 180) % 360 + 360) % 360 - 180, 1)}°`);
  set("x", rounded(track.get(at, "x"), 3));
  set("y", rounded(track.get(at, "y"), 3));
  set("speed", track.get(at, "speed").toFixed(2));
  const sigma = 1000 * Math.sqrt(Math.max(track.get(at, "varX"), track.get(at, "varY")));
  set("sigma", sigma < 1000 ? sigma.toFixed(1) : (sigma / 1000).toFixed(2));
  $("sigma-unit").textContent = sigma >= 1000 ? "m" : "mm";
  $("distance").textContent = distances.sum.toFixed(2);
  $("count").textContent = track.count;
  $("lost").textContent = lostFrames;
  const tenths = Math.round(10 * track.get(at, "t"));
  $("moment").textContent = `${Math.floor(tenths / 600)}:${(tenths % 600 / 10).toFixed(1).padStart(4, "0")}`;
  if ($("stop").disabled && document.body.dataset.phase === "running") return;
  const cause = CAUSES[track.get(at, "state")];
  if (document.body.dataset.phase === "finished") say("finished", "good");
  else cause ? say(`lost: ${cause}`, "bad") : say("tracked", "good");
}

// While the worker is at work, the map is drawn only this often, milliseconds: both want the processor.
const DRAWN_EVERY = 60;
let drawnAt = 0;
function frame(now) {
  requestAnimationFrame(frame);
  if (document.body.dataset.phase === "running" && now < drawnAt + DRAWN_EVERY) return;
  drawnAt = now;
  if (track.count) {
    const at = track.count - 1;
    map.show(at);
    if (at !== last) { last = at; showFigures(at); }
  }
  map.draw();
}

// ---- controls

const setFollow = follow => { map.setFollow(follow); $("follow").setAttribute("aria-pressed", follow); };
map.onUnfollow = () => $("follow").setAttribute("aria-pressed", "false");

$("sample").onclick = beginSample;
$("setup").onsubmit = event => { event.preventDefault(); beginOwn(); };
$("stop").onclick = () => { $("stop").disabled = true; say("stopping", "warn"); player?.pause(); worker?.postMessage({ kind: "stop" }); };
$("again").onclick = setup;
$("files").onclick = () => { $("downloads").hidden = !$("downloads").hidden; $("files").setAttribute("aria-expanded", !$("downloads").hidden); };
$("closer").onclick = () => map.zoom(1.5);
$("farther").onclick = () => map.zoom(1 / 1.5);
$("whole").onclick = () => map.showAll();
$("follow").onclick = () => setFollow(!map.follow);
for (const radio of document.querySelectorAll("input[name=camera]")) radio.onchange = () => { $("by-file").hidden = !byCameraFile(); $("by-view").hidden = byCameraFile(); };
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { map.drawn = null; map.changed = true; });

addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || document.body.dataset.phase === "setup" || event.target.matches?.("input")) return;
  const act = { f: () => setFollow(!map.follow), 0: () => map.showAll(), "+": () => map.zoom(1.3), "=": () => map.zoom(1.3), "-": () => map.zoom(1 / 1.3) }[event.key.toLowerCase()];
  if (!act) return;
  event.preventDefault();
  act();
});

// Dropped files go where they belong by their names.
const into = (id, file) => { const list = new DataTransfer(); list.items.add(file); $(id).files = list.files; };
addEventListener("dragover", event => { event.preventDefault(); if (document.body.dataset.phase === "setup") document.body.classList.add("dropping"); });
addEventListener("dragleave", event => { if (!event.relatedTarget) document.body.classList.remove("dropping"); });
addEventListener("drop", event => {
  event.preventDefault();
  document.body.classList.remove("dropping");
  if (document.body.dataset.phase === "finished") setup();
  if (document.body.dataset.phase !== "setup") return;
  for (const file of event.dataTransfer.files) {
    if (/\.toml$/i.test(file.name)) { into("rig", file); document.querySelector("details").open = true; }
    else if (/\.(ya?ml|json|txt)$/i.test(file.name)) { document.querySelector("input[value=file]").click(); into("camera-file", file); }
    else into("video", file);
  }
  const wanted = [["video", !$("video").files[0]], ["camera-file", byCameraFile() && !$("camera-file").files[0]], ["height", !$("height").value && !$("rig").files[0]]].find(([, is]) => is);
  $(wanted ? wanted[0] : "start").focus();
});

load();
requestAnimationFrame(frame);
