// Progress of a calibration: image coverage by the board, and which view to show next.

const $ = id => document.getElementById(id);

export class Calibration {
  constructor(camera) {
    this.told = null;
    camera.overlay = (context, width, height) => this.drawCoverage(context, width, height);
  }

  show(told) {
    this.told = told;
    const say = (id, text) => { if ($(id).textContent !== text) $(id).textContent = text; };
    say("board-name", told.board);
    say("views", told.views);
    say("with-board", told.with_board);
    say("looked-at", told.looked_at);
    const cells = told.coverage.length, seen = told.coverage.filter(points => points > 0).length;
    say("covered", cells ? Math.round(100 * seen / cells) : 0);
    $("covered-bar").value = cells ? seen / cells : 0;
    const items = told.missing.slice(0, 6);
    if ([...$("missing").children].map(item => item.textContent).join("|") !== items.join("|")) {
      $("missing").replaceChildren(...items.map(text => { const item = document.createElement("li"); item.textContent = text; return item; }));
    }
    say("next", this.next());
    $("tried").hidden = !told.tried;
    say("tried", told.tried ? `${told.verdict ? "Result" : "Last trial"}: ${told.tried}` : "");
    document.body.dataset.views = told.views;
    document.body.dataset.missing = told.missing.length;
    document.body.dataset.verdict = told.verdict || "";
  }

  next() {
    const told = this.told;
    if (told.verdict) return told.verdict === "good" ? "Done: the camera is calibrated." : told.verdict === "usable" ? "Done, and usable." : "Please repeat it.";
    if (told.trying) return "Checking the calibration …";
    if (told.missing.length) return "Next";
    return told.views ? "Nothing is missing; a few more views improve it." : "Show the board.";
  }

  /// Shows the detected board, or the reason why none was detected.
  state() {
    const told = this.told;
    if (!told) return ["waiting for frames", "wait"];
    return told.why ? [told.why, "warn"] : ["board seen", "good"];
  }

  drawCoverage(c, width, height) {
    const told = this.told;
    if (!told) return;
    const w = width / told.columns, h = height / told.rows;
    c.save();
    for (let k = 0; k < told.columns * told.rows; k++) {
      const points = told.coverage[k] || 0, x = k % told.columns * w, y = Math.floor(k / told.columns) * h;
      c.fillStyle = points ? `rgb(39 208 138 / ${Math.min(.1 + .02 * points, .34)})` : "rgb(0 0 0 / .3)";
      c.fillRect(x, y, w, h);
    }
    c.strokeStyle = "rgb(255 255 255 / .28)"; c.lineWidth = 1; c.beginPath();
    for (let k = 1; k < told.columns; k++) { c.moveTo(k * w, 0); c.lineTo(k * w, height); }
    for (let k = 1; k < told.rows; k++) { c.moveTo(0, k * h); c.lineTo(width, k * h); }
    c.stroke();
    c.restore();
  }
}
