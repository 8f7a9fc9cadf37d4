"use strict";
// Two pictures of one view with a divider between them, the slider of zooms, and all pictures of the zoom side by side.

const STEP = 0.02, LEAP = 0.1; // of the width, for one press of an arrow key

/** The part of the page that compares pictures. */
function comparison() {
  let zoom = record.zooms[0], before, after, split = 0.5, pixel = 0;

  const left = make("img", { alt: "", draggable: "false" }), right = make("img", { alt: "", draggable: "false", class: "after" });
  const line = make("div", { class: "line", "aria-hidden": "true" });
  const canvas = make("div", { class: "canvas" }, left, right, line);
  const stage = make("div", {
    class: "stage", id: "stage", tabindex: "0", role: "slider", "aria-label": "divider between the two pictures",
    "aria-valuemin": "0", "aria-valuemax": "100", "aria-describedby": "keys",
  }, canvas);
  const nameLeft = make("span", { class: "name" }), nameRight = make("span", { class: "name right" });
  const selects = { before: picker("before", "left"), after: picker("after", "right") };
  const grid = make("div", { class: "grid", id: "pictures" }), caption = make("p", { class: "note", id: "view" });
  const viewers = make("div", { id: "viewers" });

  function picker(id, side) {
    return make("select", { id, "aria-label": `picture on the ${side}`, onchange: choose });
  }

  function choose() {
    before = zoom.pictures[selects.before.value];
    after = zoom.pictures[selects.after.value];
    left.src = before.src;
    right.src = after.src;
    left.alt = `${before.name} at ${zoom.label}`;
    right.alt = `${after.name} at ${zoom.label}`;
    nameLeft.replaceChildren(before.name, number(before));
    nameRight.replaceChildren(after.name, number(after));
    for (const card of grid.children) card.setAttribute("aria-pressed", card.dataset.index === selects.after.value);
    divide(split);
  }

  function number(picture) {
    const quality = picture.mean.psnr_db == null ? picture.view : picture.mean;
    return make("small", {}, quality.psnr_db == null ? "" : decibel(quality.psnr_db));
  }

  /** Move the divider to a part of the width: what is right of it shows the second picture. */
  function divide(part) {
    split = Math.min(1, Math.max(0, part));
    const percent = Math.round(split * 100);
    right.style.clipPath = `inset(0 0 0 ${split * 100}%)`;
    line.style.left = `${split * 100}%`;
    stage.setAttribute("aria-valuenow", percent);
    stage.setAttribute("aria-valuetext", `${percent} % ${before.name}, ${100 - percent} % ${after.name}`);
  }

  /** Show whole pixels: `pixel` screen pixels for one of the picture's, or as many as fit. */
  function resize() {
    const [width, height] = zoom.shown;
    const fitting = Math.min(stage.clientWidth / width, Math.max(240, innerHeight * 0.68) / height);
    const factor = pixel || (fitting > 1 ? Math.min(fitting, 16) : fitting);
    canvas.style.width = `${width * factor}px`;
    canvas.style.height = `${height * factor}px`;
    stage.classList.toggle("scrolls", width * factor > stage.clientWidth + 1);
  }

  function follow(event) {
    const box = canvas.getBoundingClientRect();
    divide((event.clientX - box.left) / box.width);
  }

  stage.addEventListener("pointermove", follow);
  stage.addEventListener("pointerdown", follow);
  stage.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? LEAP : STEP;
    const to = { ArrowLeft: split - step, ArrowRight: split + step, Home: 0, End: 1, " ": split > 0.5 ? 0 : 1 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    divide(to);
  });

  /** Go to a zoom, keeping what is compared where it is there too. */
  function go(index) {
    const names = before && [before.name, after.name];
    zoom = record.zooms[index];
    const first = (of, value, otherwise) => {
      const found = zoom.pictures.findIndex((each) => each[of] === value);
      return found < 0 ? otherwise : found;
    };
    const base = Math.max(0, zoom.pictures.map((each) => each.role).lastIndexOf("base"));
    const adapted = first("role", "adapted", zoom.pictures.length - 1);
    for (const select of Object.values(selects)) {
      select.replaceChildren(...zoom.pictures.map((each, i) => make("option", { value: i }, each.name)));
    }
    grid.replaceChildren(...zoom.pictures.map((each, i) => card(each, i)));
    selects.before.value = first("name", names?.[0], base);
    selects.after.value = first("name", names?.[1], adapted);
    const whole = zoom.size.join(" × "), part = zoom.shown.join(" × ");
    caption.textContent = [
      zoom.view && `View ${zoom.view}`, whole === part ? `${whole} px` : `the middle ${part} of ${whole} px`,
      zoom.truth && `dB against ${zoom.truth}`, zoom.mean_of && `large figures: mean of ${zoom.mean_of}; small ones: this view`,
    ].filter(Boolean).join(" · ");
    viewers.replaceChildren(...viewerSection(zoom));
    choose();
    resize();
  }

  function card(picture, index) {
    const mean = qualityTexts(picture.mean), view = qualityTexts(picture.view);
    return make("button", {
      type: "button", class: `card ${picture.role}`, "data-index": index, title: `Show ${picture.name} on the right`,
      onclick: () => { selects.after.value = index; choose(); stage.scrollIntoView({ block: "nearest" }); },
    },
    make("img", { src: picture.src, alt: `${picture.name} at ${zoom.label}` }),
    make("span", { class: "name" }, picture.name),
    mean.length ? make("strong", { class: "mean" }, mean[0]) : null,
    mean.length > 1 ? make("span", { class: "further" }, mean.slice(1).join(" · ")) : null,
    view.length ? make(mean.length ? "small" : "strong", { class: "of-view" }, `${mean.length ? "this view " : ""}${view.join(" · ")}`) : null,
    picture.note ? make("small", {}, picture.note) : null);
  }

  const pixels = make("select", { id: "pixel", "aria-label": "screen pixels for one of the picture's", onchange: (event) => {
    pixel = Number(event.target.value);
    resize();
  } }, ...[["0", "fitted"], ...[1, 2, 4, 8, 16].map((n) => [n, `1 px = ${n}`])].map(([value, text]) => make("option", { value }, text)));

  const controls = make("div", { class: "controls" }, zoomSlider(go), make("label", {}, "Left ", selects.before),
    make("label", {}, "Right ", selects.after), make("label", {}, "Pixels ", pixels));
  const keys = make("p", { class: "note", id: "keys" },
    "The divider follows the pointer. On the keyboard: ← and →, with Shift farther; Home and End; Space changes sides.");
  addEventListener("resize", resize);
  queueMicrotask(() => go(0));
  return [
    section("compare", "Compare", controls, make("figure", { class: "frame" }, make("div", { class: "names" }, nameLeft, nameRight), stage), keys),
    section("side-by-side", "Side by side", caption, grid),
    viewers,
  ];
}

/** The slider of zooms; nothing where there is one zoom only. */
function zoomSlider(go) {
  if (record.zooms.length < 2) return make("span", { class: "zoom" }, record.zooms[0].label);
  const slider = make("input", { type: "range", id: "zoom", min: 0, max: record.zooms.length - 1, step: 1, value: 0, list: "zooms" });
  const shown = make("output", { for: "zoom" }, record.zooms[0].label);
  slider.addEventListener("input", () => {
    const zoom = record.zooms[slider.value];
    shown.textContent = zoom.label;
    slider.setAttribute("aria-valuetext", zoom.label);
    go(Number(slider.value));
  });
  slider.setAttribute("aria-valuetext", record.zooms[0].label);
  const ticks = make("datalist", { id: "zooms" }, ...record.zooms.map((zoom, i) => make("option", { value: i, label: zoom.label })));
  return make("label", { class: "zoom" }, "Zoom ", slider, ticks, shown);
}

/** What viewers show of the base and of the adapted file. */
function viewerSection(zoom) {
  if (!zoom.viewers.length && !zoom.no_viewers) return [];
  if (!zoom.viewers.length) return [section("in-viewers", "What viewers will show", make("p", { class: "note" }, zoom.no_viewers))];
  const rows = zoom.viewers.map((viewer) => make("figure", { class: viewer.made_for ? "viewer made-for" : "viewer" },
    make("div", { class: "pair" }, ...[["base", viewer.base], ["adapted", viewer.adapted]].map(([word, picture]) =>
      make("div", {}, make("img", { src: picture.src, alt: `${picture.name} at ${zoom.label}` }),
        make("span", {}, word, " ", make("strong", {}, picture.view.psnr_db == null ? "" : decibel(picture.view.psnr_db)))))),
    make("figcaption", {}, viewer.title, viewer.made_for ? make("em", {}, " the file was made for it") : null)));
  return [section("in-viewers", "What viewers will show",
    make("p", { class: "note" }, zoom.in_viewers && `Adapted: ${zoom.in_viewers}. `, "Drawn with each viewer's own conventions, at this zoom; dB of this view. Viewers draw one file differently: "
      + "a file looks right in the viewer that it was made for (adapt --viewer NAME)."), make("div", { class: "viewers" }, ...rows))];
}
