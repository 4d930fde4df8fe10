// Draws the values of the last ten seconds as curves (traces). To save time, the existing picture is shifted to the left, and only the
// new values are drawn. When the scale or the size changes, the existing picture is first stretched. Then the old values are drawn
// again, from the newest to the oldest. This is spread over several animation frames.
"use strict";
// WINDOW_S and BIN_S must equal the constants of the same names in reskin/live/session.py.
const WINDOW_S = 10, BIN_S = .02, GAP_BINS_N = 5, AXIS_PX = 20, UNLABELLED_PX = 6, LEFT_PX = 44, ABOVE_PX = 6, HIGH_PX = 144;
const NARROW_PX = 400; // below this width, the time axis has fewer labels
const REDRAW_MS = 3, LINE_PX = 1.5; // REDRAW_MS: time in each animation frame in which old values are drawn again
const NICE = [1, 1.5, 2, 3, 4, 5, 6, 8, 10]; // the upper end of the scale is one of these numbers times a power of ten; there are few numbers, so that the scale seldom changes

class Trace {
  constructor(canvas, first, least, below) { // first: index of the first value in a row; least: smallest upper end of the scale; below: whether the times are written below this trace
    this.canvas = canvas; this.first = first; this.least = least; this.below = below;
    this.high_px = ABOVE_PX + HIGH_PX + (below ? AXIS_PX : UNLABELLED_PX);
    this.layer = {width: 0}; this.top = least;
    this.columns = 64; // number of pixel columns to redraw per frame, adjusted so that redrawing takes REDRAW_MS
  }

  // Draws the minimum and the maximum of each bin, and returns whether older bins must still be drawn again.
  // changed: the number of the first bin that is new or has changed since the last call; count: the number of values to draw;
  // marks: the numbers of bins at which dashed vertical lines are drawn.
  draw(rows, changed, count, marks = []) {
    const [pen, wide, ratio] = penOn(this.canvas, this.high_px), newest = rows[rows.length - 1].n, begun_ms = performance.now();
    let greatest = this.least;
    for (const {high} of rows) for (let j = this.first; j < this.first + count; j++) if (high[j] > greatest) greatest = high[j];
    const unit = 10 ** Math.floor(Math.log10(greatest)), top = unit * NICE.find((n) => n * unit >= greatest || n === 10);
    this.fit(Math.max(Math.round((wide - LEFT_PX) * ratio), 1), ratio, count, top, newest);
    const {layer} = this, left = this.edge - layer.width, fresh = Math.min(Math.floor(changed * this.bin_px - this.aside), this.edge);
    this.drawLines(rows, fresh, this.edge);
    this.drawn = Math.min(this.drawn, fresh);
    const redrawn = Math.max(Math.min(this.columns, this.drawn - left), 0);
    this.drawLines(rows, this.drawn - redrawn, this.drawn);
    this.drawn -= redrawn;
    this.drawScale(pen, wide, top, marks.map((n) => (newest + 1 - n) * BIN_S));
    pen.setTransform(1, 0, 0, 1, 0, 0);
    pen.drawImage(layer, Math.round(LEFT_PX * ratio), 0); // this call comes before the time is measured in the next line, because it also takes time
    if (redrawn) this.columns = Math.min(Math.max(Math.round(this.columns * Math.min(REDRAW_MS / (performance.now() - begun_ms), 2)), 8), layer.width);
    return this.drawn > left;
  }

  fit(wide, ratio, count, top, newest) { // shifts the existing picture to the new time, or stretches it to a new size or scale
    const kind = [wide, ratio, count, ink(0), ink(1)].join(), bin_px = wide * BIN_S / WINDOW_S, edge = Math.round((newest + 1) * bin_px);
    if (kind !== this.kind) {
      const before = this.layer;
      this.layer = document.createElement("canvas"); this.pen = this.layer.getContext("2d");
      this.layer.width = wide; this.layer.height = Math.floor(this.high_px * ratio);
      if (before.width) this.pen.drawImage(before, 0, 0, wide, this.layer.height);
      this.edge = this.drawn = edge;
    }
    const {layer, pen} = this, later = edge - this.edge;
    if (later < 0 || later >= wide) { // the time has started again, or nothing in the existing picture is in the displayed time any more
      pen.clearRect(0, 0, wide, layer.height); this.drawn = edge;
    } else if (later || top !== this.top) {
      const times = this.top / top, zero = (ABOVE_PX + HIGH_PX) * ratio;
      pen.globalCompositeOperation = "copy";
      pen.drawImage(layer, -later, zero * (1 - times), wide, layer.height * times);
      pen.globalCompositeOperation = "source-over";
      if (top !== this.top) this.drawn = edge;
    }
    const aside = (GAP_BINS_N + 1) * bin_px + 4 * ratio; // the width of the longest line between two bins, plus the line width
    Object.assign(this, {kind, bin_px, edge, top, ratio, count, aside});
  }

  y(value) { return ABOVE_PX + HIGH_PX * (1 - value / (this.top * 1.05)); }

  drawLines(rows, from, to) { // draws all lines in the pixel columns `from` to `to`; lines that cross the ends of this range are clipped, so that no seam is visible
    if (to <= from) return;
    const {layer, pen, bin_px, ratio, aside} = this, left = this.edge - layer.width, x = (n) => n * bin_px - left;
    let last = rows.length, begin;
    while (last > 1 && x(rows[last - 2].n) > to - left + aside) last--;
    for (begin = last - 1; begin > 0 && x(rows[begin].n) > from - left - aside; begin--);
    pen.save(); pen.beginPath(); pen.rect(from - left, 0, to - from, layer.height); pen.clip();
    pen.clearRect(from - left, 0, to - from, layer.height);
    pen.lineWidth = LINE_PX * ratio;
    for (let j = this.first; j < this.first + this.count; j++) {
      let before = -Infinity;
      pen.strokeStyle = ink(j); pen.beginPath();
      for (let i = begin; i < last; i++) {
        const {n, low, high} = rows[i];
        if (Number.isNaN(low[j])) continue;
        n - before > GAP_BINS_N ? pen.moveTo(x(n), ratio * this.y(low[j])) : pen.lineTo(x(n), ratio * this.y(low[j]));
        pen.lineTo(x(n + .5), ratio * this.y(high[j]));
        before = n;
      }
      pen.stroke();
    }
    pen.restore();
  }

  drawScale(pen, wide, top, marks_s) { // draws the horizontal and vertical lines of the scale, and the marks; both traces of a board have vertical lines at the same times
    const step = [1, 2, 5, 10].map((n) => n * 10 ** Math.floor(Math.log10(top / 3))).find((n) => top / n <= 5);
    const x = (s) => wide - s / WINDOW_S * (wide - LEFT_PX), bottom = ABOVE_PX + HIGH_PX, every_s = wide < NARROW_PX ? 5 : 2;
    pen.strokeStyle = colour("--line"); pen.fillStyle = colour("--soft"); pen.textAlign = "right"; pen.lineWidth = 1;
    for (let i = 0; i * step <= top * 1.001; i++) { pen.strokeRect(LEFT_PX, this.y(i * step), wide, 0); pen.fillText(+(i * step).toPrecision(3), LEFT_PX - 6, this.y(i * step) + 4); }
    for (let s = 0; s <= WINDOW_S; s += every_s) {
      pen.beginPath(); pen.moveTo(x(s), ABOVE_PX); pen.lineTo(x(s), bottom + (this.below ? 4 : 1)); pen.stroke();
      if (this.below) pen.fillText(s ? `−${s} s` : "now", Math.max(x(s), LEFT_PX + 20), bottom + AXIS_PX - 4);
    }
    pen.strokeStyle = colour("--alarm"); pen.setLineDash([5, 4]);
    for (const s of marks_s) if (s > 0 && s < WINDOW_S) { pen.beginPath(); pen.moveTo(x(s), 0); pen.lineTo(x(s), bottom); pen.stroke(); pen.fillStyle = colour("--alarm"); pen.fillText("zeroed", x(s) - 3, ABOVE_PX + 10); }
    pen.setLineDash([]);
  }
}
