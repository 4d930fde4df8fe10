// Draws the picture of the skin with its axes, the field change at each chip, the contact, its trail (the earlier places of the
// contact), and the legend.
"use strict";
const AXES_PX = {left: 42, right: 12, top: 12, bottom: 40}; // widths of the margins in which the axes are drawn
const ARROW_UT = 300, ARROW_MM = 4; // a field change of ARROW_UT is drawn as an arrow of the length ARROW_MM; for larger field changes, the length approaches 2 ARROW_MM
const TRAIL_MS = 1500, TRAIL_GAP_MS = 200; // the trail shows the places of the last TRAIL_MS, and has a gap where no place was estimated for TRAIL_GAP_MS
const STRENGTHS = [[0x3F, 0x8F, 0xD9], [0x35, 0xB2, 0x9A], [0xE6, 0xB4, 0x00], [0xE0, 0x56, 0x2B], [0xA3, 0x12, 0x3F]], STRONG_N = 10; // colours of contacts, for forces from 0 N to STRONG_N
const LEGEND_PX = 46;

function strengthColour(force_N) { // returns the colour of a contact; the colours change with the square root of the force, so that light touches can be told apart
  const share = Math.sqrt(Math.min(Math.max(force_N || 0, 0) / STRONG_N, 1)) * (STRENGTHS.length - 1), i = Math.min(Math.floor(share), STRENGTHS.length - 2);
  return `rgb(${STRENGTHS[i].map((low, j) => Math.round(low + (share - i) * (STRENGTHS[i + 1][j] - low))).join()})`;
}

const contactRadius = (force_N) => 5 + 6 * Math.sqrt(Math.max(force_N || 0, 0));

function frameOf(canvas, state) { // returns the size and the position of the skin on a canvas, with functions that convert between mm and pixels
  const [wide, high] = state.skin_mm || [20, 20], [x0, y0] = state.corner_mm || [-2, -2], {left, right, top, bottom} = AXES_PX;
  const scale = Math.max(Math.min((canvas.clientWidth - left - right) / wide, (innerHeight * (boards.length > 1 ? .5 : .8) - top - bottom) / high), .1); // the scale must not be 0, although the height of a hidden window is 0
  return {wide, high, x0, y0, scale, at: (x, y) => [left + (x - x0) * scale, top + (y0 + high - y) * scale],
    mm: (px, py) => [x0 + (px - left) / scale, y0 + high - (py - top) / scale], height: high * scale + top + bottom};
}

function backdrop(frame, state, wide, ratio) { // returns a picture of everything that does not change from reading to reading: the skin, the axes and the chips
  const canvas = document.createElement("canvas"), pen = canvas.getContext("2d"), {x0, y0, scale, at} = frame;
  canvas.width = Math.max(Math.floor(wide * ratio), 1); canvas.height = Math.floor(frame.height * ratio); // before the browser has laid out the page, the width is 0
  pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.font = FONT; pen.lineWidth = 1.5;
  const [left, top] = at(x0, y0 + frame.high), [right, bottom] = at(x0 + frame.wide, y0);
  pen.fillStyle = colour("--skin"); pen.strokeStyle = colour("--line");
  pen.fillRect(left, top, right - left, bottom - top); pen.strokeRect(left, top, right - left, bottom - top);
  if (state.waiting) return canvas;
  pen.fillStyle = colour("--soft");
  if (state.places_known) {
    const step = [1, 2, 5, 10, 20, 50].find((mm) => mm * scale >= 44) || 100;
    pen.textAlign = "center";
    for (let x = Math.ceil(x0 / step) * step; x <= x0 + frame.wide; x += step) { const [px] = at(x, y0); pen.strokeRect(px, bottom, 0, 5); pen.fillText(x, px, bottom + 18); }
    pen.fillText("x / mm", (left + right) / 2, bottom + 34);
    pen.textAlign = "right";
    for (let y = Math.ceil(y0 / step) * step; y <= y0 + frame.high; y += step) { const [, py] = at(x0, y); pen.strokeRect(left - 5, py, 5, 0); pen.fillText(y, left - 8, py + 4); }
    pen.save(); pen.translate(12, (top + bottom) / 2); pen.rotate(-Math.PI / 2); pen.textAlign = "center"; pen.fillText("y / mm", 0, 0); pen.restore();
  }
  pen.lineWidth = 2; pen.textAlign = "left";
  state.chips_mm.forEach(([x, y], i) => {
    const [px, py] = at(x, y), side = Math.max(1.5 * scale, 8);
    pen.strokeStyle = ink(i + 1); pen.strokeRect(px - side / 2, py - side / 2, side, side); // a chip has the same colour here as its curve in the diagram of the field changes
    pen.fillText(`${i}`, px + side / 2 + 3, py + side / 2 + 10);
  });
  return canvas;
}

function drawArrow(pen, px, py, [bx, by, bz], scale) { // draws a field change: Bx and By as an arrow, and Bz as a ring, which is dashed if Bz is negative
  const size = 2 * ARROW_MM * scale / (ARROW_UT + Math.hypot(bx, by, bz)), dx = bx * size, dy = -by * size, long = Math.hypot(dx, dy), turn = Math.atan2(dy, dx);
  pen.strokeStyle = colour("--ink");
  pen.beginPath(); pen.arc(px, py, Math.abs(bz) * size, 0, 7); pen.setLineDash(bz < 0 ? [3, 3] : []); pen.stroke(); pen.setLineDash([]);
  if (!(long > 3)) return;
  pen.beginPath(); pen.moveTo(px, py); pen.lineTo(px + dx, py + dy);
  for (const side of [2.6, -2.6]) { pen.moveTo(px + dx, py + dy); pen.lineTo(px + dx + 7 * Math.cos(turn + side), py + dy + 7 * Math.sin(turn + side)); }
  pen.stroke();
}

function drawContact(pen, px, py, force_N) {
  pen.fillStyle = strengthColour(force_N); pen.strokeStyle = colour("--ink"); pen.lineWidth = 1.5;
  pen.beginPath(); pen.arc(px, py, contactRadius(force_N), 0, 7); pen.fill(); pen.stroke();
}

function drawTrail(pen, points) { // points: a list of {px, py, force, age_ms, begins} with the oldest point first; `begins` states whether a touch begins at the point
  pen.lineWidth = 4; pen.lineCap = "round";
  for (let i = 1; i < points.length; i++) {
    const a = points[i - 1], b = points[i];
    if (b.begins || a.age_ms - b.age_ms > TRAIL_GAP_MS) continue;
    pen.globalAlpha = Math.max(1 - b.age_ms / TRAIL_MS, 0); pen.strokeStyle = strengthColour(b.force);
    pen.beginPath(); pen.moveTo(a.px, a.py); pen.lineTo(b.px, b.py); pen.stroke();
  }
  pen.globalAlpha = 1; pen.lineCap = "butt";
}

function drawEllipse(pen, px, py, rx, ry) {
  pen.strokeStyle = colour("--link"); pen.lineWidth = 2;
  pen.beginPath(); pen.ellipse(px, py, Math.max(rx, 1), Math.max(ry, 1), 0, 0, 7); pen.stroke();
}

function drawCross(pen, px, py, size) { // draws the cross that shows where the user should press next
  pen.strokeStyle = colour("--alarm"); pen.lineWidth = 3; pen.beginPath(); pen.arc(px, py, size, 0, 7);
  for (const [dx, dy] of [[1, 0], [0, 1]]) { pen.moveTo(px - 1.5 * size * dx, py - 1.5 * size * dy); pen.lineTo(px + 1.5 * size * dx, py + 1.5 * size * dy); }
  pen.stroke(); pen.lineWidth = 2;
}

function drawTruth(pen, px, py, text) { // draws the true place as an empty square on its corner, with a text, so that it cannot be confused with an estimate, which is a filled circle
  const size = 15;
  pen.strokeStyle = pen.fillStyle = colour("--truth"); pen.lineWidth = 3; pen.setLineDash([5, 3]);
  pen.beginPath(); pen.moveTo(px - size, py); pen.lineTo(px, py - size); pen.lineTo(px + size, py); pen.lineTo(px, py + size); pen.closePath(); pen.stroke();
  pen.setLineDash([]);
  if (text) { pen.textAlign = "center"; pen.font = `bold ${FONT}`; pen.fillText(text, px, py < 40 ? py + size + 16 : py - size - 6); pen.font = FONT; }
}

const LEGEND = { // maps the name of an item to a function that returns [width in px, function that draws the item]
  arrow: (scale) => [2 * ARROW_MM * scale * 100 / (ARROW_UT + 100) + 14, (pen, wide, y) => drawArrow(pen, 5, y, [100, 0, 0], scale)],
  ring: (scale) => { const size = 2 * (2 * ARROW_MM * scale * 30 / (ARROW_UT + 30)) + 4; return [2 * size, (pen, wide, y) => { pen.lineWidth = 2; drawArrow(pen, size / 2, y, [0, 0, 30], scale); drawArrow(pen, 1.5 * size, y, [0, 0, -30], scale); }]; },
  contact: () => [100, (pen, wide, y) => [[12, .5], [40, 2], [76, 8]].forEach(([x, force]) => drawContact(pen, x, y, force))],
  trail: () => [56, (pen, wide, y) => drawTrail(pen, [...Array(12).keys()].map((i) => ({px: 4 + 4.3 * i, py: y + 6 * Math.sin(i / 2), force: 2, age_ms: TRAIL_MS * (1 - (i + 1) / 12)})))],
  ellipse: () => [44, (pen, wide, y) => drawEllipse(pen, 22, y, 18, 12)],
  truth: () => [36, (pen, wide, y) => drawTruth(pen, 18, y, "")],
};

function drawLegend(items, scale) { // draws all items of the legend; `items` are their canvases
  for (const canvas of items) {
    const [wide, draw] = LEGEND[canvas.dataset.key](scale);
    canvas.style.width = `${Math.ceil(wide)}px`;
    const [pen] = penOn(canvas, LEGEND_PX, Math.ceil(wide));
    draw(pen, wide, LEGEND_PX / 2);
  }
}
