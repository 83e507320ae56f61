// Decodes and tracks beside the page. It connects to nothing: the page gives it the module and the
// video, and it answers with what is to be shown.

import { open, picture } from "./video.js";

const DONE = 1, AGAIN = 2, TILE = 256;
// Intervals at which the page gets frames, pictures and ground, milliseconds.
const RECORDS_EVERY = 60, PICTURE_EVERY = 120, GROUND_EVERY = 300, PREVIEW = 640, MOSAIC_LONGEST = 8192;

/// The functions of the module. One that fails throws the sentence that it left.
class Odograph {
  constructor(instance) { this.calls = instance.exports; }

  give(bytes) {
    const at = this.calls.input(bytes.length); // may move the memory
    new Uint8Array(this.calls.memory.buffer, at, bytes.length).set(bytes);
  }

  output() { return new Uint8Array(this.calls.memory.buffer, this.calls.output(), this.calls.output_length()).slice(); }
  text() { return new TextDecoder().decode(this.output()); }
  json() { return JSON.parse(this.text()); }

  call(name, ...values) {
    const answer = this.calls[name](...values);
    if (answer !== DONE && answer !== AGAIN) throw new Error(this.text());
    return answer;
  }
}

let stopped = false, played = null, waiting = null;
const say = (kind, message = {}, transfer = []) => postMessage({ kind, ...message }, transfer);

onmessage = ({ data }) => {
  if (data.kind === "start") run(data).catch(error => say("failed", { message: sentence(error) }));
  else if (data.kind === "stop") { stopped = true; waiting?.(); }
  else if (data.kind === "played") { played.push(data); waiting?.(); }
};

function sentence(error) {
  if (error instanceof WebAssembly.RuntimeError || error instanceof RangeError) return `The tracker has stopped unexpectedly (${error.message}). A long or large video may need more memory than a page has.`;
  return error.message;
}

/// Frames of the browser's player, which the page sends: those that it had time for.
function playerFrames({ width, height }) {
  async function* frames() {
    played = [];
    say("play");
    try {
      for (;;) {
        const next = played.shift();
        if (next?.failed) throw new Error(next.failed);
        if (next?.ended || (!next && stopped)) return;
        if (next) { yield picture(next.frame, next.time); say("next"); continue; }
        await new Promise(resolve => { waiting = resolve; });
        waiting = null;
      }
    } finally {
      say("pause");
      for (const { frame } of played) frame?.close();
    }
  }
  return { width, height, count: 0, frames };
}

async function run({ module, file, settings, player }) {
  const source = player ? playerFrames(player) : await open(file);
  if (!source) return say("player"); // the page is asked to play it
  const odograph = new Odograph(await WebAssembly.instantiate(module, {}));
  let found = null, finished = false;
  while (!finished) {
    odograph.give(new TextEncoder().encode(JSON.stringify(settings)));
    if (found === null) {
      odograph.call("begin", source.width, source.height);
      say("begun", { setup: odograph.json(), width: source.width, height: source.height, count: source.count });
    } else say("again", { found });
    const outcome = await pass(odograph, source);
    if (outcome.found !== undefined) { found = outcome.found; continue; }
    say("finishing");
    if (!outcome.frames) throw outcome.failure || new Error("There is no frame in this video.");
    if (odograph.call("finish", !stopped && !outcome.failure) === AGAIN) { found = odograph.text(); continue; }
    await deliver(odograph, odograph.json(), outcome.failure);
    finished = true;
  }
}

/// One pass over the video. `found`: what of the camera is to be assumed in the next one.
async function pass(odograph, source) {
  const times = [], records = [];
  let frames = 0, told = 0, pictured = 0, ground = 0, breathed = performance.now(), failure = null;
  const tell = () => {
    if (!records.length) return;
    const values = new Float32Array(records.length * records[0].length);
    records.forEach((record, k) => values.set(record, k * record.length));
    const sorted = times.slice(-300).sort((a, b) => a - b);
    say("frames", { first: frames - records.length, values, median: sorted[sorted.length >> 1], high: sorted[Math.floor(.99 * sorted.length)] }, [values.buffer]);
    records.length = 0;
  };
  try {
    for await (const frame of source.frames()) {
      try {
        const { layout, fullRange, bytes } = await frame.pixels();
        odograph.give(bytes);
        const begun = performance.now(), answer = odograph.call("process", layout, fullRange, frame.time), now = performance.now();
        if (answer === AGAIN) return { found: odograph.text() };
        times.push(now - begun);
        records.push(new Float32Array(odograph.output().buffer));
        frames++;
        if (now - told > RECORDS_EVERY) { told = now; tell(); }
        if (now - pictured > PICTURE_EVERY) { pictured = now; await show(odograph, frame); }
        if (now - ground > GROUND_EVERY) { ground = now; await tiles(odograph); }
        // Lets messages of the page in.
        if (now - breathed > 40) { breathed = now; await new Promise(resolve => setTimeout(resolve)); }
      } finally {
        frame.close();
      }
      if (stopped) break;
    }
  } catch (error) {
    if (!frames || error instanceof WebAssembly.RuntimeError) throw error;
    failure = error; // what was tracked up to there is kept
  }
  tell();
  return { frames, failure };
}

async function show(odograph, frame) {
  const bitmap = await frame.bitmap(PREVIEW);
  odograph.call("tracks");
  const tracks = new Int16Array(odograph.output().buffer);
  say("picture", { bitmap, tracks }, [bitmap, tracks.buffer]);
}

/// Sends the tiles of the mosaic that have changed.
async function tiles(odograph, all = false) {
  odograph.call("changed_ground");
  const { metres_per_pixel: metresPerPixel, tiles: changed } = odograph.json();
  const sent = [];
  for (const [column, row] of changed) {
    odograph.call("tile", column, row);
    const image = new ImageData(new Uint8ClampedArray(odograph.output().buffer), TILE, TILE);
    sent.push({ column, row, image: await createImageBitmap(image) });
  }
  if (sent.length) say("ground", { metresPerPixel, tiles: sent, all }, sent.map(tile => tile.image));
}

async function deliver(odograph, summary, failure) {
  odograph.call("records");
  const values = new Float32Array(odograph.output().buffer);
  await tiles(odograph, true);
  const files = [];
  for (const name of ["trajectory.tum", "trajectory.csv"]) {
    odograph.call(name.replace(".", "_"));
    files.push({ name, blob: new Blob([odograph.output()], { type: "text/plain" }) });
  }
  if (summary.tracked) {
    odograph.call("mosaic", MOSAIC_LONGEST);
    const bytes = odograph.output(), [width, height] = new Uint32Array(bytes.buffer, 0, 2), canvas = new OffscreenCanvas(width, height);
    canvas.getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(bytes.buffer, 8), width, height), 0, 0);
    files.push({ name: "mosaic.png", blob: await canvas.convertToBlob({ type: "image/png" }) });
  }
  say("finished", { summary, values, files, message: failure ? failure.message : "" }, [values.buffer]);
}
