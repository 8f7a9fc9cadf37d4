"use strict";
// Small helpers: making elements, and writing numbers.

const record = JSON.parse(document.getElementById("record").textContent);

/** An element with attributes and children; text becomes text, never markup. */
function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value === true) element.setAttribute(name, "");
    else if (value !== false && value != null) element.setAttribute(name, value);
  }
  element.append(...children.filter((child) => child != null && child !== ""));
  return element;
}

/** An SVG element. */
function draw(tag, attributes = {}, ...children) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

const SAME_DB = 120; // of identical images (evaluation/metrics.py)
const decibel = (value) => (value == null ? "–" : value >= SAME_DB ? "identical to the truth" : `${value.toFixed(2)} dB`);
const digits = (value, count) => (value == null ? "–" : value.toFixed(count));
/** A scale as people write it: ×1/4, ×4. */
const zoomName = (scale) => (scale < 1 && Math.abs(1 / scale - Math.round(1 / scale)) < 1e-9 ? `×1/${Math.round(1 / scale)}` : `×${scale}`);

const grouped = (value) => value.toLocaleString("en-US");
const splats = (count) => `${grouped(count)} splat${count === 1 ? "" : "s"}`;

/** PSNR, SSIM and LPIPS of a picture, as far as they were measured. */
function qualityTexts(quality) {
  return [
    quality.psnr_db == null ? "" : decibel(quality.psnr_db),
    quality.ssim == null ? "" : `SSIM ${digits(quality.ssim, 4)}`,
    quality.lpips == null ? "" : `LPIPS ${digits(quality.lpips, 4)}`,
  ].filter(Boolean);
}

/** A titled section of the page. */
function section(id, title, ...children) {
  return make("section", { id, "aria-labelledby": `${id}-title` }, make("h2", { id: `${id}-title` }, title), ...children);
}

/** A table: `columns` are [title, value of a row, "number" or ""]. */
function table(columns, rows, classOf = () => null) {
  const head = make("tr", {}, ...columns.map(([title, , kind]) => make("th", { scope: "col", class: kind || null }, title)));
  const body = rows.map((row) =>
    make("tr", { class: classOf(row) }, ...columns.map(([, value, kind]) => make("td", { class: kind || null }, String(value(row))))));
  return make("div", { class: "wide", tabindex: "0", role: "group", "aria-label": "table" },
    make("table", {}, make("thead", {}, head), make("tbody", {}, ...body)));
}
