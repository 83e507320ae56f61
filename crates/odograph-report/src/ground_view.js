// Pans and zooms the path over the ground, and links it with the plots: the frame pointed at in one
// is highlighted in all. Without JavaScript the same elements are a still picture with its layers.
(() => {
  const frames = JSON.parse(document.getElementById("frames").textContent);
  const [TIME, X, Y, HEADING, SIGMA_M, SIGMA_DEG, RESIDUAL] = [0, 1, 2, 3, 4, 5, 6];
  const readouts = document.querySelectorAll(".readout");
  const followers = [];

  const fixed = (value, digits) => value === null ? "–" : (+value.toFixed(digits) || 0).toFixed(digits).replace("-", "−");
  const length = metres => metres >= 1 ? `${fixed(metres, 2)} m` : `${fixed(1000 * metres, metres >= 0.1 ? 0 : 2)} mm`;
  const described = row => `${fixed(row[TIME], 2)} s: x ${fixed(row[X], 3)} m, y ${fixed(row[Y], 3)} m, ± ${length(row[SIGMA_M])}; ` +
    `heading ${fixed(row[HEADING], 1)}° ± ${fixed(row[SIGMA_DEG], 2)}°; residual ${fixed(row[RESIDUAL], 2)} px`;

  let chosen = -1;
  function choose(index) {
    chosen = index;
    const row = frames.rows[index];
    readouts.forEach(readout => { readout.textContent = row ? described(row) : readout.dataset.hint; });
    followers.forEach(follow => follow(row));
  }

  /// The row nearest in time.
  function at(time) {
    let low = 0, high = frames.rows.length - 1;
    while (high > low) {
      const middle = (low + high) >> 1;
      if (frames.rows[middle + 1][TIME] + frames.rows[middle][TIME] > 2 * time) high = middle; else low = middle + 1;
    }
    return low;
  }

  function step(by) {
    choose(Math.max(0, Math.min(frames.rows.length - 1, chosen < 0 ? 0 : chosen + by)));
  }

  // ---- plots

  const { left, right, top, bottom, span } = frames.axis;
  for (const plot of document.querySelectorAll("svg.plot")) {
    const line = document.createElementNS(plot.namespaceURI, "line");
    line.setAttribute("class", "now");
    line.setAttribute("y1", top);
    line.setAttribute("y2", bottom);
    line.style.display = "none";
    plot.append(line);
    followers.push(row => {
      line.style.display = row ? "" : "none";
      if (!row) return;
      const x = left + (right - left) * row[TIME] / span;
      line.setAttribute("x1", x);
      line.setAttribute("x2", x);
    });
    const point = event => {
      const box = plot.getBoundingClientRect();
      const x = (event.clientX - box.left) * plot.viewBox.baseVal.width / box.width;
      choose(at(span * (x - left) / (right - left)));
    };
    plot.addEventListener("pointermove", point);
    plot.addEventListener("pointerdown", point);
  }

  // ---- the ground

  const view = document.querySelector(".view");
  if (view) show(view);
  choose(-1);

  function show(view) {
    const NEAR_PX = 40, MOST_ZOOM = 40;
    const over = view.querySelector(".over"), svg = over.querySelector("svg");
    const { width, height } = svg.viewBox.baseVal;
    const origin = { x: +view.dataset.x, y: +view.dataset.y, metres: +view.dataset.metres };
    const toPixel = row => [(row[X] - origin.x) / origin.metres, (origin.y - row[Y]) / origin.metres];
    let zoom = 1, middle = [0.5, 0.5], fit = 1, box = { width: 1, height: 1 };

    const ruler = document.createElement("div");
    ruler.className = "ruler";

    const here = document.createElementNS(svg.namespaceURI, "path");
    here.setAttribute("class", "here");
    svg.append(here);
    followers.push(row => {
      if (!row) return here.removeAttribute("d");
      const [x, y] = toPixel(row), angle = row[HEADING] * Math.PI / 180, long = 22 / (fit * zoom);
      here.setAttribute("d", `M${x} ${y}h0M${x} ${y}l${long * Math.cos(angle)} ${-long * Math.sin(angle)}`);
    });

    function place() {
      const scale = fit * zoom;
      const half = [0.5 * box.width / (width * scale), 0.5 * box.height / (height * scale)];
      middle = middle.map((at, k) => half[k] >= 0.5 ? 0.5 : Math.max(half[k], Math.min(1 - half[k], at)));
      over.style.width = `${width * scale}px`;
      over.style.height = `${height * scale}px`;
      over.style.left = `${0.5 * box.width - middle[0] * width * scale}px`;
      over.style.top = `${0.5 * box.height - middle[1] * height * scale}px`;
      svg.style.setProperty("--unit", 1 / scale);
      measure(origin.metres / scale);
      view.style.touchAction = zoom > 1 ? "none" : "pan-y";
      if (chosen >= 0) choose(chosen);
    }

    /// The scale bar: the longest round length that fits, at this many metres a pixel of the screen.
    function measure(metres) {
      const most = metres * Math.min(140, 0.4 * box.width), decade = 10 ** Math.floor(Math.log10(most));
      const bar = [5, 2, 1].map(times => times * decade).find(round => round <= most);
      const [unit, size] = [["km", 1000], ["m", 1], ["cm", 0.01], ["mm", 0.001]].find(([, size]) => bar > 0.999 * size) ?? ["mm", 0.001];
      ruler.textContent = `${+(bar / size).toPrecision(2)} ${unit}`;
      ruler.style.width = `${bar / metres}px`;
    }

    function resize() {
      const wide = view.clientWidth, tall = Math.max(240, Math.min(wide * height / width, 0.75 * innerHeight));
      view.style.height = `${tall}px`;
      box = { width: wide, height: tall };
      fit = Math.min(wide / width, tall / height);
      place();
    }

    function zoomBy(factor, x = 0.5 * box.width, y = 0.5 * box.height) {
      const before = fit * zoom;
      zoom = Math.max(1, Math.min(MOST_ZOOM, zoom * factor));
      const off = 1 / before - 1 / (fit * zoom);
      middle[0] += (x - 0.5 * box.width) * off / width;
      middle[1] += (y - 0.5 * box.height) * off / height;
      place();
    }

    function panBy(dx, dy) {
      middle[0] -= dx / (width * fit * zoom);
      middle[1] -= dy / (height * fit * zoom);
      place();
    }

    function whole() {
      zoom = 1;
      place();
    }

    function point(event) {
      const box = svg.getBoundingClientRect();
      const x = (event.clientX - box.left) / (fit * zoom) - 0.5, y = (event.clientY - box.top) / (fit * zoom) - 0.5;
      let nearest = -1, least = NEAR_PX / (fit * zoom);
      frames.rows.forEach((row, index) => {
        const [u, v] = toPixel(row), distance = Math.hypot(u - x, v - y);
        if (distance < least) [nearest, least] = [index, distance];
      });
      if (nearest >= 0) choose(nearest);
    }

    const fingers = new Map();
    view.addEventListener("pointerdown", event => {
      if (event.target.closest("button")) return;
      view.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, event);
      point(event);
    });
    for (const name of ["pointerup", "pointercancel"]) view.addEventListener(name, event => fingers.delete(event.pointerId));
    view.addEventListener("pointermove", event => {
      const before = fingers.get(event.pointerId);
      if (!before) return point(event);
      if (fingers.size === 2) {
        const other = [...fingers.values()].find(finger => finger.pointerId !== event.pointerId);
        const distance = finger => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY);
        const corner = view.getBoundingClientRect();
        zoomBy(distance(event) / Math.max(distance(before), 1), 0.5 * (event.clientX + other.clientX) - corner.left,
          0.5 * (event.clientY + other.clientY) - corner.top);
      }
      panBy((event.clientX - before.clientX) / fingers.size, (event.clientY - before.clientY) / fingers.size);
      fingers.set(event.pointerId, event);
    });
    view.addEventListener("wheel", event => {
      // Where nothing is left to zoom out, the page scrolls.
      if (event.deltaY > 0 && zoom === 1) return;
      event.preventDefault();
      const corner = view.getBoundingClientRect();
      zoomBy(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0016)), event.clientX - corner.left, event.clientY - corner.top);
    }, { passive: false });
    view.addEventListener("keydown", event => {
      const act = {
        ArrowLeft: () => panBy(60, 0), ArrowRight: () => panBy(-60, 0), ArrowUp: () => panBy(0, 60), ArrowDown: () => panBy(0, -60),
        "+": () => zoomBy(1.3), "=": () => zoomBy(1.3), "-": () => zoomBy(1 / 1.3), 0: whole, ",": () => step(-1), ".": () => step(1),
      }[event.key];
      if (!act || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      act();
    });

    const tools = document.createElement("div");
    tools.className = "tools";
    for (const [text, name, act] of [["+", "Closer", () => zoomBy(1.5)], ["−", "Farther", () => zoomBy(1 / 1.5)], ["All", "Show all", whole]]) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = text;
      button.title = name;
      button.setAttribute("aria-label", name);
      button.addEventListener("click", act);
      tools.append(button);
    }
    view.append(tools, ruler);
    view.tabIndex = 0;
    view.classList.add("movable");
    addEventListener("resize", resize);
    resize();
  }
})();
