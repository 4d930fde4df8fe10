// Displays the messages that reskin/live/session.py sends. Binary messages (Traces.message) are displayed as numbers, as a picture
// of the board, and as curves over time (traces). JSON messages (Session.state) are displayed as texts. Each board has its own
// socket, state and canvases, so that an unplugged board does not affect the other boards.
"use strict";
const NUMBERS_N = 17, HEAD_BYTES_N = 16, RETRY_MS = 1000, DRAWING_MS = 12;
const FONT = "13px system-ui, sans-serif";
const COLOURS = ["--link", "--ink", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#0072B2"]; // the first colour is that of the force, and the others are those of the chips
const style = getComputedStyle(document.documentElement); // this object is updated by the browser when the colour scheme changes
const colour = (name) => style.getPropertyValue(name);
const ink = (j) => { const name = COLOURS[j ? 1 + (j - 1) % (COLOURS.length - 1) : 0]; return name.startsWith("--") ? colour(name) : name; };
const number = (value, digits, unit) => value === undefined || Number.isNaN(value) ? "–" : `${value.toFixed(digits)} ${unit}`;
const boards = [];
let next = 0;

class Board {
  constructor(index) {
    this.index = index; this.state = {waiting: true, alarms: []}; this.last = null; this.rows = []; this.trail = []; this.changed = Infinity; this.dirty = true;
    const article = document.getElementById("board").content.cloneNode(true).firstElementChild;
    this.parts = Object.fromEntries([...article.querySelectorAll("[data-part]")].map((part) => [part.dataset.part, part]));
    this.keys = [...article.querySelectorAll("[data-key]")];
    this.traces = [new Trace(this.parts.forces, 0, .5, false), new Trace(this.parts.fields, 1, 50, true)];
    document.getElementById("boards").append(article);
    for (const name of ["zero", "adapt", "places", "record"]) this.parts[name].addEventListener("click", () => this.press(name));
    this.parts.truth.addEventListener("change", () => { this.dirty = true; });
    this.parts.board.addEventListener("click", ({offsetX, offsetY}) => this.choose(offsetX, offsetY));
    this.onSubmit("save_form", () => ({save: this.parts.name.value}));
    this.onSubmit("load_form", () => ({load: this.parts.saved.value}));
    this.onSubmit("undo_form", () => ({press: "undo"}));
    this.onSubmit("refine_form", () => ({press: "refine"}));
    for (const name of ["keep", "discard"]) this.parts[name].addEventListener("click", () => this.send({press: name}));
    this.onSubmit("label_form", () => this.state.label_mm ? {label: null} : {label: {x_mm: this.parts.x.valueAsNumber, y_mm: this.parts.y.valueAsNumber,
      force_N: this.parts.force_N.value === "" ? null : this.parts.force_N.valueAsNumber, learn: this.parts.learn.checked}});
    this.connect();
  }

  onSubmit(form, message) { this.parts[form].addEventListener("submit", (event) => { event.preventDefault(); this.send(message()); }); }

  send(message) { if (this.socket.readyState === 1) this.socket.send(JSON.stringify(message)); }

  choose(px, py) { // enters the place at which the user has clicked in the form "Label a press"
    if (!this.state.places_known || this.state.waiting) return;
    const {mm, x0, y0, wide, high} = this.frame, [x, y] = mm(px, py);
    if (x < x0 || x > x0 + wide || y < y0 || y > y0 + high) return;
    this.parts.x.value = x.toFixed(1); this.parts.y.value = y.toFixed(1);
    this.parts.labelbox.open = this.dirty = true;
  }

  connect() {
    const address = new URL("live" + location.search, location.href);
    address.protocol = address.protocol.replace("http", "ws"); address.hash = ""; address.searchParams.set("board", this.index);
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({data}) => { typeof data === "string" ? this.show(JSON.parse(data)) : this.take(data); };
    this.socket.onclose = () => { this.show({waiting: true, what: "the server does not answer; trying again", alarms: []}); setTimeout(() => this.connect(), RETRY_MS); };
  }

  press(name) { if (!this.parts[name].disabled) this.send({press: name}); }

  say(name, text) { if (this.parts[name].textContent !== text) this.parts[name].textContent = text; }

  list(name, lines) {
    this.parts[name].replaceChildren(...lines.map((line) => Object.assign(document.createElement("li"), {textContent: line})));
  }

  take(data) {
    const view = new DataView(data), chips = view.getUint16(4, true), bins = view.getUint16(6, true);
    const values = new Float32Array(data, HEAD_BYTES_N), width = 1 + chips, first = NUMBERS_N + 3 * chips;
    const [x, y, force, sdX, sdY, sdForce, contact, rate, lost, estimate50, estimate99, screen50, screen99, dropped, trueX, trueY, trueForce] = values;
    this.last = {id: view.getUint32(0, true), chips, x, y, force, sdX, sdY, sdForce, contact, rate, lost, estimate50, estimate99, screen50,
      screen99, dropped, trueX, trueY, trueForce, change: values.slice(NUMBERS_N, first)};
    if (bins) { // the newest bin of the previous message is replaced, because readings may have been added to it since then
      const low = first + bins, high = low + bins * width, t = view.getFloat64(8, true), bin = (i) => Math.round((t + values[first + i]) / BIN_S);
      while (this.rows.length && this.rows[this.rows.length - 1].n >= bin(0)) this.rows.pop();
      for (let i = 0; i < bins; i++) this.rows.push({n: bin(i), low: values.slice(low + i * width, low + (i + 1) * width),
        high: values.slice(high + i * width, high + (i + 1) * width)});
      const oldest = bin(bins - 1) - WINDOW_S / BIN_S - GAP_BINS_N - 1; // the oldest bin that is still needed: a line from it can reach into the displayed time
      this.rows = this.rows.slice(Math.max(this.rows.findIndex(({n}) => n >= oldest), 0));
      this.changed = Math.min(this.changed, bin(0));
    }
    const now_ms = performance.now();
    this.trail = this.trail.filter(({at_ms}) => now_ms - at_ms < TRAIL_MS);
    const lifted = this.rows.slice(this.rows.length - bins).some(({high}) => high[0] === 0); // whether the skin was not touched for a moment
    if (contact && !Number.isNaN(x)) this.trail.push({x, y, force, at_ms: now_ms, begins: lifted});
    this.dirty = true;
  }

  show(next) {
    const state = this.state = next;
    this.say("what", state.waiting ? `${state.what || ""}: waiting for data` : state.what);
    this.say("about", state.waiting ? "" : `${state.board.replaceAll("uT", "µT")}. ${state.places_known ? "" : "The positions of its chips are unknown; they are drawn in a row."}`);
    this.say("model", state.model || "none, so no place or force is estimated; to load one, use --model");
    this.say("expected", state.expected || "–"); this.say("least_force", state.least_force || "–"); this.say("learnt", state.learnt || "nothing yet");
    this.parts.emulated.hidden = !state.true_places;
    this.parts.skinbox.hidden = this.parts.learn.parentElement.hidden = !state.adaptable;
    this.parts.undo.disabled = !state.undoable;
    this.parts.refine.disabled = !state.refinable;
    const skins = state.skins || [];
    if (skins.join() !== this.skins) { this.skins = skins.join(); this.parts.saved.replaceChildren(...skins.map((name) => new Option(name))); }
    this.parts.load.disabled = !skins.length;
    this.say("folder", `Files are in the folder ${state.skins_folder}. A file is never replaced.`);
    this.parts.label.textContent = state.label_mm ? "Cancel the label" : "Label the next press";
    this.say("labelled", state.labelling || state.labelled || "");
    this.parts.doubt.hidden = !state.doubtful;
    this.list("alarms", state.alarms);
    this.list("seen", (state.seen || []).map(([name, n, s]) => `${name}: ${n} in ${s} s`));
    this.parts.zero.disabled = this.parts.record.disabled = state.waiting;
    for (const name of ["adapt", "places"]) {
      this.parts[name].disabled = state.waiting || !state.adaptable || Boolean(state.adapting) && name !== this.chosen(state);
      this.parts[name].classList.toggle("on", Boolean(state.adapting) && name === this.chosen(state));
    }
    this.say("adapting", state.adapting || state.adapted || "–"); this.say("skin_said", state.adapted || ""); // the text is displayed twice, because it should also be near the buttons Save, Load and Undo
    this.parts.record.classList.toggle("on", Boolean(state.recording));
    this.parts.record.firstChild.textContent = state.recording ? "Stop " : "Record ";
    this.say("recording", state.recording ? `${state.recording}; labelled presses: ${state.recording_n}` : state.recorded || "–");
    if (state.waiting) { this.last = null; this.rows = []; this.trail = []; }
    this.dirty = true;
  }

  chosen(state) { return state.next_mm ? "places" : "adapt"; }

  drawBoard() {
    const {state, last} = this, fresh = last && !state.silent; // if no data arrive, the last reading is outdated and is not drawn
    const frame = this.frame = frameOf(this.parts.board, state), {at, scale} = frame;
    const [pen, wide, ratio] = penOn(this.parts.board, frame.height), now_ms = performance.now();
    const kind = [wide, ratio, scale, colour("--ink"), state.waiting, state.places_known, state.chips_mm].join();
    if (kind !== this.kind) { this.kind = kind; this.backdrop = backdrop(frame, state, wide, ratio); drawLegend(this.keys, scale); }
    pen.setTransform(1, 0, 0, 1, 0, 0); pen.drawImage(this.backdrop, 0, 0); pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (state.waiting) { const [px, py] = at(frame.x0 + frame.wide / 2, frame.y0 + frame.high / 2); pen.fillStyle = colour("--soft"); pen.textAlign = "center"; pen.fillText("waiting for data", px, py); return; }
    const trail = this.trail.map(({x, y, at_ms, ...rest}) => { const [px, py] = at(x, y); return {px, py, age_ms: now_ms - at_ms, ...rest}; });
    drawTrail(pen, trail.filter(({age_ms}) => age_ms < TRAIL_MS));
    pen.lineWidth = 2;
    if (fresh && last.chips === state.chips_mm.length) state.chips_mm.forEach(([x, y], i) => drawArrow(pen, ...at(x, y), last.change.subarray(3 * i, 3 * i + 3), scale));
    const cross = state.next_mm || state.label_mm || (this.parts.labelbox.open ? [this.parts.x.valueAsNumber, this.parts.y.valueAsNumber] : null);
    if (cross && !cross.some(Number.isNaN)) drawCross(pen, ...at(...cross), Math.max(1.2 * scale, 10));
    if (fresh && last.contact && !Number.isNaN(last.x)) {
      const [px, py] = at(last.x, last.y);
      if (!Number.isNaN(last.sdX)) drawEllipse(pen, px, py, 2 * last.sdX * scale, 2 * last.sdY * scale);
      drawContact(pen, px, py, last.force);
    }
    if (fresh && this.truthShown() && !Number.isNaN(last.trueX)) drawTruth(pen, ...at(last.trueX, last.trueY), "true place");
  }

  truthShown() { return Boolean(this.state.true_places) && this.parts.truth.checked; } // the true place is known only for emulated boards, and is shown only if the user has ticked the box

  truthText() { // returns a text that compares the estimate with the true contact
    const {last} = this, off = Math.hypot(last.x - last.trueX, last.y - last.trueY);
    if (Number.isNaN(last.trueX)) return "true: no contact";
    const error = Number.isNaN(off) ? "" : `; the estimate is off by ${off.toFixed(1)} mm and ${last.force < last.trueForce ? "−" : "+"}${Math.abs(last.force - last.trueForce).toFixed(2)} N`;
    return `true: x ${last.trueX.toFixed(1)}, y ${last.trueY.toFixed(1)} mm, ${last.trueForce.toFixed(2)} N${error}`;
  }

  draw() {
    if (!this.dirty) return;
    this.dirty = false;
    this.drawBoard();
    const {state, last} = this;
    if (!last || state.silent || !this.rows.length) { for (const name of ["place", "force", "rate", "dropped", "lost", "zeroed", "estimate", "screen"]) this.say(name, "–"); return; }
    const more = this.traces.map((trace, i) => trace.draw(this.rows, this.changed, i ? last.chips : 1, state.zero_bins));
    this.changed = Infinity; this.dirty = more.includes(true);
    this.parts.truth_key.hidden = !this.truthShown();
    this.say("off", this.truthShown() ? this.truthText() : "(this board is emulated, so the true place is known; it is not touched at the crosses that Places shows)");
    const sure = (sd) => Number.isNaN(sd) ? "" : ` ± ${sd.toFixed(1)}`, among = Number.isNaN(last.sdX) || state.adaptable ? "" : " between models";
    this.say("place", last.contact && !Number.isNaN(last.x) ? `x ${last.x.toFixed(1)}${sure(last.sdX)}, y ${last.y.toFixed(1)}${sure(last.sdY)} mm${among}` : last.contact ? "contact" : "no contact");
    this.say("force", last.contact && !Number.isNaN(last.sdForce) ? `${last.force.toFixed(2)} ± ${last.sdForce.toFixed(2)} N` : number(last.force, 2, "N"));
    this.say("rate", number(last.rate, 0, "Hz")); this.say("lost", number(last.lost, 0, "")); this.say("dropped", number(last.dropped, 0, ""));
    const zeros = state.zero_bins || [], ago_s = zeros.length ? (this.rows[this.rows.length - 1].n - zeros[zeros.length - 1]) * BIN_S : NaN;
    this.say("zeroed", zeros.length ? `${state.zeroings_n} ${state.zeroings_n === 1 ? "time" : "times"}, last ${Math.max(ago_s, 0).toFixed(0)} s ago` : "not yet");
    this.say("estimate", `${number(last.estimate50, 1, "ms")} (median), ${number(last.estimate99, 1, "ms")} (99 %)`);
    this.say("screen", `${number(last.screen50, 0, "ms")} (median), ${number(last.screen99, 0, "ms")} (99 %)`);
    if (document.hidden || last === this.drawn) return;
    this.drawn = last;
    requestAnimationFrame(() => { if (this.socket.readyState === 1) this.socket.send(JSON.stringify({seen: last.id})); }); // the message is sent in the next animation frame, because then the reading has been drawn on the screen
  }
}

function penOn(canvas, high, wide = canvas.clientWidth) { // clears a canvas and adapts its resolution to the screen; returns [drawing context whose unit is the CSS pixel, width, device pixels per CSS pixel]
  const ratio = devicePixelRatio || 1, size = [Math.floor(wide * ratio), Math.floor(high * ratio)];
  if (canvas.width !== size[0] || canvas.height !== size[1]) { [canvas.width, canvas.height] = size; canvas.style.height = `${high}px`; }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.clearRect(0, 0, wide + 1, high + 1); pen.font = FONT; pen.lineWidth = 1.5;
  return [pen, wide, ratio];
}

function draw() {
  while (boards.length < Math.max(boards[0].state.boards_n || 0, 1)) boards.push(new Board(boards.length));
  document.getElementById("boards").classList.toggle("single", boards.length === 1);
  const end_ms = performance.now() + DRAWING_MS; // if this time is too short to draw all boards, the remaining boards are drawn in the next animation frame
  for (let i = 0; i < boards.length && performance.now() < end_ms; i++) boards[next++ % boards.length].draw();
  requestAnimationFrame(draw);
}

addEventListener("keydown", (event) => {
  const name = {z: "zero", a: "adapt", p: "places", r: "record"}[event.key];
  if (event.target instanceof Element && event.target.matches("input:not([type=checkbox]), select")) return; // keys that are typed into a field of a form are not commands
  if (name && !event.ctrlKey && !event.metaKey && !event.altKey && !event.repeat) boards.forEach((board) => board.press(name));
});
addEventListener("resize", () => boards.forEach((board) => { board.dirty = true; }));
boards.push(new Board(0));
draw();
