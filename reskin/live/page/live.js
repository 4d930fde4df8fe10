// Displays the messages of reskin/live/session.py: binary messages (Traces.message) as numbers, a picture of the board, and traces;
// JSON messages (Session.state) as texts. Each board has its own socket, state and canvases, so that an unplugged board does not
// affect the other boards.
"use strict";
const NUMBERS_N = 12, HEAD_BYTES_N = 16, RETRY_MS = 1000, DRAWING_MS = 12;
const ARROW_UT = 300, ARROW_MM = 4, MARGIN_PX = 20; // a field change of ARROW_UT has an arrow of length ARROW_MM; the length tends to 2 ARROW_MM for large field changes
const COLOURS = ["--link", "--ink", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#0072B2"]; // the colour of the force trace, then those of the chips
const style = getComputedStyle(document.documentElement); // a live object, which follows changes of the colour scheme
const colour = (name) => style.getPropertyValue(name);
const ink = (j) => { const name = COLOURS[j ? 1 + (j - 1) % (COLOURS.length - 1) : 0]; return name.startsWith("--") ? colour(name) : name; };
const number = (value, digits, unit) => value === undefined || Number.isNaN(value) ? "–" : `${value.toFixed(digits)} ${unit}`;
const boards = [];
let next = 0;

class Board {
  constructor(index) {
    this.index = index; this.state = {waiting: true, alarms: []}; this.last = null; this.rows = []; this.changed = Infinity; this.dirty = true;
    const article = document.getElementById("board").content.cloneNode(true).firstElementChild;
    this.parts = Object.fromEntries([...article.querySelectorAll("[data-part]")].map((part) => [part.dataset.part, part]));
    this.traces = [new Trace(this.parts.forces, 0, .5), new Trace(this.parts.fields, 1, 50)];
    document.getElementById("boards").append(article);
    for (const name of ["zero", "adapt", "places", "record"]) this.parts[name].addEventListener("click", () => this.press(name));
    this.connect();
  }

  connect() {
    const address = new URL("live" + location.search, location.href);
    address.protocol = address.protocol.replace("http", "ws"); address.hash = ""; address.searchParams.set("board", this.index);
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({data}) => { typeof data === "string" ? this.show(JSON.parse(data)) : this.take(data); };
    this.socket.onclose = () => { this.show({waiting: true, what: "the server does not answer; trying again", alarms: []}); setTimeout(() => this.connect(), RETRY_MS); };
  }

  press(name) { if (this.socket.readyState === 1 && !this.parts[name].disabled) this.socket.send(JSON.stringify({press: name})); }

  say(name, text) { if (this.parts[name].textContent !== text) this.parts[name].textContent = text; }

  list(name, lines) {
    this.parts[name].replaceChildren(...lines.map((line) => Object.assign(document.createElement("li"), {textContent: line})));
  }

  take(data) {
    const view = new DataView(data), chips = view.getUint16(4, true), bins = view.getUint16(6, true);
    const values = new Float32Array(data, HEAD_BYTES_N), width = 1 + chips, first = NUMBERS_N + 3 * chips;
    const [x, y, force, sdX, sdY, contact, rate, lost, estimate50, estimate99, screen50, screen99] = values;
    this.last = {id: view.getUint32(0, true), chips, x, y, force, sdX, sdY, contact, rate, lost, estimate50, estimate99, screen50,
      screen99, change: values.slice(NUMBERS_N, first)};
    if (bins) { // the newest bin of the previous message may have changed, so it is sent again
      const low = first + bins, high = low + bins * width, t = view.getFloat64(8, true), bin = (i) => Math.round((t + values[first + i]) / BIN_S);
      while (this.rows.length && this.rows[this.rows.length - 1].n >= bin(0)) this.rows.pop();
      for (let i = 0; i < bins; i++) this.rows.push({n: bin(i), low: values.slice(low + i * width, low + (i + 1) * width),
        high: values.slice(high + i * width, high + (i + 1) * width)});
      const oldest = bin(bins - 1) - WINDOW_S / BIN_S - GAP_BINS_N - 1; // oldest bin from which a line can reach into the window
      this.rows = this.rows.slice(Math.max(this.rows.findIndex(({n}) => n >= oldest), 0));
      this.changed = Math.min(this.changed, bin(0));
    }
    this.dirty = true;
  }

  show(next) {
    const state = this.state = next;
    this.say("what", state.waiting ? `${state.what || ""}: waiting for data` : state.what);
    this.say("about", state.waiting ? "" : `${state.board}. ${state.places_known ? "" : "The positions of its chips are unknown; they are drawn in a row. "}` +
      (state.model ? `Model: ${state.model}.` : "No model, so no place or force. To load one, use --model."));
    this.list("alarms", state.alarms);
    this.list("seen", (state.seen || []).map(([name, n, s]) => `${name}: ${n} in ${s} s`));
    this.parts.zero.disabled = this.parts.record.disabled = state.waiting;
    for (const name of ["adapt", "places"]) {
      this.parts[name].disabled = state.waiting || !state.adaptable || Boolean(state.adapting) && name !== this.chosen(state);
      this.parts[name].classList.toggle("on", Boolean(state.adapting) && name === this.chosen(state));
    }
    this.say("adapting", state.adapting || state.adapted || "–");
    this.parts.record.classList.toggle("on", Boolean(state.recording));
    this.parts.record.firstChild.textContent = state.recording ? "Stop " : "Record ";
    this.say("recording", state.recording || state.recorded || "–");
    if (state.waiting) { this.last = null; this.rows = []; }
    this.dirty = true;
  }

  chosen(state) { return state.next_mm ? "places" : "adapt"; }

  drawBoard() {
    const {state, last} = this; // if the board is silent, the last reading is outdated and is not drawn
    const [wide, high] = state.skin_mm || [20, 20], [left, bottom] = state.corner_mm || [-2, -2], margin = MARGIN_PX;
    const scale = Math.max(Math.min((this.parts.board.clientWidth - 2 * margin) / wide, (innerHeight * .8 - 2 * margin) / high), .1); // a hidden window has height 0
    const [pen] = penOn(this.parts.board, high * scale + 2 * margin);
    const at = (x, y) => [margin + (x - left) * scale, margin + (bottom + high - y) * scale];
    pen.fillStyle = colour("--skin"); pen.strokeStyle = colour("--line");
    pen.fillRect(margin, margin, wide * scale, high * scale); pen.strokeRect(margin, margin, wide * scale, high * scale);
    if (state.waiting) { pen.fillStyle = colour("--soft"); pen.textAlign = "center"; pen.fillText("waiting for data", margin + wide * scale / 2, margin + high * scale / 2); return; }
    pen.lineWidth = 2;
    state.chips_mm.forEach(([x, y], i) => {
      const [px, py] = at(x, y), side = Math.max(1.5 * scale, 8);
      pen.strokeStyle = ink(i + 1); pen.strokeRect(px - side / 2, py - side / 2, side, side); // same colour as the chip's trace
      pen.fillStyle = colour("--soft"); pen.textAlign = "left"; pen.fillText(`${i}`, px + side / 2 + 3, py + side / 2 + 10);
      if (last && !state.silent && last.chips === state.chips_mm.length) arrow(pen, px, py, last.change.subarray(3 * i, 3 * i + 3), scale);
    });
    if (state.next_mm) {
      const [px, py] = at(...state.next_mm), size = Math.max(1.2 * scale, 10);
      pen.strokeStyle = colour("--alarm"); pen.lineWidth = 3; pen.beginPath(); pen.arc(px, py, size, 0, 7);
      for (const [dx, dy] of [[1, 0], [0, 1]]) { pen.moveTo(px - 1.5 * size * dx, py - 1.5 * size * dy); pen.lineTo(px + 1.5 * size * dx, py + 1.5 * size * dy); }
      pen.stroke(); pen.lineWidth = 2;
    }
    if (last && !state.silent && last.contact && !Number.isNaN(last.x)) {
      const [px, py] = at(last.x, last.y), blue = colour("--link");
      if (!Number.isNaN(last.sdX)) { pen.strokeStyle = blue; pen.beginPath(); pen.ellipse(px, py, Math.max(2 * last.sdX * scale, 1), Math.max(2 * last.sdY * scale, 1), 0, 0, 7); pen.stroke(); }
      pen.fillStyle = blue; pen.beginPath(); pen.arc(px, py, 5 + 6 * Math.sqrt(Math.max(last.force, 0)), 0, 7); pen.fill();
    }
  }

  draw() {
    if (!this.dirty) return;
    this.dirty = false;
    this.drawBoard();
    const {state, last} = this;
    if (!last || state.silent || !this.rows.length) { for (const name of ["place", "force", "rate", "lost", "estimate", "screen"]) this.say(name, "–"); return; }
    const more = this.traces.map((trace, i) => trace.draw(this.rows, this.changed, i ? last.chips : 1));
    this.changed = Infinity; this.dirty = more.includes(true);
    const sure = (sd) => Number.isNaN(sd) ? "" : ` ± ${sd.toFixed(1)}`, among = Number.isNaN(last.sdX) || state.adaptable ? "" : " between models";
    this.say("place", last.contact && !Number.isNaN(last.x) ? `x ${last.x.toFixed(1)}${sure(last.sdX)}, y ${last.y.toFixed(1)}${sure(last.sdY)} mm${among}` : last.contact ? "contact" : "no contact");
    this.say("force", number(last.force, 2, "N"));
    this.say("rate", number(last.rate, 0, "Hz")); this.say("lost", number(last.lost, 0, ""));
    this.say("estimate", `${number(last.estimate50, 1, "ms")} (median), ${number(last.estimate99, 1, "ms")} (99 %)`);
    this.say("screen", `${number(last.screen50, 0, "ms")} (median), ${number(last.screen99, 0, "ms")} (99 %)`);
    if (document.hidden || last === this.drawn) return;
    this.drawn = last;
    requestAnimationFrame(() => { if (this.socket.readyState === 1) this.socket.send(JSON.stringify({seen: last.id})); }); // the next animation frame starts after the reading has been drawn
  }
}

function penOn(canvas, high) { // resizes a canvas to the screen's resolution and clears it; returns [context with CSS pixels as units, width, device pixels per CSS pixel]
  const ratio = devicePixelRatio || 1, wide = canvas.clientWidth, size = [Math.floor(wide * ratio), Math.floor(high * ratio)];
  if (canvas.width !== size[0] || canvas.height !== size[1]) { [canvas.width, canvas.height] = size; canvas.style.height = `${high}px`; }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.clearRect(0, 0, wide + 1, high + 1); pen.font = "13px system-ui, sans-serif"; pen.lineWidth = 1.5;
  return [pen, wide, ratio];
}

function arrow(pen, px, py, [bx, by, bz], scale) { // draws Bx and By as an arrow, and Bz as a ring, dashed if Bz is negative
  const size = 2 * ARROW_MM * scale / (ARROW_UT + Math.hypot(bx, by, bz)), dx = bx * size, dy = -by * size, long = Math.hypot(dx, dy), turn = Math.atan2(dy, dx);
  pen.strokeStyle = colour("--ink");
  pen.beginPath(); pen.arc(px, py, Math.abs(bz) * size, 0, 7); pen.setLineDash(bz < 0 ? [3, 3] : []); pen.stroke(); pen.setLineDash([]);
  if (!(long > 3)) return;
  pen.beginPath(); pen.moveTo(px, py); pen.lineTo(px + dx, py + dy);
  for (const side of [2.6, -2.6]) { pen.moveTo(px + dx, py + dy); pen.lineTo(px + dx + 7 * Math.cos(turn + side), py + dy + 7 * Math.sin(turn + side)); }
  pen.stroke();
}

function draw() {
  while (boards.length < Math.max(boards[0].state.boards_n || 0, 1)) boards.push(new Board(boards.length));
  document.getElementById("boards").classList.toggle("single", boards.length === 1);
  const end_ms = performance.now() + DRAWING_MS; // if this time is too short for all boards, the next frame continues with the remaining boards
  for (let i = 0; i < boards.length && performance.now() < end_ms; i++) boards[next++ % boards.length].draw();
  requestAnimationFrame(draw);
}

addEventListener("keydown", (event) => {
  const name = {z: "zero", a: "adapt", p: "places", r: "record"}[event.key];
  if (name && !event.ctrlKey && !event.metaKey && !event.altKey && !event.repeat) boards.forEach((board) => board.press(name));
});
addEventListener("resize", () => boards.forEach((board) => { board.dirty = true; }));
boards.push(new Board(0));
draw();
