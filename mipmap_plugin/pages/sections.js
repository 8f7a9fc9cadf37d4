"use strict";
// The page, from the record: what there is nothing of gets no section.

const page = document.getElementById("page");

/** The rows of an evaluation, as the command printed them. */
function rowsSection() {
  const has = (name) => record.rows.some((row) => row[name] != null && row[name] !== "");
  const columns = [
    ...(new Set(record.rows.map((row) => row.scene)).size > 1 ? [["scene", (row) => row.scene, ""]] : []),
    ["zoom", (row) => `${zoomName(row.scale)}`, ""], ["what", (row) => row.name, ""],
    ["PSNR dB", (row) => digits(row.psnr_db, 2), "number"], ["SSIM", (row) => digits(row.ssim, 4), "number"],
    ...(has("lpips") ? [[record.rows.find((row) => row.lpips_label).lpips_label, (row) => digits(row.lpips, 4), "number"]] : []),
    ["adapt s", (row) => digits(row.adapt_seconds, 1), "number"], ["ms a view", (row) => digits(row.ms_per_view, 0), "number"],
    ["splats", (row) => grouped(row.gaussians), "number"],
  ];
  return section("rows", "All figures", table(columns, record.rows, (row) => (row.adapt_seconds > 0 ? "ours" : null)));
}

function tradeoffSection() {
  const scales = record.tradeoffs.map((scale) => [
    make("p", { class: "note" }, `${zoomName(scale.scale)}, ${scale.truth}: ${scale.sentences.seconds}; ${scale.sentences.frames}.`), tradeoffCharts(scale),
  ]);
  return section("tradeoff", "Accuracy and time", ...scales.flat());
}

// At scale 1 the base is returned as it is, so that there is no curve.
const optimized = record.adaptations.filter((report) => report.curve.some((each) => each.validation_db != null));

function curveSection() {
  return section("curve", "While it adapted", make("div", { class: "charts" }, ...optimized.map(curveChart)));
}

function effectsSection() {
  const item = (effect) => make("li", {}, make("strong", {}, effect.name), ` ${effect.reason}`);
  const on = record.effects.filter((effect) => effect.on), off = record.effects.filter((effect) => !effect.on);
  // Files for other viewers and zooms have effects of their own, and the page tells the first one's.
  const [first] = record.adaptations, differ = record.adaptations.some((report) => JSON.stringify(report.effects) !== JSON.stringify(record.effects));
  return section("effects", "What is simulated, and why",
    ...(differ ? [make("p", { class: "note" }, `Of ${first.title}. Those of the others are in the record of this page.`)] : []),
    make("ul", { class: "effects" }, ...on.map(item)),
    make("details", {}, make("summary", {}, `${off.length} effects that this scene does not call for`), make("ul", { class: "effects off" }, ...off.map(item))));
}

/** Names and values of a nested record, one a line. */
function facts(values, prefix = "") {
  return Object.entries(values).flatMap(([name, value]) => {
    if (value !== null && typeof value === "object" && !Array.isArray(value)) return facts(value, `${prefix}${name}.`);
    return [make("dt", {}, prefix + name), make("dd", {}, Array.isArray(value) ? value.join(", ") : String(value))];
  });
}

function provenanceSection() {
  const reports = record.adaptations.map((report) => make("details", {}, make("summary", {}, `${report.title}: settings and provenance`),
    make("dl", {}, ...facts({
      base: report.base, viewer: report.viewer, backend: report.backend, views: report.views, filters: report.filters, returned: report.returned,
      "ended by": report.ended_by, validation: report.validation, seconds: report.seconds, settings: report.settings, versions: report.versions,
    }))));
  return section("provenance", "Where it comes from", make("dl", { class: "short" }, ...facts(record.provenance)), ...reports);
}

function commandSection() {
  const lines = record.commands.map((command) => {
    const words = command.split(" ").map((word, i) => [i ? " " : "", word.startsWith("-") ? make("span", { class: "option" }, word) : word]);
    const code = make("code", { tabindex: "0" }, ...words.flat());
    const copy = make("button", { type: "button", class: "copy", onclick: () => {
      getSelection().selectAllChildren(code);
      copy.textContent = document.execCommand("copy") ? "copied" : "selected";
    } }, "copy");
    return make("div", { class: "command" }, code, copy);
  });
  return section("again", "Make it again", ...lines);
}

document.title = `${record.title} · mipmap_plugin`;
document.getElementById("title").textContent = record.title;
document.getElementById("lead").textContent = record.lead;
page.append(
  ...(record.zooms.length ? comparison() : []),
  ...(record.ladder ? [ladderSection()] : []),
  ...(record.tradeoffs.length ? [tradeoffSection()] : []),
  ...(record.rows.length ? [rowsSection()] : []),
  ...(optimized.length ? [curveSection()] : []),
  ...(record.notes.length ? [section("notes", "Notes", make("ul", {}, ...record.notes.map((note) => make("li", {}, note))))] : []),
  ...(record.effects.length ? [effectsSection()] : []),
  ...(record.commands.length ? [commandSection()] : []),
  provenanceSection(),
);
document.getElementById("footer").textContent = "Everything on this page is in this file: its figures are in the element with the id record, as JSON.";
