// Small plots over time. Each pixel column shows the minimum and maximum of its frames, so that
// short peaks stay visible.

// Height above the curve for the label of its largest value, pixels.
const LABEL_PX = 12;

export class Plots {
  constructor(parent, track, live, seek) {
    this.track = track;
    this.plots = [
      { name: "speed", unit: "m/s", field: "speed", digits: 2, from0: true },
      { name: "uncertainty (1σ)", unit: "mm", digits: 1, from0: true, value: k => 1000 * Math.sqrt(Math.max(track.get(k, "varX"), track.get(k, "varY"))) },
      { name: "inliers", unit: "", field: "inliers", digits: 0, from0: true },
      ...(live ? [{ name: "latency", unit: "ms", field: "latency", digits: 1, from0: true }] : []),
    ];
    for (const plot of this.plots) {
      const figure = document.createElement("figure");
      figure.innerHTML = "<figcaption><span></span><span></span></figcaption><canvas role='img'></canvas>";
      figure.querySelector("span").textContent = plot.name;
      plot.label = figure.querySelectorAll("span")[1];
      plot.canvas = figure.querySelector("canvas");
      plot.canvas.setAttribute("aria-label", `${plot.name} over time`);
      plot.canvas.addEventListener("pointerdown", event => {
        const [from, to] = this.span;
        if (this.track.count) seek(this.track.at(from + (to - from) * event.offsetX / plot.canvas.clientWidth));
      });
      parent.append(figure);
    }
    this.span = [0, 1];
  }

  /// Removes a plot without data: a map contains only poses.
  drop(name) {
    this.plots = this.plots.filter(plot => plot.name !== name || (plot.canvas.parentElement.remove(), false));
  }

  /// Draws the interval between two times, seconds, with the position of record `at`.
  draw(from, to, at) {
    this.span = [from, to];
    const style = getComputedStyle(document.documentElement), color = name => style.getPropertyValue(name).trim();
    for (const plot of this.plots) this.drawOne(plot, from, to, at, color);
  }

  drawOne(plot, from, to, at, color) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2), { canvas } = plot;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width) return;
    canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
    const c = canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    const t = this.track, value = plot.value || (k => t.get(k, plot.field));
    const least = new Float32Array(Math.ceil(width)).fill(Infinity), most = new Float32Array(Math.ceil(width)).fill(-Infinity);
    // Columns with a loss, over which no curve is drawn.
    const lost = new Uint8Array(Math.ceil(width));
    let high = -Infinity;
    const first = t.at(from), last = t.at(to), stride = Math.max(1, Math.floor((last - first) / 20000));
    for (let k = first; k < last + 1 && k < t.count; k += stride) {
      const v = value(k), column = Math.floor((t.get(k, "t") - from) / (to - from) * (width - 1));
      if (column >= 0 && !Number.isFinite(t.get(k, "x"))) lost[column] = 1;
      if (!Number.isFinite(v) || column < 0) continue;
      least[column] = Math.min(least[column], v); most[column] = Math.max(most[column], v);
      high = Math.max(high, v);
    }
    c.fillStyle = color("--bad"); c.globalAlpha = .18;
    for (let k = first; k <= last && k < t.count; k += stride) if (t.get(k, "state") > 0) c.fillRect((t.get(k, "t") - from) / (to - from) * (width - 1), 0, 1.5, height);
    c.globalAlpha = 1;
    c.strokeStyle = color("--line"); c.lineWidth = 1; c.beginPath(); c.moveTo(0, height - .5); c.lineTo(width, height - .5); c.stroke();
    const now = t.count ? value(Math.min(at, t.count - 1)) : NaN;
    plot.label.textContent = Number.isFinite(now) ? `${now.toFixed(plot.digits)} ${plot.unit}` : "–";
    if (!(high > 0)) return;
    const y = v => height - 2 - (height - 2 - LABEL_PX) * v / high;
    c.strokeStyle = color("--path"); c.lineWidth = 1.4; c.lineJoin = "round"; c.beginPath();
    let pen = false;
    for (let x = 0; x < width; x++) {
      if (most[x] === -Infinity) { pen = pen && !lost[x]; continue; }
      if (pen) c.lineTo(x, y(most[x])); else c.moveTo(x, y(most[x]));
      if (least[x] !== most[x]) c.lineTo(x, y(least[x]));
      pen = true;
    }
    c.stroke();
    c.fillStyle = color("--soft"); c.font = "10px system-ui, sans-serif"; c.fillText(`${high.toFixed(plot.digits)}`, 2, LABEL_PX - 3);
    const x = (t.get(Math.min(at, t.count - 1), "t") - from) / (to - from) * (width - 1);
    c.strokeStyle = color("--ink"); c.globalAlpha = .5; c.lineWidth = 1; c.beginPath(); c.moveTo(x, 0); c.lineTo(x, height); c.stroke(); c.globalAlpha = 1;
  }
}
