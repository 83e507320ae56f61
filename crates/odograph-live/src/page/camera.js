// The camera image with its tracks: each corner's position in the keyframe and in the current
// frame.

export class CameraView {
  constructor(canvas, width, height) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.size = { width, height };
    canvas.width = Math.min(width, 960);
    canvas.height = Math.round(canvas.width * height / width);
    this.waiting = null;
    this.busy = false;
    this.shown = 0;
    this.overlay = null;
    this.mask = null;
    this.masked = true;
  }

  /// Shows an image. While one is being decoded, only the newest of the following ones is kept.
  show(bytes) {
    this.waiting = bytes;
    if (!this.busy) this.next();
  }

  async next() {
    this.busy = true;
    while (this.waiting) {
      const bytes = this.waiting;
      this.waiting = null;
      try { await this.draw(bytes); } catch { /* images that cannot be decoded are skipped */ }
    }
    this.busy = false;
  }

  async draw(bytes) {
    const head = new DataView(bytes);
    const count = head.getUint16(2, true), tracks = new Int16Array(bytes, 8, 5 * count);
    const image = await createImageBitmap(new Blob([new Uint8Array(bytes, 8 + 10 * count)], { type: "image/jpeg" }));
    this.paint(image, tracks);
    image.close();
  }

  /// Sets what of the image is not ground: cells in row order, `1` where they are not.
  setMask(mask) { this.mask = mask; }

  drawMask(c, width, height) {
    const { columns, rows, cells } = this.mask, w = width / columns, h = height / rows;
    c.fillStyle = "rgb(232 89 12 / .45)";
    for (let k = 0; k < cells.length; k++) if (cells[k] === "1") c.fillRect(k % columns * w, Math.floor(k / columns) * h, w + .5, h + .5);
  }

  /// Draws an image with its tracks: five numbers each, the first four in quarters of a pixel.
  paint(image, tracks) {
    const c = this.context, { width, height } = this.canvas, count = tracks.length / 5;
    c.drawImage(image, 0, 0, width, height);
    this.overlay?.(c, width, height);
    if (this.mask && this.masked) this.drawMask(c, width, height);
    const scale = width / this.size.width / 4, r = Math.max(1.8, width / 300);
    let good = 0;
    for (const inlier of [0, 1]) {
      const color = inlier ? "#27d08a" : "#ff5a45";
      const lines = new Path2D(), dots = new Path2D();
      for (let k = 0; k < count; k++) {
        if ((tracks[5 * k + 4] ? 1 : 0) !== inlier) continue;
        good += inlier;
        const [x, y, u, v] = [0, 1, 2, 3].map(i => (tracks[5 * k + i] + 2) * scale);
        if (inlier) { lines.moveTo(u, v); lines.lineTo(x, y); }
        dots.moveTo(x + r, y); dots.arc(x, y, r, 0, 7);
      }
      c.strokeStyle = color; c.globalAlpha = .35; c.lineWidth = Math.max(1, width / 640); c.stroke(lines);
      c.globalAlpha = 1; c.fillStyle = color; c.fill(dots);
    }
    document.getElementById("good").textContent = good;
    document.getElementById("bad").textContent = count - good;
    this.shown++;
    document.body.dataset.pictures = this.shown;
  }
}
