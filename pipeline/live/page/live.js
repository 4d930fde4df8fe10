// Draws what the server sends: binary messages (view.py) as numbers, board and traces; JSON (session.py) as words.
"use strict";
const WINDOW_S = 10, BIN_S = .02, GAP_S = .1, NUMBERS_N = 12, HEAD_BYTES_N = 16, TRACE_PX = 170;
const ARROW_UT = 300, ARROW_MM = 7; // a change of field of this is an arrow as long as chips are apart, a large one twice
const COLOURS = ["--link", "--ink", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#0072B2"]; // force, chips
const $ = (id) => document.getElementById(id);
const said = (id, text) => { if ($(id).textContent !== text) $(id).textContent = text; };
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);
const ink = (j) => { const name = COLOURS[j ? 1 + (j - 1) % (COLOURS.length - 1) : 0]; return name.startsWith("--") ? colour(name) : name; };
let socket, state = {waiting: true, alarms: []}, last = null, rows = [], dirty = false;

function connect() {
  socket = new WebSocket(location.href.replace(/^http/, "ws").replace(/\/(\?.*)?(#.*)?$/, "/live$1"));
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({data}) => { typeof data === "string" ? show(JSON.parse(data)) : take(data); };
  socket.onclose = () => { show({waiting: true, what: "the server does not answer; trying again", alarms: []}); setTimeout(connect, 1000); };
}

function take(data) {
  const view = new DataView(data), chips = view.getUint16(4, true), bins = view.getUint16(6, true);
  const values = new Float32Array(data, HEAD_BYTES_N), width = 1 + chips, first = NUMBERS_N + 3 * chips;
  const [x, y, force, sdX, sdY, contact, rate, lost, estimate50, estimate99, screen50, screen99] = values;
  last = {id: view.getUint32(0, true), chips, x, y, force, sdX, sdY, contact, rate, lost, estimate50, estimate99, screen50,
    screen99, change: values.slice(NUMBERS_N, first)};
  if (bins) { // the last bin that we have may have grown: it comes again
    const low = first + bins, high = low + bins * width, from = values[first] - 1e-3;
    while (rows.length && rows[rows.length - 1].t >= from) rows.pop();
    for (let i = 0; i < bins; i++) rows.push({t: values[first + i], low: values.slice(low + i * width, low + (i + 1) * width),
      high: values.slice(high + i * width, high + (i + 1) * width)});
    const oldest = rows[rows.length - 1].t - WINDOW_S;
    rows = rows.slice(Math.max(rows.findIndex((row) => row.t >= oldest), 0));
  }
  dirty = true;
}

function show(next) {
  state = next;
  said("what", state.waiting ? `${state.what || ""}: waiting for data` : state.what);
  said("about", state.waiting ? "" : `${state.board}. ${state.places_known ? "" : "Places of its chips are not known: drawn in a row. "}` +
    (state.model ? `Model: ${state.model}.` : "No model: neither place nor force; try --model."));
  list("alarms", state.alarms);
  list("seen", (state.seen || []).map(([name, n, s]) => `${name}: ${n}, within ${s} s`));
  $("zero").disabled = $("record").disabled = state.waiting;
  $("adapt").disabled = state.waiting || !state.adaptable;
  $("adapt").classList.toggle("on", Boolean(state.adapting));
  said("adapting", state.adapting || state.adapted || "–");
  $("record").classList.toggle("on", Boolean(state.recording));
  $("record").firstChild.textContent = state.recording ? "Stop " : "Record ";
  said("recording", state.recording || state.recorded || "–");
  if (state.waiting) { last = null; rows = []; }
  dirty = true;
}

function list(id, lines) {
  $(id).replaceChildren(...lines.map((line) => Object.assign(document.createElement("li"), {textContent: line})));
}

function canvasOf(id, high) { // a pen in CSS pixels, on a canvas that is as sharp as the screen
  const canvas = $(id), ratio = devicePixelRatio || 1, wide = canvas.clientWidth;
  canvas.style.height = `${high}px`; canvas.width = wide * ratio; canvas.height = high * ratio;
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.font = "13px system-ui, sans-serif"; pen.lineWidth = 1.5;
  return [pen, wide];
}

function drawTrace(id, first, count, least) { // of each bin the least and the greatest, one after the other
  const [pen, wide] = canvasOf(id, TRACE_PX), left = 44, bottom = 20, high = TRACE_PX - bottom - 6, end = rows[rows.length - 1].t;
  let top = least;
  for (const row of rows) for (let j = first; j < first + count; j++) if (row.high[j] > top) top = row.high[j];
  const step = [1, 2, 5, 10].map((n) => n * 10 ** Math.floor(Math.log10(top / 3))).find((n) => top / n <= 5);
  const px = (t) => wide - (end - t) / WINDOW_S * (wide - left), py = (value) => 6 + high * (1 - value / (top * 1.05));
  pen.strokeStyle = colour("--line"); pen.fillStyle = colour("--soft"); pen.textAlign = "right";
  for (let value = 0; value <= top; value += step) { pen.strokeRect(left, py(value), wide, 0); pen.fillText(+value.toPrecision(3), left - 6, py(value) + 4); }
  for (let s = 0; s <= WINDOW_S; s += 2) pen.fillText(s ? `−${s} s` : "now", Math.max(px(end - s), left + 20), TRACE_PX - 4);
  for (let j = first; j < first + count; j++) {
    let before = -Infinity;
    pen.strokeStyle = ink(j); pen.beginPath();
    for (const {t, low, high} of rows) {
      if (Number.isNaN(low[j])) continue;
      t - before > GAP_S ? pen.moveTo(px(t), py(low[j])) : pen.lineTo(px(t), py(low[j]));
      pen.lineTo(px(t + BIN_S / 2), py(high[j]));
      before = t;
    }
    pen.stroke();
  }
}

function drawBoard() {
  const [wide, high] = state.skin_mm || [20, 20], [left, bottom] = state.corner_mm || [-2, -2], margin = 12;
  const scale = Math.min(($("board").clientWidth - 2 * margin) / wide, (innerHeight * .8 - 2 * margin) / high);
  const [pen] = canvasOf("board", high * scale + 2 * margin);
  const at = (x, y) => [margin + (x - left) * scale, margin + (bottom + high - y) * scale];
  pen.fillStyle = colour("--skin"); pen.strokeStyle = colour("--line");
  pen.fillRect(margin, margin, wide * scale, high * scale); pen.strokeRect(margin, margin, wide * scale, high * scale);
  if (state.waiting) { pen.fillStyle = colour("--soft"); pen.textAlign = "center"; pen.fillText("waiting for data", margin + wide * scale / 2, margin + high * scale / 2); return; }
  pen.lineWidth = 2;
  state.chips_mm.forEach(([x, y], i) => {
    const [px, py] = at(x, y), side = Math.max(1.5 * scale, 8);
    pen.strokeStyle = colour("--soft"); pen.strokeRect(px - side / 2, py - side / 2, side, side);
    pen.fillStyle = ink(i + 1); pen.textAlign = "left"; pen.fillText(`${i}`, px + side / 2 + 3, py + side / 2 + 10);
    if (last && last.chips === state.chips_mm.length) arrow(pen, px, py, last.change.subarray(3 * i, 3 * i + 3), scale);
  });
  if (last && last.contact && !Number.isNaN(last.x)) {
    const [px, py] = at(last.x, last.y), blue = colour("--link");
    if (!Number.isNaN(last.sdX)) { pen.strokeStyle = blue; pen.beginPath(); pen.ellipse(px, py, Math.max(2 * last.sdX * scale, 1), Math.max(2 * last.sdY * scale, 1), 0, 0, 7); pen.stroke(); }
    pen.fillStyle = blue; pen.beginPath(); pen.arc(px, py, 5 + 6 * Math.sqrt(Math.max(last.force, 0)), 0, 7); pen.fill();
  }
}

function arrow(pen, px, py, [bx, by, bz], scale) { // in the plane; a ring is the part along z
  const size = 2 * ARROW_MM * scale / (ARROW_UT + Math.hypot(bx, by, bz)), dx = bx * size, dy = -by * size, long = Math.hypot(dx, dy), turn = Math.atan2(dy, dx);
  pen.strokeStyle = colour("--ink");
  pen.beginPath(); pen.arc(px, py, Math.abs(bz) * size, 0, 7); pen.setLineDash(bz < 0 ? [3, 3] : []); pen.stroke(); pen.setLineDash([]);
  if (!(long > 3)) return;
  pen.beginPath(); pen.moveTo(px, py); pen.lineTo(px + dx, py + dy);
  for (const side of [2.6, -2.6]) { pen.moveTo(px + dx, py + dy); pen.lineTo(px + dx + 7 * Math.cos(turn + side), py + dy + 7 * Math.sin(turn + side)); }
  pen.stroke();
}

function number(value, digits, unit) { return value === undefined || Number.isNaN(value) ? "–" : `${value.toFixed(digits)} ${unit}`; }

function draw() {
  if (dirty) {
    dirty = false;
    drawBoard();
    if (last && rows.length) {
      drawTrace("forces", 0, 1, .5); drawTrace("fields", 1, last.chips, 50);
      const sure = Number.isNaN(last.sdX) ? "" : ` ± ${last.sdX.toFixed(1)}, ${last.sdY.toFixed(1)} mm${state.adaptable ? "" : " between models"}`;
      said("place", last.contact && !Number.isNaN(last.x) ? `x ${number(last.x, 1, "mm")}, y ${number(last.y, 1, "mm")}${sure}` : last.contact ? "contact" : "no contact");
      said("force", number(last.force, 2, "N"));
      said("rate", number(last.rate, 0, "Hz")); said("lost", number(last.lost, 0, ""));
      said("estimate", `${number(last.estimate50, 1, "ms")} (median), ${number(last.estimate99, 1, "ms")} (99 %)`);
      said("screen", `${number(last.screen50, 0, "ms")} (median), ${number(last.screen99, 0, "ms")} (99 %)`);
      const id = last.id;
      if (!document.hidden) requestAnimationFrame(() => { if (socket.readyState === 1) socket.send(JSON.stringify({seen: id})); }); // drawn by then
    } else ["place", "force", "rate", "lost", "estimate", "screen"].forEach((id) => said(id, "–"));
  }
  requestAnimationFrame(draw);
}

const press = (name) => { if (socket.readyState === 1 && !$(name).disabled) socket.send(JSON.stringify({press: name})); };
for (const name of ["zero", "adapt", "record"]) $(name).addEventListener("click", () => press(name));
addEventListener("keydown", (event) => {
  const name = {z: "zero", a: "adapt", r: "record"}[event.key];
  if (name && !event.ctrlKey && !event.metaKey && !event.altKey && !event.repeat) press(name);
});
addEventListener("resize", () => { dirty = true; });
connect();
draw();
