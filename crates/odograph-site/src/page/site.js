// The page of a site: the paths of all robots over the mosaic, and a table of them.
"use strict";

const COLORS = ["#e6194b", "#3477eb", "#1a9641", "#f58231", "#911eb4", "#008b8b", "#b8860b", "#d6409f"];
const canvas = document.getElementById("map");
const context = canvas.getContext("2d");
let state = null;
let mosaic = null; // { image, metres, x, y }
let mosaicShown = -1;
let view = null; // { x, y, metres }: the middle, and metres of a pixel

function colorOf(robot) {
  const names = Object.keys(state.robots).sort();
  return COLORS[names.indexOf(robot) % COLORS.length];
}

function everything() {
  let box = null;
  const add = (x, y) => {
    box = box ? [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)] : [x, y, x, y];
  };
  for (const session of state.sessions) session.path.forEach(([x, y]) => add(x, y));
  if (mosaic) {
    const [left, top] = [mosaic.x - mosaic.metres / 2, mosaic.y + mosaic.metres / 2];
    add(left, top);
    add(left + mosaic.image.width * mosaic.metres, top - mosaic.image.height * mosaic.metres);
  }
  if (!box) return { x: 0, y: 0, metres: 0.01 };
  const width = Math.max(1, box[2] - box[0]), height = Math.max(1, box[3] - box[1]);
  const metres = 1.2 * Math.max(width / canvas.width, height / canvas.height);
  return { x: (box[0] + box[2]) / 2, y: (box[1] + box[3]) / 2, metres };
}

function place(x, y) {
  return [canvas.width / 2 + (x - view.x) / view.metres, canvas.height / 2 - (y - view.y) / view.metres];
}

function line(points) {
  context.beginPath();
  points.forEach(([x, y]) => context.lineTo(...place(x, y)));
  context.stroke();
}

function draw() {
  const scale = window.devicePixelRatio || 1;
  canvas.width = canvas.clientWidth * scale;
  canvas.height = canvas.clientHeight * scale;
  if (!state) return;
  const seen = view;
  view = view || everything();
  if (mosaic) {
    const [left, top] = place(mosaic.x - mosaic.metres / 2, mosaic.y + mosaic.metres / 2);
    const zoom = mosaic.metres / view.metres;
    context.drawImage(mosaic.image, left, top, mosaic.image.width * zoom, mosaic.image.height * zoom);
  }
  context.lineJoin = "round";
  // Below the paths, of which they show no more than that they meet.
  for (const [color, width] of [["#10161a66", 2.5], ["#ffffffb0", 1]]) {
    context.strokeStyle = color;
    context.lineWidth = width * scale;
    for (const [ax, ay, bx, by] of state.loops) line([[ax, ay], [bx, by]]);
  }
  for (const session of state.sessions) {
    context.setLineDash(session.connected ? [] : [6 * scale, 6 * scale]);
    // A light outline keeps the path visible on any ground.
    for (const [color, width] of [["#ffffffd0", 5], [colorOf(session.robot), 2.6]]) {
      context.strokeStyle = color;
      context.lineWidth = width * scale;
      line(session.path);
    }
    context.setLineDash([]);
    context.fillStyle = colorOf(session.robot);
    context.lineWidth = 2 * scale;
    const last = session.path[session.path.length - 1];
    if (!last || session.condition === "ended") continue;
    const [x, y] = place(last[0], last[1]);
    const along = (turn, far) => [x + far * Math.cos(last[2] + turn), y - far * Math.sin(last[2] + turn)];
    context.beginPath();
    context.moveTo(...along(0, 12 * scale));
    context.lineTo(...along(2.5, 9 * scale));
    context.lineTo(...along(-2.5, 9 * scale));
    context.closePath();
    context.fill();
    if (session.condition === "lost") {
      context.strokeStyle = "#c33";
      context.beginPath();
      context.arc(x, y, 18 * scale, 0, 2 * Math.PI);
      context.stroke();
    }
  }
  ruler(scale);
  view = seen;
}

// The scale bar: the longest round length within 120 pixels.
function ruler(scale) {
  const most = 120 * scale * view.metres, decade = 10 ** Math.floor(Math.log10(most));
  const metres = [5, 2, 1].map((times) => times * decade).find((round) => round <= most);
  const [unit, size] = [["km", 1000], ["m", 1], ["cm", 0.01]].find(([, size]) => metres > 0.999 * size) || ["mm", 0.001];
  const [left, bottom, width] = [16 * scale, canvas.height - 16 * scale, metres / view.metres];
  context.strokeStyle = context.fillStyle = getComputedStyle(document.body).color;
  context.lineWidth = 2 * scale;
  context.beginPath();
  for (const [x, y] of [[left, bottom - 6 * scale], [left, bottom], [left + width, bottom], [left + width, bottom - 6 * scale]]) context.lineTo(x, y);
  context.stroke();
  context.font = `${13 * scale}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.fillText(`${+(metres / size).toPrecision(2)} ${unit}`, left + width / 2, bottom - 8 * scale);
}

function cell(text, name) {
  const cell = document.createElement("td");
  cell.textContent = text;
  if (name) cell.className = name;
  return cell;
}

function list() {
  const rows = state.sessions.slice().reverse().map((session) => {
    const row = document.createElement("tr");
    const robot = state.robots[session.robot] || { state: "active" };
    const swatch = document.createElement("span");
    swatch.className = "swatch";
    swatch.style.background = colorOf(session.robot);
    const first = document.createElement("td");
    first.append(swatch);
    const merged = robot.state === "active" || robot.state === "trusted";
    let condition = merged ? session.condition : robot.state;
    if (merged && !session.connected) condition += ", not recognised yet";
    const told = cell(condition, merged ? session.condition : "quarantined");
    const why = merged ? session.doubt : robot.reason;
    if (why) {
      const reason = document.createElement("div");
      reason.className = "reason";
      reason.textContent = why;
      told.append(reason);
    }
    const name = cell(session.robot);
    name.title = session.source + ", session " + session.key;
    row.append(first, name, told, cell(session.keyframes + " of " + session.records), cell(session.loops));
    return row;
  });
  document.getElementById("robots").replaceChildren(...rows);
  const count = Object.keys(state.robots).length;
  document.getElementById("summary").textContent =
    `${count} robot${count === 1 ? "" : "s"}, ${state.loops.length} loop${state.loops.length === 1 ? "" : "s"} between them, version ${state.version} of the map`;
}

function ago(seconds) {
  const [size, unit] = [[3600, "h"], [60, "min"], [1, "s"]].find(([size]) => seconds >= size) || [1, "s"];
  return `${Math.floor(seconds / size)} ${unit} ago`;
}

// Requests that the site has refused: what they were sent with is not shown.
function listRefusals() {
  const items = state.refusals.map((refusal) => {
    const item = document.createElement("li");
    const times = refusal.count === 1 ? "once" : `${refusal.count} times`;
    const details = document.createElement("div");
    details.className = "reason";
    details.textContent = `${times} from ${refusal.address}, last ${ago(refusal.ago_s)}`;
    item.append(refusal.reason, details);
    return item;
  });
  document.getElementById("refusals").replaceChildren(...items);
  document.getElementById("refused").hidden = items.length === 0;
}

function problem(text) {
  const place = document.getElementById("problem");
  place.hidden = !text;
  place.textContent = text || "";
}

async function loadMosaic(version) {
  const answer = await fetch("mosaic.png");
  if (!answer.ok) return;
  mosaicShown = version;
  if (answer.status === 204) return; // nothing is rendered yet
  const [metres, x, y] = answer.headers.get("X-Placement").split(" ").map(Number);
  mosaic = { image: await createImageBitmap(await answer.blob()), metres, x, y };
}

async function look() {
  try {
    const answer = await fetch("state");
    if (!answer.ok) throw new Error(answer.statusText);
    state = await answer.json();
    list();
    listRefusals();
    problem(state.failure && "The site does not merge at the moment: " + state.failure);
    if (state.mosaic !== mosaicShown) await loadMosaic(state.mosaic);
  } catch (error) {
    problem("The site does not answer: " + error.message);
  }
  draw();
  setTimeout(look, 1000);
}

canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  if (!state) return;
  view = view || everything();
  view.metres *= Math.exp(event.deltaY / 400);
  draw();
}, { passive: false });
canvas.addEventListener("pointermove", (event) => {
  if (!event.buttons || !state) return;
  view = view || everything();
  const scale = window.devicePixelRatio || 1;
  view.x -= event.movementX * scale * view.metres;
  view.y += event.movementY * scale * view.metres;
  draw();
});
canvas.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || !state) return;
  const step = 60 * (window.devicePixelRatio || 1);
  const moved = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] }[event.key];
  const closer = { "+": 1 / 1.3, "=": 1 / 1.3, "-": 1.3 }[event.key];
  if (!moved && !closer && event.key !== "0") return;
  event.preventDefault();
  view = event.key === "0" ? null : view || everything();
  if (moved) {
    view.x += moved[0] * view.metres;
    view.y += moved[1] * view.metres;
  }
  if (closer) view.metres *= closer;
  draw();
});
canvas.addEventListener("dblclick", () => { view = null; draw(); });
window.addEventListener("resize", draw);
look();
