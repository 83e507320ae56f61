// Videos as frames with their times. MP4 and MOV are decoded by WebCodecs, every frame of them;
// Y4M is read as it is; everything else is played by the browser (`played`).

/// Layouts of pixels by their numbers in the module.
const GRAY = 0, PLANAR = 1, SEMI_PLANAR = 2, RGBA = 3;

const CUT_OFF = "The video ends early, because its file is cut off or damaged. What came before was tracked.";

/// Opens a video. Frames have a time in seconds, `pixels()`, `bitmap(width)` and `close()`.
/// `undefined` where only the browser's player may be able to read it.
export async function open(file) {
  const head = new Uint8Array(await file.slice(0, 12).arrayBuffer()), text = String.fromCharCode(...head);
  if (text.startsWith("YUV4MPEG2")) return y4m(file);
  if (text.slice(4, 8) !== "ftyp" && text.slice(4, 8) !== "moov" && text.slice(4, 8) !== "mdat" && text.slice(4, 8) !== "wide") return undefined;
  const movie = "VideoDecoder" in globalThis ? await mp4(file) : undefined;
  const decodable = movie && (await VideoDecoder.isConfigSupported(movie.config).catch(() => null))?.supported;
  return decodable ? decoded(file, movie) : undefined;
}

// ---- Y4M

async function y4m(file) {
  const read = reader(file), line = new TextDecoder().decode(await read(0, Math.min(1024, file.size))).split("\n")[0];
  const field = letter => line.split(" ").slice(1).find(word => word[0] === letter)?.slice(1);
  const width = Number(field("W")), height = Number(field("H")), [rate, per] = (field("F") || "30:1").split(":").map(Number);
  const color = field("C") || "420", pixels = width * height, quarter = Math.ceil(width / 2) * Math.ceil(height / 2);
  const length = color.startsWith("420") ? pixels + 2 * quarter : color === "mono" ? pixels : color === "422" ? 2 * pixels : color === "444" ? 3 * pixels : 0;
  if (!(pixels > 0) || !length || /p1\d/.test(color)) throw new Error(`This Y4M video cannot be read: ${width}x${height}, ${color}. 8-bit 420 or mono can.`);
  const planar = color.startsWith("420"), fullRange = line.includes("XCOLORRANGE=FULL");
  const count = Math.floor((file.size - line.length - 1) / (length + 6));
  async function* frames() {
    let at = line.length + 1;
    for (let number = 0; at < file.size; number++) {
      const head = new TextDecoder().decode(await read(at, Math.min(128, file.size - at))), end = head.indexOf("\n");
      if (!head.startsWith("FRAME") || end < 0 || at + end + 1 + length > file.size) throw new Error(CUT_OFF);
      const bytes = await read(at + end + 1, planar ? length : pixels);
      at += end + 1 + length;
      yield {
        time: number * per / rate,
        pixels: async () => ({ layout: planar ? PLANAR : GRAY, fullRange, bytes }),
        bitmap: wanted => createImageBitmap(grayImage(bytes, width, height), { resizeWidth: Math.min(wanted, width) }),
        close() {},
      };
    }
  }
  return { width, height, count, frames };
}

function grayImage(luma, width, height) {
  const image = new ImageData(width, height), words = new Uint32Array(image.data.buffer);
  for (let k = 0; k < words.length; k++) words[k] = 0xff000000 | luma[k] * 0x010101;
  return image;
}

/// Reads a file in large pieces: a frame has a few kilobytes.
function reader(file) {
  const PIECE = 4 << 20;
  let from = 0, piece = new Uint8Array(0);
  return async (at, length) => {
    if (at < from || at + length > from + piece.length) {
      from = at;
      piece = new Uint8Array(await file.slice(at, at + Math.max(length, PIECE)).arrayBuffer());
    }
    return piece.subarray(at - from, at - from + length);
  };
}

// ---- MP4 (ISO/IEC 14496-12)

/// Codec, size and samples of the first video track; `undefined` where the file is none or has no
/// plain index.
async function mp4(file) {
  let moov = null;
  for (let at = 0; at + 8 <= file.size && !moov;) {
    const head = new DataView(await file.slice(at, at + 16).arrayBuffer());
    let size = head.getUint32(0), header = 8;
    if (size === 1 && head.byteLength === 16) { size = Number(head.getBigUint64(8)); header = 16; }
    if (size === 0) size = file.size - at;
    if (size < header) return undefined;
    if (head.getUint32(4) === 0x6d6f6f76) moov = new DataView(await file.slice(at + header, at + size).arrayBuffer());
    at += size;
  }
  if (!moov) return undefined;
  try {
    for (const trak of boxes(moov, "trak")) {
      const mdia = child(trak, "mdia"), handler = child(mdia, "hdlr");
      if (handler && name(handler, 8) === "vide") return track(moov, trak, mdia);
    }
  } catch (error) {
    if (!(error instanceof RangeError || error instanceof TypeError)) throw error; // a damaged index
  }
  return undefined;
}

const name = (view, at) => String.fromCharCode(view.getUint8(at), view.getUint8(at + 1), view.getUint8(at + 2), view.getUint8(at + 3));
const part = (view, at, length) => new DataView(view.buffer, view.byteOffset + at, length);

function* boxes(view, wanted, from = 0) {
  for (let at = from; at + 8 <= view.byteLength;) {
    const size = view.getUint32(at) || view.byteLength - at;
    if (size < 8) return;
    if (!wanted || name(view, at + 4) === wanted) yield part(view, at + 8, Math.min(size - 8, view.byteLength - at - 8));
    at += size;
  }
}

const child = (view, wanted, from) => boxes(view, wanted, from).next().value;

/// The words of a table, after its version, flags and count.
function* rows(view, columns) {
  if (!view) return;
  const count = view.getUint32(4);
  for (let k = 0; k < count && 8 + 4 * columns * (k + 1) <= view.byteLength; k++) yield Array.from({ length: columns }, (_, c) => view.getInt32(8 + 4 * (columns * k + c)));
}

function track(moov, trak, mdia) {
  const stbl = child(child(mdia, "minf"), "stbl"), long = view => view.getUint8(0) === 1;
  const mdhd = child(mdia, "mdhd"), timescale = mdhd.getUint32(long(mdhd) ? 20 : 12);
  const mvhd = child(moov, "mvhd"), movieScale = mvhd.getUint32(long(mvhd) ? 20 : 12);
  const described = describe(child(stbl, "stsd"));
  const stsz = child(stbl, "stsz"), fixed = stsz.getUint32(4), count = stsz.getUint32(8);
  const samples = [], stco = child(stbl, "stco"), co64 = child(stbl, "co64"), runs = [...rows(child(stbl, "stsc"), 3)];
  const chunks = (stco || co64).getUint32(4);
  for (let chunk = 0, run = 0; chunk < chunks && samples.length < count; chunk++) {
    while (run + 1 < runs.length && chunk + 1 >= runs[run + 1][0]) run++;
    let offset = stco ? stco.getUint32(8 + 4 * chunk) : Number(co64.getBigUint64(8 + 8 * chunk));
    for (let k = 0; k < runs[run][1] && samples.length < count; k++) {
      const size = fixed || stsz.getUint32(12 + 4 * samples.length);
      samples.push({ offset, size, time: 0, key: false });
      offset += size;
    }
  }
  let at = 0, time = 0;
  for (const [times, step] of rows(child(stbl, "stts"), 2)) for (let k = 0; k < times && at < samples.length; k++) { samples[at++].time = time; time += step; }
  at = 0;
  for (const [times, offset] of rows(child(stbl, "ctts"), 2)) for (let k = 0; k < times && at < samples.length; k++) samples[at++].time += offset;
  const sync = child(stbl, "stss");
  if (sync) for (const [number] of rows(sync, 1)) { if (samples[number - 1]) samples[number - 1].key = true; } else for (const sample of samples) sample.key = true;
  if (!samples.length) return undefined; // in fragments
  const tkhd = child(trak, "tkhd"), matrix = long(tkhd) ? 52 : 40;
  const [a, b, c, d] = [0, 4, 12, 16].map(offset => Math.sign(tkhd.getInt32(matrix + offset)));
  const turns = a === 0 && d === 0 ? (b > 0 ? 1 : 3) : a < 0 && d < 0 ? 2 : 0;
  if (a * d - b * c < 0) return undefined; // mirrored
  return { ...described, samples, timescale, turns, seconds: presentation(trak, samples, timescale, movieScale) };
}

/// The time in seconds at which a sample is shown, by the edit list; `null` where it is not.
function presentation(trak, samples, timescale, movieScale) {
  const edts = child(trak, "edts"), elst = edts && child(edts, "elst"), edits = [];
  let now = 0;
  if (elst && elst.getUint8(0) === 0) for (const [duration, from] of rows(elst, 3)) {
    const seconds = (duration >>> 0) / movieScale, ticks = Math.round(seconds * timescale);
    if (from >= 0) edits.push({ at: now, from, to: ticks ? from + ticks : Infinity });
    now += seconds;
  }
  const bare = time => {
    if (!edits.length) return time / timescale;
    const edit = edits.find(edit => time >= edit.from && time < edit.to);
    return edit ? edit.at + (time - edit.from) / timescale : null;
  };
  const shown = samples.map(sample => bare(sample.time)).filter(time => time !== null);
  if (!shown.length) { edits.length = 0; return bare; }
  // An edit may start between two frames: its first frame is shown without delay.
  const first = shown.reduce((least, time) => Math.min(least, time)), late = edits.length ? Math.max(0, first - edits[0].at) : 0;
  return time => { const seconds = bare(time); return seconds === null ? null : seconds - late; };
}

/// The first sample entry as a configuration of WebCodecs.
function describe(stsd) {
  const entry = child(stsd, undefined, 8), kind = name(stsd, 12), inner = wanted => child(entry, wanted, 78);
  const width = entry.getUint16(24), height = entry.getUint16(26), hex = value => value.toString(16).padStart(2, "0"), two = value => String(value).padStart(2, "0");
  const bytes = view => new Uint8Array(view.buffer, view.byteOffset, view.byteLength);
  let box, codec, description;
  if ((box = inner("avcC"))) { codec = `avc1.${[1, 2, 3].map(k => hex(box.getUint8(k))).join("")}`; description = bytes(box); }
  else if ((box = inner("hvcC"))) {
    const first = box.getUint8(1), flags = box.getUint32(2);
    let reversed = 0;
    for (let bit = 0; bit < 32; bit++) reversed = (reversed << 1 | flags >>> bit & 1) >>> 0;
    const constraints = [6, 7, 8, 9, 10, 11].map(k => box.getUint8(k).toString(16));
    while (constraints.length && constraints.at(-1) === "0") constraints.pop();
    codec = [`${kind}.${["", "A", "B", "C"][first >> 6]}${first & 31}`, reversed.toString(16), `${first & 32 ? "H" : "L"}${box.getUint8(12)}`, ...constraints].join(".");
    description = bytes(box);
  } else if ((box = inner("vpcC"))) codec = `vp09.${two(box.getUint8(4))}.${two(box.getUint8(5))}.${two(box.getUint8(6) >> 4)}`;
  else if ((box = inner("av1C"))) { const level = box.getUint8(1), rest = box.getUint8(2); codec = `av01.${level >> 5}.${two(level & 31)}${rest & 128 ? "H" : "M"}.${rest & 64 ? "10" : "08"}`; }
  else codec = kind;
  return { width, height, config: { codec, codedWidth: width, codedHeight: height, ...(description && { description }) } };
}

// ---- WebCodecs

/// Frames in hand: enough to keep the decoder busy. Some decoders stop where more are open.
const AHEAD = 6;

function decoded(file, { config, width, height, samples, timescale, turns, seconds }) {
  async function* frames() {
    const read = reader(file), ready = [], micro = time => Math.round(1e6 * time / timescale);
    const times = new Map(samples.map(sample => [micro(sample.time), seconds(sample.time)]));
    let wake = () => {}, failure = null, flushed = false, cut = false, next = 0;
    const fail = error => { failure = error; wake(); };
    const decoder = new VideoDecoder({ output: frame => { ready.push(frame); wake(); }, error: fail });
    decoder.ondequeue = () => wake();
    try {
      decoder.configure(config);
      for (;;) {
        while (next < samples.length && !failure && decoder.decodeQueueSize + ready.length < AHEAD) {
          const { offset, size, time, key } = samples[next++], data = await read(offset, size);
          if (data.length < size) { cut = true; next = samples.length; break; }
          if (!failure) decoder.decode(new EncodedVideoChunk({ type: key ? "key" : "delta", timestamp: micro(time), data }));
          if (next === samples.length) break;
        }
        if (next === samples.length && !failure) { next++; decoder.flush().then(() => { flushed = true; wake(); }, fail); }
        if (ready.length) {
          const frame = ready.shift(), time = times.get(frame.timestamp);
          if (time === null || time === undefined) frame.close(); else yield picture(frame, time, turns);
          continue;
        }
        if (failure) throw new Error(`The video ends early, because the browser cannot decode it: ${failure.message}`);
        if (flushed && cut) throw new Error(CUT_OFF);
        if (flushed) return;
        await new Promise(resolve => { wake = resolve; });
      }
    } finally {
      for (const frame of ready) frame.close();
      if (decoder.state !== "closed") decoder.close();
    }
  }
  const turned = turns % 2 ? { width: height, height: width } : { width, height };
  return { ...turned, count: samples.filter(sample => seconds(sample.time) !== null).length, frames };
}

/// A frame of WebCodecs, to be turned clockwise by quarter turns.
export function picture(frame, time, turns = 0) {
  const { width, height } = frame.visibleRect;
  return {
    time,
    async pixels() {
      const chromaWidth = Math.ceil(width / 2), chroma = chromaWidth * Math.ceil(height / 2), luma = width * height;
      const fullRange = frame.colorSpace?.fullRange === true;
      const planes = [{ offset: 0, stride: width }];
      if (frame.format === "I420") planes.push({ offset: luma, stride: chromaWidth }, { offset: luma + chroma, stride: chromaWidth });
      else if (frame.format === "NV12") planes.push({ offset: luma, stride: 2 * chromaWidth });
      else return { layout: RGBA, fullRange: true, bytes: drawn(frame, width, height, turns) };
      const bytes = new Uint8Array(luma + 2 * chroma);
      await frame.copyTo(bytes, { layout: planes });
      const layout = planes.length === 3 ? PLANAR : SEMI_PLANAR;
      return { layout, fullRange, bytes: turns ? turned(bytes, layout, width, height, turns) : bytes };
    },
    async bitmap(wanted) {
      const bitmap = await createImageBitmap(frame, { resizeWidth: Math.min(wanted, width) });
      if (!turns) return bitmap;
      const canvas = new OffscreenCanvas(...(turns % 2 ? [bitmap.height, bitmap.width] : [bitmap.width, bitmap.height]));
      turnedContext(canvas, bitmap.width, bitmap.height, turns).drawImage(bitmap, 0, 0);
      bitmap.close();
      return canvas.transferToImageBitmap();
    },
    close() { frame.close(); },
  };
}

function turnedContext(canvas, width, height, turns) {
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.translate(canvas.width / 2, canvas.height / 2);
  context.rotate(turns * Math.PI / 2);
  context.translate(-width / 2, -height / 2);
  return context;
}

/// Other formats by way of a canvas, which converts them.
function drawn(frame, width, height, turns) {
  const canvas = new OffscreenCanvas(...(turns % 2 ? [height, width] : [width, height])), context = turnedContext(canvas, width, height, turns);
  context.drawImage(frame, 0, 0, width, height);
  return new Uint8Array(context.getImageData(0, 0, canvas.width, canvas.height).data.buffer);
}

/// The planes of a picture turned clockwise.
function turned(bytes, layout, width, height, turns) {
  const result = new Uint8Array(bytes.length), half = [Math.ceil(width / 2), Math.ceil(height / 2)];
  const turn = (offset, width, height, step) => {
    const across = turns % 2 ? height : width;
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) {
      const [u, v] = turns === 1 ? [height - 1 - y, x] : turns === 2 ? [width - 1 - x, height - 1 - y] : [y, width - 1 - x];
      for (let k = 0; k < step; k++) result[offset + step * (v * across + u) + k] = bytes[offset + step * (y * width + x) + k];
    }
  };
  turn(0, width, height, 1);
  if (layout === SEMI_PLANAR) turn(width * height, ...half, 2);
  else for (const plane of [0, 1]) turn(width * height + plane * half[0] * half[1], ...half, 1);
  return result;
}
