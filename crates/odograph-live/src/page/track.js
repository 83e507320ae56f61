// The frames of a run in one growing array. The path is divided into chunks, which can be skipped
// or thinned when drawn.

export const FIELDS = ["t", "x", "y", "heading", "varX", "covXY", "varY", "sigmaHeading", "speed", "state", "segment", "tracks", "inliers", "latency", "keyframe"];
export const LENGTH = FIELDS.length;
const AT = Object.fromEntries(FIELDS.map((name, index) => [name, index]));
const CHUNK = 256;

export const CAUSES = ["", "too little texture on the ground", "hardly any corner was found again", "the corners do not move as one plane",
  "it is too dark", "the picture is blurred", "the corners stand still in the picture (shadow, part of the carrier)"];

export class Track {
  constructor() {
    this.values = new Float32Array(4096 * LENGTH);
    // Position and heading in the odometry frame; and for each keyframe the similarity
    // transformation (a, b, x, y) that maps the frames measured against it into the map frame.
    this.odometry = new Float32Array(4096 * 3);
    this.corrections = null;
    this.count = 0;
    this.chunks = [];
    this.bounds = null;
  }

  /// Appends records from number `first` on, skipping those already present.
  add(first, records) {
    const skip = Math.max(0, this.count - first);
    const fresh = records.subarray(skip * LENGTH);
    const end = this.count + fresh.length / LENGTH;
    if (end * LENGTH > this.values.length) {
      const larger = new Float32Array(Math.max(2 * this.values.length, end * LENGTH));
      larger.set(this.values.subarray(0, this.count * LENGTH));
      this.values = larger;
      const places = new Float32Array(larger.length / LENGTH * 3);
      places.set(this.odometry.subarray(0, this.count * 3));
      this.odometry = places;
    }
    this.values.set(fresh, this.count * LENGTH);
    for (let k = this.count; k < end; k++) {
      this.odometry.set(this.values.subarray(k * LENGTH + AT.x, k * LENGTH + AT.x + 3), k * 3);
      this.place(k);
      this.extend(k);
    }
    this.count = end;
  }

  /// Forgets all records.
  clear() {
    this.count = 0;
    this.corrections = null;
    this.chunks = [];
    this.bounds = null;
  }

  /// Applies the map's corrections after a loop closure to all frames.
  correct(corrections) {
    this.corrections = corrections.length ? corrections : null;
    this.chunks = [];
    this.bounds = null;
    for (let k = 0; k < this.count; k++) { this.place(k); this.extend(k); }
  }

  /// Transforms a record into the map frame by the correction of its keyframe. Keyframes newer than
  /// the corrections use the newest correction.
  place(k) {
    if (!this.corrections) return;
    const known = this.corrections.length / 4, keyframe = this.get(k, "keyframe");
    const c = 4 * Math.min(keyframe >= 0 ? keyframe : known, known - 1), [a, b, x, y] = [0, 1, 2, 3].map(i => this.corrections[c + i]), at = k * LENGTH;
    const [u, v, heading] = this.odometry.subarray(3 * k, 3 * k + 3);
    this.values[at + AT.x] = a * u - b * v + x;
    this.values[at + AT.y] = b * u + a * v + y;
    this.values[at + AT.heading] = heading + Math.atan2(b, a);
  }

  extend(k) {
    const index = Math.floor(k / CHUNK);
    let chunk = this.chunks[index];
    if (!chunk) chunk = this.chunks[index] = { x0: Infinity, x1: -Infinity, y0: Infinity, y1: -Infinity, length: 0, known: 0 };
    const x = this.get(k, "x"), y = this.get(k, "y");
    if (!Number.isFinite(x) || !Number.isFinite(y)) return;
    chunk.x0 = Math.min(chunk.x0, x); chunk.x1 = Math.max(chunk.x1, x);
    chunk.y0 = Math.min(chunk.y0, y); chunk.y1 = Math.max(chunk.y1, y);
    if (k > 0) {
      const step = Math.hypot(x - this.get(k - 1, "x"), y - this.get(k - 1, "y"));
      if (Number.isFinite(step)) chunk.length += step;
    }
    chunk.known++;
    const b = this.bounds;
    this.bounds = b ? { x0: Math.min(b.x0, x), x1: Math.max(b.x1, x), y0: Math.min(b.y0, y), y1: Math.max(b.y1, y) } : { x0: x, x1: x, y0: y, y1: y };
  }

  get(k, name) { return this.values[k * LENGTH + AT[name]]; }

  /// The newest record at or before `k` that has a pose.
  lastPlace(k) {
    for (let i = Math.min(k, this.count - 1); i >= 0 && i > k - 2000; i--) if (Number.isFinite(this.get(i, "x"))) return i;
    return -1;
  }

  /// The record at a time, by bisection.
  at(t) {
    let low = 0, high = this.count - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.get(middle, "t") <= t) low = middle; else high = middle - 1;
    }
    return low;
  }

  /// Draws records `from` to `to` into a path. `toX` and `toY` convert metres to pixels, `scale` is
  /// in pixels per metre, `window` is the visible area in metres. Chunks outside of it are skipped;
  /// chunks with more points than pixels are thinned.
  trace(context, from, to, toX, toY, scale, window) {
    let pen = false, segment = NaN;
    for (let index = Math.floor(from / CHUNK); index * CHUNK <= to && index < this.chunks.length; index++) {
      const chunk = this.chunks[index];
      const out = !chunk.known || chunk.x1 < window.x0 || chunk.x0 > window.x1 || chunk.y1 < window.y0 || chunk.y0 > window.y1;
      if (out) { pen = false; continue; }
      const stepPx = chunk.length * scale / chunk.known;
      const stride = Math.max(1, Math.min(CHUNK, Math.floor(1.5 / Math.max(stepPx, 1e-3))));
      const start = Math.max(from, index * CHUNK - 1), end = Math.min(to, index * CHUNK + CHUNK - 1);
      for (let k = Math.max(0, start); ; k = Math.min(k + stride, end)) {
        const x = this.get(k, "x"), y = this.get(k, "y"), s = this.get(k, "segment");
        if (!Number.isFinite(x)) pen = false;
        else {
          if (pen && s === segment) context.lineTo(toX(x), toY(y)); else context.moveTo(toX(x), toY(y));
          pen = true; segment = s;
        }
        if (k >= end) break;
      }
    }
  }
}
