"use strict";
// A ladder of levels: dB over zoom with the switches, or over the distance on walks, and its files.

const roundedZoom = (zoom) => zoomName(Number(zoom.toPrecision(3)));
const roundedDistance = (distance) => String(Number(distance.toPrecision(3)));

/** The axis of a ladder by zoom, from the finest to the coarsest: where points and switches lie, and what a point tells. */
function zoomAxis({ curve, switches, levels }) {
  const zooms = curve.map((each) => each.zoom);
  return {
    xLabel: "zoom", of: (each) => each.zoom, nameOf: zoomName, rounded: roundedZoom, switches: switches.map((each) => each.zoom),
    xTicks: Array.from({ length: 12 }, (_, i) => 2 ** -i).filter((zoom) => zoom <= zooms[0] * 1.001 && zoom >= zooms.at(-1) * 0.999),
    lines: [...levels.keys()].map((level) => curve.filter((each) => each.level === level)), what: (each) => levels[each.level].file,
  };
}

/** The axis of a ladder by distance, in world units on the manifest's canvas and a field of view of 45°. */
function distanceAxis({ curve, levels, canvas }) {
  const of = (each) => canvas / 2 / Math.tan(Math.PI / 8) * each.pixel, ends = [of(curve[0]), of(curve.at(-1))];
  return {
    xLabel: "distance of what is nearest, world units", of, nameOf: String, rounded: roundedDistance, lines: [curve],
    switches: levels.slice(1).map((level) => level.distance_from).filter((each) => each >= ends[0] && each <= ends[1]),
    xTicks: logTicks(...ends), what: (each) => `the levels (${splats(Math.round(each.splats))})`,
  };
}

/** dB over the axis: the levels as they are shown, and the base alone. */
function ladderChart(ladder) {
  const { curve } = ladder, axis = ladder.by === "distance" ? distanceAxis(ladder) : zoomAxis(ladder);
  const { svg, place } = plot({
    title: `dB over ${axis.xLabel}`, x: [axis.of(curve[0]), axis.of(curve.at(-1))], y: spread(curve.flatMap((each) => [each.psnr_db, each.base_db])),
    xTicks: axis.xTicks, nameOf: axis.nameOf, bend: Math.log2, xLabel: axis.xLabel, yLabel: "dB",
  });
  const readout = newReadout();
  let named = -Infinity; // where the last switch with a name lies
  for (const each of axis.switches) {
    const x = place.x(each), name = axis.rounded(each);
    svg.append(draw("line", { class: "switch", x1: x, x2: x, y1: MARGIN.top, y2: HEIGHT - MARGIN.bottom }));
    if (Math.abs(x - named) < (name.length + 1) * LETTER) continue;
    svg.append(draw("text", { x, y: MARGIN.top - 3, "text-anchor": "middle" }, name));
    named = x;
  }
  const line = (points, of) => path(points.map((each) => [place.x(axis.of(each)), place.y(of(each))]));
  svg.append(draw("path", { class: "base-line", fill: "none", d: line(curve, (each) => each.base_db) }));
  for (const shown of axis.lines) svg.append(draw("path", { class: "curve", d: line(shown, (each) => each.psnr_db) }));
  for (const each of curve) {
    const text = `${axis.rounded(axis.of(each))}: ${decibel(each.psnr_db)} with ${axis.what(each)}, ${decibel(each.base_db)} with the base alone`;
    svg.append(point(place.x(axis.of(each)), place.y(each.psnr_db), "mark", text, readout));
  }
  return make("figure", { class: "chart" }, make("figcaption", {}, `In ${ladder.viewer}: levels, and the base alone (dashed); dotted: switches`), svg, readout,
    make("p", { class: "note" }, ladder.measured));
}

const size = (bytes) => (bytes < 1e6 ? `${digits(bytes / 1e3, 0)} kB` : `${digits(bytes / 1e6, 1)} MB`);

const heldColumns = [
  ["splats", (level) => grouped(level.splats), "number"], ["size", (level) => size(level.bytes), "number"],
  ["s", (level) => digits(level.seconds, 0), "number"],
];

function zoomColumns() {
  const shown = (level) => [level.shown_to && `below ${roundedZoom(level.shown_to)}`, level.shown_from && `from ${roundedZoom(level.shown_from)}`];
  return [
    ["made for", (level) => roundedZoom(level.scale), ""], ["shown", (level) => shown(level).filter(Boolean).join(", ") || "always", ""],
    ["least dB", (level) => digits(Math.min(...Object.values(level.psnr_db)), 1), "number"],
  ];
}

function distanceColumns() {
  const ends = (level) => [level.distance_from && `from ${roundedDistance(level.distance_from)}`, level.distance_to && `to ${roundedDistance(level.distance_to)}`];
  return [["shown at distances", (level) => ends(level).filter(Boolean).join(" ") || "everywhere", ""]];
}

function ladderSection() {
  const { ladder } = record, byDistance = ladder.by === "distance";
  const columns = [["file", (level) => level.file, ""], ...(byDistance ? distanceColumns() : zoomColumns()), ...heldColumns];
  const note = byDistance ? make("p", { class: "note" }, `Distances in world units, for a canvas whose shorter side has ${ladder.canvas} px and a field of view of 45°. `
    + "A viewer chooses a level for each chunk, so that nearer and farther parts change at other times.") : null;
  return section("levels", "Levels", ladderChart(ladder), table(columns, ladder.levels), ...(note ? [note] : []));
}
