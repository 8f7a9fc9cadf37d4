"use strict";
// A ladder of levels: dB over zoom with the switches, and its files.

const roundedZoom = (zoom) => zoomName(Number(zoom.toPrecision(3)));

/** dB over zoom, from the finest to the coarsest: the level that is shown at each, and the base alone. */
function ladderChart(ladder) {
  const { curve, switches } = ladder, zooms = curve.map((each) => each.zoom);
  const halves = Array.from({ length: 12 }, (_, i) => 2 ** -i).filter((zoom) => zoom <= zooms[0] * 1.001 && zoom >= zooms.at(-1) * 0.999);
  const { svg, place } = plot({
    title: "dB over zoom", x: [zooms[0], zooms.at(-1)], y: spread(curve.flatMap((each) => [each.psnr_db, each.base_db])),
    xTicks: halves, nameOf: zoomName, bend: Math.log2, xLabel: "zoom", yLabel: "dB",
  });
  const readout = make("p", { class: "readout", "aria-live": "polite" }, "Point at a mark to read it.");
  for (const each of switches) {
    const x = place.x(each.zoom);
    svg.append(draw("line", { class: "switch", x1: x, x2: x, y1: MARGIN.top, y2: HEIGHT - MARGIN.bottom }));
    svg.append(draw("text", { x, y: MARGIN.top - 3, "text-anchor": "middle" }, roundedZoom(each.zoom)));
  }
  svg.append(draw("path", { class: "base-line", fill: "none", d: path(curve.map((each) => [place.x(each.zoom), place.y(each.base_db)])) }));
  for (const level of ladder.levels.keys()) {
    const shown = curve.filter((each) => each.level === level).map((each) => [place.x(each.zoom), place.y(each.psnr_db)]);
    svg.append(draw("path", { class: "curve", d: path(shown) }));
  }
  for (const each of curve) {
    const text = `${roundedZoom(each.zoom)}: ${decibel(each.psnr_db)} with ${ladder.levels[each.level].file}, ${decibel(each.base_db)} with the base alone`;
    svg.append(point(place.x(each.zoom), place.y(each.psnr_db), "mark", text, readout));
  }
  return make("figure", { class: "chart" }, make("figcaption", {}, `In ${ladder.viewer}: levels, and the base alone (dashed); dotted: switches`), svg, readout,
    make("p", { class: "note" }, ladder.measured));
}

function ladderSection() {
  const { ladder } = record;
  const shown = (level) => [level.shown_to && `below ${roundedZoom(level.shown_to)}`, level.shown_from && `from ${roundedZoom(level.shown_from)}`];
  const columns = [
    ["file", (level) => level.file, ""], ["made for", (level) => roundedZoom(level.scale), ""],
    ["shown", (level) => shown(level).filter(Boolean).join(", ") || "always", ""],
    ["least dB", (level) => digits(Math.min(...Object.values(level.psnr_db)), 1), "number"],
    ["splats", (level) => grouped(level.splats), "number"], ["MB", (level) => digits(level.bytes / 1e6, 2), "number"],
    ["s", (level) => digits(level.seconds, 0), "number"],
  ];
  return section("levels", "Levels", ladderChart(ladder), table(columns, ladder.levels));
}
