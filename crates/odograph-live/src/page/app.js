// Connects the socket, the controls and the views. All drawing is limited to once per display
// frame.

import { CAUSES, Track } from "./track.js";
import { GroundMap } from "./map.js";
import { CameraView } from "./camera.js";
import { Plots } from "./plots.js";
import { Calibration } from "./calibration.js";

const $ = id => document.getElementById(id);
const track = new Track();
const map = new GroundMap($("map"), track);
let camera = null, plots = null, calibration = null, introduction = null;
let status = { phase: "running" };
let live = true, playing = null, at = -1, ended = false, connected = false, gone = false;

// ---- socket

let pause = 500;
function connect() {
  const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { pause = 500; connected = true; showControls(); };
  socket.onmessage = event => typeof event.data === "string" ? told(JSON.parse(event.data)) : came(event.data);
  socket.onclose = () => {
    connected = false;
    // After the end of the run the program ends too, and nothing can be had from it any more.
    if (introduction && ended) { gone = true; leave(); }
    showState();
    showControls();
    if (gone) return;
    setTimeout(connect, pause);
    pause = Math.min(2 * pause, 8000);
  };
}

function came(bytes) {
  const kind = new Uint8Array(bytes, 0, 1)[0];
  if (kind === 1) {
    track.add(new DataView(bytes).getUint32(4, true), new Float32Array(bytes, 8));
    $("time").max = Math.max(0, track.count - 1);
    document.body.dataset.records = track.count;
  } else if (kind === 2 && live && camera) camera.show(bytes);
}

function told(message) {
  if (message.kind === "hello") greet(message.introduction);
  else if (message.kind === "status") { status = message.status; showStatus(); }
  else if (message.kind === "marks") { map.marks.splice(message.first, message.marks.length, ...message.marks); map.changed = true; document.body.dataset.marks = map.marks.length; }
  else if (message.kind === "replaced") { track.clear(); distances.count = 0; last = -1; map.drawn = null; document.body.dataset.replaced = 1; }
  else if (message.kind === "elevations") showElevations(message.elevations);
  else if (message.kind === "markers") { offer("markers"); map.setMarkers(message.markers); document.body.dataset.markers = message.markers.length; }
  else if (message.kind === "mask") { offer("mask"); camera?.setMask(message.mask); document.body.dataset.mask = message.mask.cells.split("1").length - 1; }
  else if (message.kind === "calibration") { calibration?.show(message.calibration); showState(); }
  else if (message.kind === "map") {
    map.setGraph(message.map);
    if (message.map.corrections) { track.correct(message.map.corrections); distances.count = 0; last = -1; }
    else plots.drop("inliers");
  }
  else if (message.kind === "ground") map.groundChanged(message.metres_per_pixel, message.tiles);
}

function greet(hello) {
  const again = introduction;
  introduction = hello;
  // After a reconnect all marks and tiles are sent again.
  map.marks = [];
  document.title = `${hello.title} – odograph`;
  $("title").textContent = hello.title;
  $("title").title = hello.source;
  document.body.classList.toggle("finished", !hello.live);
  $("recovered").hidden = !hello.recovered;
  if (again) return;
  if (hello.live) camera = new CameraView($("camera"), hello.width, hello.height);
  if (hello.calibration) {
    calibration = new Calibration(camera);
    document.body.classList.add("calibrating");
    $("board").hidden = false;
    $("stop").title = "Calibrate with what was seen so far";
    $("ask-what").textContent = "The camera is calibrated with what was seen so far.";
    $("camera").setAttribute("aria-label", "The camera's picture: the board's points, and which parts of the picture have seen it");
    return;
  }
  plots = new Plots($("plots"), track, hello.live, seek);
  if (!hello.live) {
    live = false;
    map.setFollow(false);
    // Fits the view to the whole run as soon as it has been received.
    const fit = setInterval(() => { if (track.count && track.count >= (status.captured || 1)) { clearInterval(fit); map.showAll(); if (!playing) seek(0); } }, 60);
  }
}

// ---- status messages

function showStatus() {
  ended = ["saved", "failed"].includes(status.phase);
  $("message").hidden = !status.message;
  $("message").textContent = status.message || "";
  showControls();
  $("fps").textContent = status.fps.toFixed(0);
  $("dropped").textContent = status.dropped;
  $("latency").textContent = status.latency_median_ms.toFixed(1);
  $("latency99").textContent = status.latency_p99_ms.toFixed(1);
  document.body.dataset.phase = status.phase;
  if (ended && introduction?.live) { showFiles(true); if (live) { leaveLive(); showPlaying(); } }
  else if (ended) showReport();
  showState();
}

/// What cannot be done is off: after the end nothing is marked, and without the program nothing is
/// had from it.
function showControls() {
  const over = !connected || status.phase === "saving" || ended;
  $("stop").disabled = $("mark").disabled = over;
  $("files").disabled = gone;
  $("live").disabled = ended;
  if (over) { $("naming").hidden = true; $("ask").close(); }
}

/// Takes away what led to the program that has ended.
function leave() {
  $("downloads").hidden = $("report").hidden = true;
  $("files").setAttribute("aria-expanded", false);
  document.body.dataset.gone = 1;
}

function showState() {
  const state = $("state");
  const say = (text, tone) => { if (state.textContent !== text) state.textContent = text; state.dataset.tone = tone; };
  if (gone) return say(status.phase === "failed" ? "ended with an error; program ended" : introduction.live ? "saved; program ended" : "program ended", status.phase === "failed" ? "bad" : "wait");
  if (!connected && !ended) return say(introduction ? "no connection" : "connecting", "wait");
  if (introduction && !introduction.live) return lost(at) ? say(`lost: ${lost(at)}`, "bad") : say("tracked", "good");
  if (status.phase === "saving") return say("writing the results", "warn");
  if (status.phase === "saved") return say("saved", "good");
  if (status.phase === "failed") return say("ended with an error", "bad");
  if (status.phase === "waiting") return say("waiting for the camera", "warn");
  if (calibration) return say(...calibration.state());
  if (!track.count) return say("waiting for frames", "wait");
  lost(at) ? say(`lost: ${lost(at)}`, "bad") : say(status.recording ? "tracked, recording" : "tracked, not recording", status.recording ? "good" : "warn");
}

// A map of an older program does not say why frames are missing.
const lost = k => k >= 0 && k < track.count ? CAUSES[track.get(k, "state")] || (Number.isFinite(track.get(k, "x")) ? "" : "no frame has a pose here") : "";

let distances = { count: 0, sums: new Float32Array(4096) };
function distance(k) {
  if (distances.sums.length < track.count) { const larger = new Float32Array(2 * track.count); larger.set(distances.sums); distances.sums = larger; }
  for (let i = distances.count; i < track.count; i++) {
    const step = i && track.get(i, "segment") === track.get(i - 1, "segment") ? Math.hypot(track.get(i, "x") - track.get(i - 1, "x"), track.get(i, "y") - track.get(i - 1, "y")) : 0;
    distances.sums[i] = (i ? distances.sums[i - 1] : 0) + (Number.isFinite(step) ? step : 0);
  }
  distances.count = track.count;
  return distances.sums[k] || 0;
}

function showFigures() {
  const known = Number.isFinite(track.get(at, "x"));
  const set = (id, text) => { $(id).textContent = known ? text : "–"; $(id).parentElement.classList.toggle("unknown", !known); };
  const degrees = track.get(at, "heading") * 180 / Math.PI;
  set("speed", track.get(at, "speed").toFixed(2));
  // Avoids a displayed -0.000.
  const rounded = (value, digits) => (+value.toFixed(digits) || 0).toFixed(digits);
  set("heading", `${rounded(((degrees + 180) % 360 + 360) % 360 - 180, 1)}°`);
  set("x", rounded(track.get(at, "x"), 3));
  set("y", rounded(track.get(at, "y"), 3));
  const sigma = 1000 * Math.sqrt(Math.max(track.get(at, "varX"), track.get(at, "varY")));
  // The first pose of a run is its origin; what is only small is not shown as zero.
  const small = sigma === 0 ? "0" : sigma.toPrecision(1);
  set("sigma", sigma < .05 ? small : sigma < 1000 ? sigma.toFixed(1) : (sigma / 1000).toFixed(2));
  $("sigma-unit").textContent = sigma < 1000 ? "mm" : "m";
  $("distance").textContent = distance(at).toFixed(2);
  const clock = t => { const tenths = Math.round(10 * t); return `${Math.floor(tenths / 600)}:${(tenths % 600 / 10).toFixed(1).padStart(4, "0")}`; };
  const text = `${clock(track.get(at, "t"))} / ${clock(track.get(track.count - 1, "t"))}`;
  $("clock").textContent = text;
  $("time").value = at;
  $("time").setAttribute("aria-valuetext", text);
  document.body.dataset.at = at;
}

// ---- time

function seek(k) { leaveLive(); at = Math.max(0, Math.min(k, track.count - 1)); playing = null; showPlaying(); }
function leaveLive() { live = false; $("live").setAttribute("aria-pressed", "false"); }
function goLive() { if (ended) return; live = true; playing = null; $("live").setAttribute("aria-pressed", "true"); showPlaying(); }
function showPlaying() {
  const running = playing || live;
  $("play").textContent = running ? "❚❚" : "▶";
  $("play").setAttribute("aria-label", running ? "Pause" : "Play");
}
function togglePlay() {
  if (live) leaveLive();
  else if (playing) playing = null;
  else if (track.count) {
    if (at >= track.count - 1) at = 0;
    playing = { since: performance.now(), from: track.get(at, "t") };
  }
  showPlaying();
}

let plotted = 0, last = -1, counted = 0;
function frame(now) {
  if (track.count) {
    if (live) at = track.count - 1;
    else if (playing) {
      at = track.at(playing.from + (now - playing.since) / 1000);
      if (at >= track.count - 1) { playing = null; showPlaying(); }
    }
    at = Math.max(0, Math.min(at, track.count - 1));
    map.show(at);
    // While it is paused the run goes on, and with it the time of its newest frame.
    if (at !== last || live || track.count !== counted) { last = at; counted = track.count; showFigures(); showState(); }
    if (plots && now - plotted > 150) {
      plotted = now;
      const end = track.get(track.count - 1, "t");
      plots.draw(introduction.live ? Math.max(0, (live ? end : Math.min(end, track.get(at, "t") + 60)) - 120) : 0,
        introduction.live && !live ? Math.min(end, track.get(at, "t") + 60) || 1 : end || 1, at);
    }
  }
  map.draw();
  requestAnimationFrame(frame);
}

// ---- controls

const list = async () => {
  const told = await fetch("/files").then(answer => answer.json()).catch(() => ({ files: [], zip: null, report: false }));
  $("zip").hidden = !told.zip;
  $("report").hidden = !told.report;
  return told;
};
const showReport = () => { if (!gone) list(); };
const size = bytes => bytes > 1e6 ? `${(bytes / 1e6).toFixed(1)} MB` : `${Math.ceil(bytes / 1e3)} kB`;

async function showFiles(open) {
  $("downloads").hidden = !open;
  $("files").setAttribute("aria-expanded", open);
  if (!open) return;
  const { files, zip } = await list();
  $("zip").textContent = `Everything as one zip (${size(zip || 0)})`;
  $("downloads").querySelector("ul").replaceChildren(...files.map(file => {
    const item = document.createElement("li"), link = document.createElement("a"), small = document.createElement("small");
    link.href = `/files/${file.name.split("/").map(encodeURIComponent).join("/")}`; link.download = file.name.split("/").pop(); link.textContent = file.name;
    small.textContent = ` ${size(file.bytes)}`;
    item.append(link, small);
    return item;
  }));
  if (!files.length) $("downloads").querySelector("ul").textContent = "The files are written when the run ends.";
}

const post = (path, body = "") => fetch(path, { method: "POST", body }).catch(() => {});
// The place is marked at once; its name may take longer to type.
async function mark() {
  if (!introduction?.live || $("mark").disabled) return;
  const answer = await post("/mark");
  if (!answer?.ok) return;
  const { index, mark } = await answer.json();
  $("naming").hidden = false;
  $("naming").dataset.index = index;
  $("mark-number").textContent = mark.name;
  $("mark-name").value = "";
  $("mark-name").focus();
}
function ask() { if (!$("stop").disabled) $("ask").showModal(); }

// ---- layers

function offer(layer) { document.querySelector(`[data-layer=${layer}]`).parentElement.hidden = false; }
function showElevations(points) {
  offer("elevations");
  map.setElevations(points);
  const heights = points.map(point => point[2]);
  const mm = metres => `${Math.round(1000 * metres)}`;
  $("elevation-range").textContent = `(${mm(heights.reduce((a, b) => Math.min(a, b)))} to ${mm(heights.reduce((a, b) => Math.max(a, b)))} mm)`;
  document.body.dataset.elevations = points.length;
}
for (const box of document.querySelectorAll("[data-layer]")) box.onchange = () => {
  if (box.dataset.layer === "mask") { if (camera) camera.masked = box.checked; }
  else { map.shown[box.dataset.layer] = box.checked; map.drawn = null; map.changed = true; }
};
$("layers").onclick = () => { $("shown").hidden = !$("shown").hidden; $("layers").setAttribute("aria-expanded", !$("shown").hidden); };
const setFollow = follow => { map.setFollow(follow); $("follow").setAttribute("aria-pressed", follow); };
map.onUnfollow = () => $("follow").setAttribute("aria-pressed", "false");

$("mark").onclick = mark;
$("stop").onclick = ask;
$("ask").onclose = () => { if ($("ask").returnValue === "stop") { $("stop").disabled = true; post("/stop"); } $("ask").returnValue = ""; };
$("naming").onsubmit = event => { event.preventDefault(); post(`/mark/${$("naming").dataset.index}`, $("mark-name").value); $("naming").hidden = true; $("map").focus(); };
$("unnamed").onclick = () => { $("naming").hidden = true; $("map").focus(); };
$("files").onclick = () => showFiles($("downloads").hidden);
$("keys").onclick = () => $("help").showModal();
$("closer").onclick = () => map.zoom(1.5);
$("farther").onclick = () => map.zoom(1 / 1.5);
$("whole").onclick = () => map.showAll();
$("follow").onclick = () => setFollow(!map.follow);
$("time").oninput = () => seek(Number($("time").value));
$("live").onclick = goLive;
$("play").onclick = togglePlay;
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { map.drawn = null; map.changed = true; });

addEventListener("keydown", event => {
  if (event.ctrlKey || event.metaKey || event.altKey || $("help").open || $("ask").open) return;
  if (event.target === $("mark-name")) { if (event.key === "Escape") $("unnamed").click(); return; }
  const act = {
    " ": togglePlay, l: () => introduction?.live && goLive(), f: () => setFollow(!map.follow), 0: () => map.showAll(), "+": () => map.zoom(1.3), "=": () => map.zoom(1.3),
    "-": () => map.zoom(1 / 1.3), m: mark, ",": () => seek(at - 1), ".": () => seek(at + 1), "?": () => $("help").showModal(),
  }[event.key.toLowerCase()];
  // A focused button or slider handles its own keys.
  if (!act || (event.key === " " && event.target.matches?.("button, a, input"))) return;
  event.preventDefault();
  act();
});

connect();
requestAnimationFrame(frame);
showPlaying();
