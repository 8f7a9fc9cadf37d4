"use strict";
// Two plots as SVG: dB over the seconds of an adaptation, and the Pareto fronts of a tradeoff.

// Units of a plot are px of the screen on a phone too, or its text could not be read there; the page and the card take 62 px of the width.
const WIDTH = Math.max(280, Math.min(580, document.documentElement.clientWidth - 62));
const HEIGHT = 300, MARGIN = { left: 46, right: 14, top: 16, bottom: 42 };
const LETTER = 6.7; // px, of a name beside a point

// Of the seconds of a run, those that are spent with its steps or after them; all others are spent before the first.
const WITH_STEPS = ["optimization", "pseudo truth", "validation", "total"];

/** Round numbers that divide a range into about `count` parts. */
function ticksOf(low, high, count = 5) {
  const rough = (high - low || 1) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((each) => each * power).find((each) => each >= rough);
  const ticks = [];
  for (let tick = Math.ceil(low / step) * step; tick <= high + step * 1e-9; tick += step) ticks.push(Number(tick.toPrecision(12)));
  return ticks;
}

/** Powers of ten and twice and five times those, as many as are not too close to each other. */
function logTicks(low, high) {
  const ticks = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.log10(high); power += 1) ticks.push(10 ** power, 2 * 10 ** power, 5 * 10 ** power);
  const inside = ticks.filter((tick) => tick >= low && tick <= high);
  return inside.length > 7 ? inside.filter((tick) => Number.isInteger(Math.round(Math.log10(tick) * 1e6) / 1e6)) : inside;
}

const spread = (values) => [Math.min(...values), Math.max(...values)];

/** An empty plot with axes. `bend`: what is done to x before it is placed, such as a logarithm; `nameOf`: how x is written. */
function plot({ title, x, y, xTicks, bend = (value) => value, nameOf = String, xLabel, yLabel }) {
  const [left, right] = x.map(bend), room = (y[1] - y[0] || 1) * 0.08, [bottom, top] = [y[0] - room, y[1] + room];
  const place = {
    x: (value) => MARGIN.left + ((bend(value) - left) / (right - left || 1)) * (WIDTH - MARGIN.left - MARGIN.right),
    y: (value) => HEIGHT - MARGIN.bottom - ((value - bottom) / (top - bottom)) * (HEIGHT - MARGIN.top - MARGIN.bottom),
  };
  const svg = draw("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "group", "aria-label": title });
  for (const tick of ticksOf(bottom, top)) {
    svg.append(draw("line", { class: "grid-line", x1: MARGIN.left, x2: WIDTH - MARGIN.right, y1: place.y(tick), y2: place.y(tick) }));
    svg.append(draw("text", { x: MARGIN.left - 6, y: place.y(tick) + 4, "text-anchor": "end" }, String(tick)));
  }
  for (const tick of xTicks) svg.append(draw("text", { x: place.x(tick), y: HEIGHT - MARGIN.bottom + 17, "text-anchor": "middle" }, nameOf(tick)));
  svg.append(draw("line", { class: "axis", x1: MARGIN.left, x2: WIDTH - MARGIN.right, y1: HEIGHT - MARGIN.bottom, y2: HEIGHT - MARGIN.bottom }));
  svg.append(draw("text", { x: WIDTH - MARGIN.right, y: HEIGHT - 6, "text-anchor": "end" }, xLabel));
  svg.append(draw("text", { x: 4, y: 11 }, yLabel));
  return { svg, place };
}

/** The line under a plot that tells the point that is looked at. */
const newReadout = () => make("p", { class: "readout", "aria-live": "polite" }, "Point at a mark, or tap it, to read it.");

/** A point that tells `text` while the pointer or the keyboard is on it. */
function point(x, y, name, text, readout) {
  const tell = () => { readout.textContent = text; };
  const dot = draw("circle", { class: name, cx: x, cy: y, r: 4.5, tabindex: 0, role: "img", "aria-label": text }, draw("title", {}, text));
  dot.addEventListener("pointerenter", tell);
  dot.addEventListener("focus", tell);
  return dot;
}

/** Where a name goes that belongs to a point at x: on its right, or where there is no room on its left, or else in the middle. */
function beside(x, text, gap) {
  const length = text.length * LETTER;
  if (x + gap + length <= WIDTH) return { x: x + gap, "text-anchor": "start" };
  return x - gap - length >= 0 ? { x: x - gap, "text-anchor": "end" } : { x: WIDTH / 2, "text-anchor": "middle" };
}

const path = (points) => `M${points.map((each) => each.map((value) => value.toFixed(1)).join(" ")).join("L")}`;

/** dB over seconds of one adaptation: what was done before the first step, the steps, and what was taken back. */
function curveChart(report) {
  const curve = report.curve.filter((each) => each.validation_db != null);
  const base = report.validation["the base as it is"];
  const last = Math.max(report.seconds.total, ...curve.map((each) => each.seconds));
  const { svg, place } = plot({
    title: `dB over seconds, ${report.title}`, x: [0, last], y: spread([...curve.map((each) => each.validation_db), ...(base == null ? [] : [base])]),
    xTicks: ticksOf(0, last, 8), xLabel: "seconds of adapting", yLabel: "dB on validation views",
  });
  const readout = newReadout();
  const start = curve[0];
  const before = Object.entries(report.seconds).filter(([phase, seconds]) => !WITH_STEPS.includes(phase) && seconds >= 0.005)
    .map(([phase, seconds]) => `${phase} ${seconds.toFixed(2)} s`).join(", ");
  const made = Object.keys(report.validation).find((name) => name.startsWith("the start, "))?.replace("the start, ", "");
  svg.prepend(draw("rect", { class: "before-steps", x: place.x(0), y: MARGIN.top, width: place.x(start.seconds) - place.x(0), height: HEIGHT - MARGIN.top - MARGIN.bottom }));
  if (base != null) {
    svg.append(draw("line", { class: "base-line", x1: MARGIN.left, x2: WIDTH - MARGIN.right, y1: place.y(base), y2: place.y(base) }));
    svg.append(draw("text", { x: WIDTH - MARGIN.right, y: place.y(base) - 5, "text-anchor": "end" }, `base ${decibel(base)}`));
  }
  svg.append(draw("path", { class: "curve", d: path(curve.map((each) => [place.x(each.seconds), place.y(each.validation_db)])) }));
  if (made) {
    svg.append(draw("text", { class: "start-label", ...beside(place.x(start.seconds), made, 9), y: place.y(start.validation_db) + 16 }, made));
  }
  for (const each of curve) {
    const what = each.step === 0 ? `${made ?? "the start"} (${before || "nothing before it"})`
      : `step ${each.step}${each.taken_back ? ", taken back" : ""}`;
    const text = `${each.seconds.toFixed(2)} s: ${decibel(each.validation_db)}, ${splats(each.gaussians)}, ${what}`;
    const name = each.step === 0 ? "mark start" : each.taken_back ? "mark taken-back" : "mark";
    svg.append(point(place.x(each.seconds), place.y(each.validation_db), name, text, readout));
  }
  const shaded = before ? `Shaded, before the first step: ${before}. ` : "";
  const steers = "The curve is of the validation views that steer the run; the base's line and the dB above are of the others. ";
  const split = base != null && !Object.values(report.validation).includes(start.validation_db) ? steers : "";
  return make("figure", { class: "chart" }, make("figcaption", {}, report.title), svg, readout,
    make("p", { class: "note" }, `${shaded}${split}Ended by ${report.ended_by}; the file holds ${report.returned}.`));
}

/** Both fronts of one scale of a tradeoff: dB over seconds to adapt, and over milliseconds a frame. */
function tradeoffCharts(scale) {
  const plots = [
    { cost: (each) => each.adapt_seconds, mark: "on_front_of_seconds", label: "seconds to adapt", unit: "s", points: scale.points.filter((each) => ["base", "adapted"].includes(each.kind)) },
    { cost: (each) => each.ms_per_frame, mark: "on_front_of_frames", label: "milliseconds a frame", unit: "ms", points: scale.points.filter((each) => each.ms_per_frame) },
  ];
  return make("div", { class: "charts" }, ...plots.filter((each) => each.points.length).map((each) => frontChart(scale, each)));
}

function frontChart(scale, { cost, mark, label, unit, points }) {
  const costs = points.map((each) => cost(each).median), [low, high] = spread(costs);
  const least = unit === "s" ? 0.1 : 0; // seconds: 0 is on the axis, and below a tenth it is linear
  const bend = (value) => (least ? Math.log10(1 + value / least) : Math.log10(Math.max(value, 1e-6)));
  const { svg, place } = plot({
    title: `dB over ${label}, ${zoomName(scale.scale)}`, x: least ? [0, high * 1.1] : [low / 1.2, high * 1.2], y: spread(points.map((each) => each.psnr_db.median)),
    xTicks: least ? [0, ...logTicks(least, high)] : logTicks(low, high), bend, xLabel: label, yLabel: "dB",
  });
  const readout = newReadout();
  const front = points.filter((each) => each[mark]).sort((a, b) => cost(a).median - cost(b).median);
  const at = (each) => [place.x(cost(each).median), place.y(each.psnr_db.median)];
  const corners = front.flatMap((each, i) => (i ? [[at(each)[0], at(front[i - 1])[1]], at(each)] : [at(each)]));
  for (const name of new Set(points.map((each) => `${each.name}, ${each.backend}`))) {
    const run = points.filter((each) => `${each.name}, ${each.backend}` === name).sort((a, b) => cost(a).median - cost(b).median);
    if (run.length > 1) svg.append(draw("path", { class: "run", d: path(run.map(at)) }));
  }
  for (const each of front.filter((one) => one.step == null)) {
    const [x, y] = at(each);
    svg.append(draw("text", { class: "point-label", ...beside(x, each.name, -4), y: y - 9 }, each.name));
  }
  if (corners.length > 1) svg.append(draw("path", { class: "front", d: path(corners) }));
  for (const each of points) {
    const step = each.step == null ? "" : `, step ${each.step}`;
    const text = `${each.name}${step}, ${each.backend}: ${decibel(each.psnr_db.median)}, ${digits(cost(each).median, 2)} ${unit}, ${splats(each.gaussians)}`;
    svg.append(point(...at(each), `mark ${each.kind}${each[mark] ? " on-front" : ""}`, text, readout));
  }
  return make("figure", { class: "chart" }, make("figcaption", {}, `${zoomName(scale.scale)}: dB over ${label}`), svg, readout);
}
