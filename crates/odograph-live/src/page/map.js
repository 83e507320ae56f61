// The ground map: tiles of the mosaic, the trajectory, the camera and its error ellipse.

const TILE = 256;
const FETCHES = 6;
// Margin of the path layer beyond the view, pixels: the view can pan this far without a redraw.
const MARGIN = 256;
// Least margin around the path where all is shown, metres.
const MARGIN_M = .3;
// While zooming, the path layer is only scaled. It is redrawn this long after the last step,
// milliseconds.
const SETTLED = 120;
// Side of the thumbnail in which the seen part of a tile is found, pixels.
const THUMBNAIL = 32;
const thumbnail = Object.assign(document.createElement("canvas"), { width: THUMBNAIL, height: THUMBNAIL }).getContext("2d", { willReadFrequently: true });

/// The part of a tile in which ground was seen, as fractions of its side; `null` for an empty one.
export function seenPart(image) {
  thumbnail.clearRect(0, 0, THUMBNAIL, THUMBNAIL);
  thumbnail.drawImage(image, 0, 0, THUMBNAIL, THUMBNAIL);
  const { data } = thumbnail.getImageData(0, 0, THUMBNAIL, THUMBNAIL);
  let left = THUMBNAIL, right = 0, top = THUMBNAIL, bottom = 0;
  for (let k = 3; k < data.length; k += 4) {
    if (!data[k]) continue;
    const x = (k >> 2) % THUMBNAIL, y = Math.floor((k >> 2) / THUMBNAIL);
    left = Math.min(left, x); right = Math.max(right, x + 1); top = Math.min(top, y); bottom = y + 1;
  }
  return right ? { left: left / THUMBNAIL, right: right / THUMBNAIL, top: top / THUMBNAIL, bottom: bottom / THUMBNAIL } : null;
}

export class GroundMap {
  constructor(canvas, track, token) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
    this.track = track;
    this.layers = [];
    this.fetching = 0;
    this.marks = [];
    this.graph = { keyframes: [], loops: [] };
    this.elevations = [];
    this.markers = [];
    this.shown = { ground: true, path: true, keyframes: true, marks: true, markers: true, elevations: true };
    this.follow = true;
    this.fits = this.unfitted = false;
    this.view = { x: 0, y: 0, scale: 160 };
    this.zoomed = -Infinity;
    this.pathLayer = document.createElement("canvas");
    this.drawn = null;
    this.at = -1;
    this.changed = true;
    this.onUnfollow = () => {};
    this.listen();
    // Resizing clears a canvas, so it is redrawn before the next display frame.
    new ResizeObserver(() => { this.resize(); this.fit(); this.draw(); }).observe(canvas);
    this.resize();
  }

  resize() {
    const box = this.canvas.getBoundingClientRect();
    this.ratio = Math.min(window.devicePixelRatio || 1, 2);
    this.width = Math.max(1, box.width); this.height = Math.max(1, box.height);
    for (const [canvas, margin] of [[this.canvas, 0], [this.pathLayer, MARGIN]]) {
      canvas.width = Math.round((this.width + 2 * margin) * this.ratio);
      canvas.height = Math.round((this.height + 2 * margin) * this.ratio);
    }
    this.drawn = null;
    this.changed = true;
  }

  /// Handles changed tiles. A new ground sampling distance starts a new layer on top of the old
  /// one, which stays until all tiles are replaced.
  groundChanged(metresPerPixel, tiles) {
    let layer = this.layers.at(-1);
    if (!layer || layer.metresPerPixel !== metresPerPixel) {
      layer = { metresPerPixel, tiles: new Map(), wanted: new Map() };
      this.layers.push(layer);
    }
    // After a reconnect all tiles are sent again.
    if (!layer.wanted.size && !this.fetching) layer.isPart = false;
    for (const [column, row] of tiles) layer.wanted.set(`${column}/${row}`, { column, row });
    this.fetchTiles();
  }

  fetchTiles() {
    const layer = this.layers.at(-1);
    if (!layer) return;
    const side = TILE * layer.metresPerPixel;
    const distance = tile => Math.hypot((tile.column + .5) * side - this.view.x, -(tile.row + .5) * side - this.view.y);
    while (this.fetching < FETCHES && layer.wanted.size) {
      // The tile nearest to the centre of the view first.
      let next = null, nearest = Infinity;
      for (const [key, tile] of layer.wanted) {
        const d = distance(tile);
        if (d < nearest) { nearest = d; next = [key, tile]; }
      }
      const [key, tile] = next;
      layer.wanted.delete(key);
      this.fetching++;
      fetch(`/tiles/${tile.column}/${tile.row}.png`).then(async answer => {
        if (answer.status === 200) {
          const image = await createImageBitmap(await answer.blob());
          layer.tiles.set(key, { ...tile, image, seen: seenPart(image) });
          this.fit();
          document.body.dataset.tiles = this.tileCount;
        } else if (answer.status === 204) {
          // The tile no longer exists: a loop closure has moved the ground elsewhere.
          layer.tiles.delete(key);
          this.changed = true;
        } else layer.isPart = true;
        // Without an answer what was there stays, and the layer below.
      }).catch(() => { layer.isPart = true; }).finally(() => {
        this.fetching--;
        if (!layer.wanted.size && !this.fetching && this.layers.length > 1 && !layer.isPart) { this.layers = [this.layers.at(-1)]; this.changed = true; }
        this.fetchTiles();
      });
    }
  }

  get tileCount() { return this.layers.reduce((sum, layer) => sum + layer.tiles.size, 0); }

  show(at) { if (at !== this.at) { this.at = at; this.changed = true; } }

  setFollow(follow) { this.follow = follow; this.fits &&= !follow; this.changed = true; if (!follow) this.onUnfollow(); }

  /// Sets the pose graph: keyframes and loop closures.
  setGraph(graph) { this.graph = graph; this.drawn = null; this.changed = true; document.body.dataset.keyframes = graph.keyframes.length; }

  /// Bounds of the path and of the ground seen so far; `null` without either.
  bounds() {
    const bounds = this.track.bounds, all = bounds ? [{ x0: bounds.x0 - MARGIN_M, x1: bounds.x1 + MARGIN_M, y0: bounds.y0 - MARGIN_M, y1: bounds.y1 + MARGIN_M }] : [];
    for (const { metresPerPixel, tiles } of this.layers) {
      const side = TILE * metresPerPixel;
      for (const { column, row, seen } of tiles.values()) if (seen) {
        all.push({ x0: (column + seen.left) * side, x1: (column + seen.right) * side, y0: -(row + seen.bottom) * side, y1: -(row + seen.top) * side });
      }
    }
    const extend = (a, b) => ({ x0: Math.min(a.x0, b.x0), x1: Math.max(a.x1, b.x1), y0: Math.min(a.y0, b.y0), y1: Math.max(a.y1, b.y1) });
    return all.length ? all.reduce(extend) : null;
  }

  /// Shows all, and goes on doing so while ground is added, until the view is moved.
  showAll() {
    this.fits = true;
    this.unfitted = false;
    const b = this.bounds();
    if (!b) return;
    this.setFollow(false);
    const scale = Math.min(this.width / (b.x1 - b.x0), this.height / (b.y1 - b.y0)) * 0.94;
    this.view = { x: (b.x0 + b.x1) / 2, y: (b.y0 + b.y1) / 2, scale: Math.min(Math.max(scale, .02), 4000) };
    this.changed = true;
  }

  /// After a change of ground or size: fits the view with the next drawing.
  fit() { this.changed = true; this.unfitted = this.fits; }

  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const scale = Math.min(Math.max(this.view.scale * factor, .02), 8000);
    const k = 1 / this.view.scale - 1 / scale;
    if (!this.follow) {
      this.view.x += (px - this.width / 2) * k;
      this.view.y -= (py - this.height / 2) * k;
    }
    this.view.scale = scale;
    this.zoomed = performance.now();
    this.fits = false;
    this.changed = true;
  }

  pan(dx, dy) {
    if (this.follow) this.setFollow(false);
    this.fits = false;
    this.view.x -= dx / this.view.scale;
    this.view.y += dy / this.view.scale;
    this.changed = true;
  }

  listen() {
    const fingers = new Map();
    const canvas = this.canvas;
    canvas.addEventListener("pointerdown", event => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, event); });
    const up = event => fingers.delete(event.pointerId);
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("pointermove", event => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      if (fingers.size === 2) {
        const other = [...fingers.values()].find(finger => finger.pointerId !== event.pointerId);
        const span = e => Math.hypot(e.clientX - other.clientX, e.clientY - other.clientY);
        const box = canvas.getBoundingClientRect();
        this.zoom(span(event) / Math.max(span(before), 1), (event.clientX + other.clientX) / 2 - box.left, (event.clientY + other.clientY) / 2 - box.top);
      }
      this.pan((event.clientX - before.clientX) / fingers.size, (event.clientY - before.clientY) / fingers.size);
      fingers.set(event.pointerId, event);
    });
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      this.zoom(Math.exp(-event.deltaY * (event.deltaMode ? .05 : .0016)), event.offsetX, event.offsetY);
    }, { passive: false });
    canvas.addEventListener("keydown", event => {
      const step = { ArrowLeft: [60, 0], ArrowRight: [-60, 0], ArrowUp: [0, 60], ArrowDown: [0, -60] }[event.key];
      if (step) { this.pan(...step); event.preventDefault(); }
    });
  }

  toX(x) { return (x - this.view.x) * this.view.scale + this.width / 2; }
  toY(y) { return this.height / 2 - (y - this.view.y) * this.view.scale; }

  draw() {
    if (this.fits && this.unfitted) this.showAll();
    const place = this.track.lastPlace(this.at);
    if (this.follow && place >= 0) {
      this.view.x = this.track.get(place, "x");
      this.view.y = this.track.get(place, "y");
    }
    if (!this.changed && this.drawn?.count === this.track.count) return;
    this.changed = false;
    const c = this.context, style = getComputedStyle(document.documentElement), color = name => style.getPropertyValue(name).trim();
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    c.clearRect(0, 0, this.width, this.height);
    this.drawGrid(c, color("--grid"));
    if (this.shown.ground) this.drawGround(c);
    if (this.shown.elevations) this.drawElevations(c);
    c.imageSmoothingEnabled = true;
    if (this.shown.path) c.drawImage(this.pathLayer, ...this.drawPath(color("--path")));
    if (this.shown.keyframes) this.drawGraph(c, color("--path"), color("--mark"));
    if (this.shown.markers) this.drawMarkers(c);
    if (this.shown.marks) this.drawMarks(c, color("--mark"), color("--card"));
    if (place >= 0) this.drawCamera(c, place, place === this.at, color);
    this.drawScale(c, color("--ink"), color("--card"));
  }

  /// A round length for the scale bar, metres, of about the given number of pixels.
  round(pixels) {
    const raw = pixels / this.view.scale, power = 10 ** Math.floor(Math.log10(raw));
    return [1, 2, 5, 10].map(m => m * power).reduce((a, b) => Math.abs(a - raw) < Math.abs(b - raw) ? a : b);
  }

  drawGrid(c, color) {
    const step = this.round(110);
    c.strokeStyle = color; c.lineWidth = 1;
    c.beginPath();
    const left = this.view.x - this.width / 2 / this.view.scale, bottom = this.view.y - this.height / 2 / this.view.scale;
    for (let x = Math.ceil(left / step) * step; this.toX(x) < this.width; x += step) { const px = Math.round(this.toX(x)) + .5; c.moveTo(px, 0); c.lineTo(px, this.height); }
    for (let y = Math.ceil(bottom / step) * step; this.toY(y) > 0; y += step) { const py = Math.round(this.toY(y)) + .5; c.moveTo(0, py); c.lineTo(this.width, py); }
    c.stroke();
  }

  drawGround(c) {
    for (const layer of this.layers) {
      const side = TILE * layer.metresPerPixel, px = side * this.view.scale;
      c.imageSmoothingEnabled = layer.metresPerPixel * this.view.scale < 3;
      for (const tile of layer.tiles.values()) {
        const x = this.toX(tile.column * side), y = this.toY(-tile.row * side);
        if (x > this.width || y > this.height || x + px < 0 || y + px < 0) continue;
        // Half a pixel larger, to hide seams between tiles.
        c.drawImage(tile.image, x, y, px + .5, px + .5);
      }
    }
  }

  /// Rectangle of the path layer in the current view: left, top, width and height, pixels.
  layerPlace() {
    const { x, y, scale } = this.drawn, larger = this.view.scale / scale;
    const width = (this.width + 2 * MARGIN) * larger, height = (this.height + 2 * MARGIN) * larger;
    return [this.toX(x) - width / 2, this.toY(y) - height / 2, width, height];
  }

  /// Draws the path into its own layer, which is larger than the view. While the view stays within
  /// it, only new records are drawn. Returns the rectangle of the layer.
  drawPath(color) {
    const { scale } = this.view, count = this.track.count;
    const context = this.pathLayer.getContext("2d");
    const covers = () => {
      const [left, top, width, height] = this.layerPlace();
      return left <= 0 && top <= 0 && left + width >= this.width && top + height >= this.height;
    };
    const there = this.drawn?.color === color && covers(), same = there && this.drawn.scale === scale;
    if (same && this.drawn.count === count) return this.layerPlace();
    if (there && !same && this.drawn.scale > .4 * scale && performance.now() < this.zoomed + SETTLED) {
      this.changed = true;
      return this.layerPlace();
    }
    const from = same ? Math.max(0, this.drawn.count - 1) : 0;
    if (!same) {
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.clearRect(0, 0, this.pathLayer.width, this.pathLayer.height);
      this.drawn = { x: this.view.x, y: this.view.y };
    }
    Object.assign(this.drawn, { color, scale, count });
    if (!count) return this.layerPlace();
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    context.lineJoin = context.lineCap = "round";
    const { x, y } = this.drawn, middleX = this.width / 2 + MARGIN, middleY = this.height / 2 + MARGIN;
    const halfX = middleX / scale, halfY = middleY / scale;
    const window = { x0: x - halfX, x1: x + halfX, y0: y - halfY, y1: y + halfY };
    context.beginPath();
    this.track.trace(context, from, count - 1, px => (px - x) * scale + middleX, py => middleY - (py - y) * scale, scale, window);
    // A light outline keeps the path visible on any ground.
    context.strokeStyle = "#ffffffd0"; context.lineWidth = 5; context.stroke();
    context.strokeStyle = color; context.lineWidth = 2.6; context.stroke();
    return this.layerPlace();
  }

  /// Sets places on the ground with their elevations, metres.
  setElevations(elevations) { this.elevations = elevations; this.changed = true; }

  /// Dots from blue (low) over white to orange (high).
  drawElevations(c) {
    if (!this.elevations.length) return;
    const most = this.elevations.reduce((most, point) => Math.max(most, Math.abs(point[2])), 1e-3);
    const radius = Math.min(5, Math.max(1.5, .02 * this.view.scale));
    for (const [x, y, z] of this.elevations) {
      const px = this.toX(x), py = this.toY(y);
      if (px < -9 || py < -9 || px > this.width + 9 || py > this.height + 9) continue;
      const share = Math.round(100 * Math.abs(z) / most);
      c.fillStyle = `color-mix(in srgb, ${z < 0 ? "#2563eb" : "#e8590c"} ${share}%, #ffffff)`;
      c.fillRect(px - radius, py - radius, 2 * radius, 2 * radius);
    }
  }

  /// Sets the markers on the ground: x and y in metres, and the number.
  setMarkers(markers) { this.markers = markers; this.drawn = null; this.changed = true; }

  /// Black squares with a white border, with their numbers where there is room.
  drawMarkers(c) {
    c.font = "600 11px system-ui, sans-serif"; c.textBaseline = "middle";
    for (const [x, y, number] of this.markers) {
      const px = this.toX(x), py = this.toY(y);
      if (px < -20 || py < -20 || px > this.width + 20 || py > this.height + 20) continue;
      c.fillStyle = "#fff"; c.fillRect(px - 6, py - 6, 12, 12);
      c.fillStyle = "#000"; c.fillRect(px - 4.5, py - 4.5, 9, 9);
      if (this.view.scale < 20) continue;
      c.lineWidth = 3; c.strokeStyle = "#fff"; c.strokeText(number, px + 9, py); c.fillText(number, px + 9, py);
    }
  }

  drawGraph(c, dot, tie) {
    const { keyframes, loops } = this.graph, radius = Math.min(3, Math.max(1.2, .03 * this.view.scale));
    const inside = (x, y) => x > -20 && y > -20 && x < this.width + 20 && y < this.height + 20;
    c.strokeStyle = tie; c.lineWidth = 1.5; c.beginPath();
    for (const [from, to] of loops) {
      const [a, b] = [keyframes[from], keyframes[to]];
      c.moveTo(this.toX(a[0]), this.toY(a[1])); c.lineTo(this.toX(b[0]), this.toY(b[1]));
    }
    c.stroke();
    c.fillStyle = "#fff"; c.strokeStyle = dot; c.lineWidth = 1.5; c.beginPath();
    for (const [x, y] of keyframes) {
      const px = this.toX(x), py = this.toY(y);
      if (inside(px, py)) { c.moveTo(px + radius, py); c.arc(px, py, radius, 0, 7); }
    }
    c.fill(); c.stroke();
  }

  drawMarks(c, color, paper) {
    c.font = "600 12px system-ui, sans-serif"; c.textBaseline = "middle";
    const labels = [];
    for (const mark of this.marks) {
      if (mark.x_m === null) continue;
      // Current position of its frame, after loop closures.
      const moved = mark.record < this.track.count && Number.isFinite(this.track.get(mark.record, "x"));
      const x = this.toX(moved ? this.track.get(mark.record, "x") : mark.x_m), y = this.toY(moved ? this.track.get(mark.record, "y") : mark.y_m);
      c.fillStyle = color; c.strokeStyle = paper; c.lineWidth = 2;
      c.beginPath(); c.moveTo(x, y); c.lineTo(x - 6, y - 14); c.arc(x, y - 16, 6.3, Math.PI - .3, .3); c.closePath(); c.fill(); c.stroke();
      // Names of places close together, such as sessions with one start, stand above each other.
      const left = x + 10, right = left + c.measureText(mark.name).width;
      let line = y - 16;
      for (const label of labels) if (left < label.right && right > label.left && Math.abs(line - label.line) < 15) line = label.line - 15;
      labels.push({ left, right, line });
      c.strokeStyle = paper; c.lineWidth = 4; c.strokeText(mark.name, left, line); c.fillText(mark.name, left, line);
    }
  }

  drawCamera(c, k, now, color) {
    const t = this.track, x = this.toX(t.get(k, "x")), y = this.toY(t.get(k, "y")), heading = t.get(k, "heading");
    const [a, b, d] = ["varX", "covXY", "varY"].map(name => t.get(k, name));
    const middle = (a + d) / 2, spread = Math.hypot((a - d) / 2, b);
    // Scale of the 95 % ellipse of a bivariate normal distribution, in standard deviations.
    const radius = value => 2.4477 * Math.sqrt(Math.max(value, 0)) * this.view.scale;
    const main = now ? color("--path") : color("--bad");
    c.fillStyle = main;
    c.globalAlpha = .22; c.beginPath();
    c.ellipse(x, y, Math.max(radius(middle + spread), .5), Math.max(radius(middle - spread), .5), -.5 * Math.atan2(2 * b, a - d), 0, 7);
    c.fill();
    c.globalAlpha = .8; c.strokeStyle = main; c.lineWidth = 1; c.stroke(); c.globalAlpha = 1;
    c.save(); c.translate(x, y); c.rotate(-heading);
    c.beginPath(); c.moveTo(15, 0); c.lineTo(-9, 9); c.lineTo(-4, 0); c.lineTo(-9, -9); c.closePath();
    c.fillStyle = now ? "#ffc24b" : color("--bad"); c.strokeStyle = "#10161a"; c.lineWidth = 1.6; c.fill(); c.stroke();
    c.restore();
  }

  drawScale(c, ink, paper) {
    const length = this.round(110), px = length * this.view.scale, x = 16, y = this.height - 18;
    const text = length >= 1000 ? `${length / 1000} km` : length >= 1 ? `${length} m` : length >= .01 ? `${+(length * 100).toPrecision(2)} cm` : `${+(length * 1000).toPrecision(2)} mm`;
    c.lineCap = "round"; c.font = "600 12px system-ui, sans-serif"; c.textBaseline = "alphabetic";
    for (const [color, width] of [[paper, 5], [ink, 2]]) {
      c.strokeStyle = color; c.lineWidth = width;
      c.beginPath(); c.moveTo(x, y - 5); c.lineTo(x, y); c.lineTo(x + px, y); c.lineTo(x + px, y - 5); c.stroke();
    }
    c.strokeStyle = paper; c.lineWidth = 4; c.strokeText(text, x + 8, y - 7);
    c.fillStyle = ink; c.fillText(text, x + 8, y - 7);
  }
}
