"""The panel of the page: what can be set, and what is told. It uses viser's objects without importing it."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import torch

from mipmap_plugin.errors import plural, some_of
from mipmap_plugin.pages.record import zoom_name
from mipmap_plugin.viewing.adapting import Progress
from mipmap_plugin.viewing.stage import Look, Picture

# The zoom slider, in powers of two: the least and the largest zoom, and a step.
STOPS = (-6.0, 4.0, 0.1)
MARKS = tuple((float(stop), zoom_name(2.0**stop)) for stop in (-6, -3, 0, 2, 4))  # as many as have room on a phone

# The slider of a moving scene's moments: the least and the last one, and a step.
MOMENTS = (0.0, 1.0, 0.01)

# Words for what is None in the state.
AS_TRAINED, NOTHING = "as trained", "nothing"

# What the menu of views shows.
NOWHERE = "choose ..."

DISTANCE, LENS = "distance", "focal length"

# px of the screen along each side of a pixel of the picture.
PIXELS = ("1", "2", "4", "8")

CURVE = "dB of this picture against the supersampled base, over seconds"

# What Markdown and the HTML in it take for marks: viser renders both, scripts too.
MARK = re.compile(r"([\\`*_\[\]<>&~#|!])")

LEAST_S, USUAL_S, MOST_S = 1.0, 30.0, 3600.0


class Controls:
    """The elements of the panel."""

    def __init__(
        self, gui: Any, names: Sequence[str], viewers: Sequence[str], views: Sequence[str], recipes: Sequence[str], moment: float | None
    ) -> None:
        """`gui`: viser's; `names` of what can be shown; `viewers`, the chosen one first, None as AS_TRAINED; `moment`: of a moving scene, the
        one that is shown first."""
        self._stops = 0.0, 0.0  # of the slider: for the last picture, and where it was then
        self.figures = gui.add_markdown("drawing the first picture ...")
        with gui.add_folder("Show"):
            self.source = gui.add_dropdown("Show", names, initial_value=names[0])
            self.against = gui.add_dropdown("Difference from", (NOTHING, *names), initial_value=NOTHING, hint="four times as strong as it is")
            self.viewer = gui.add_dropdown("Drawn by", viewers, initial_value=viewers[0], hint="as which viewer our own backend draws")
            self.pixel = gui.add_dropdown("Enlarge pixels", PIXELS, initial_value="1", hint="what a screen with fewer pixels shows")
        with gui.add_folder("Camera"):
            self.zoom = gui.add_slider(
                "Zoom, 2 to the", *STOPS, initial_value=0.0, marks=MARKS, hint="pixels of the screen per pixel of the training, at the median splat"
            )
            self.by = gui.add_dropdown("Zoom by", (DISTANCE, LENS), initial_value=DISTANCE)
            self.view = gui.add_dropdown("Go to view", (NOWHERE, *views), initial_value=NOWHERE)
            self.time = None if moment is None else gui.add_slider("Time", *MOMENTS, initial_value=moment, hint="moment of a moving scene, 0 to 1")
        with gui.add_folder("Adapt"):
            self.seconds = gui.add_number("Seconds", USUAL_S, min=LEAST_S, max=MOST_S, step=1.0, hint="at most")
            self.recipe = gui.add_dropdown("Recipe", recipes, initial_value=recipes[0])
            self.adapt = gui.add_button("Adapt for this picture", hint="for what is on the screen now, at its zoom, for the viewer that draws it")
            self.stop = gui.add_button("Stop", disabled=True)
            self.save = gui.add_button("Save", disabled=True, hint="what was adapted last, beside the checkpoint")
            self.told = gui.add_markdown("")
            base = {"label": "base", "stroke": "#888888", "width": 1.0, "dash": (6.0, 4.0), "points": {"show": False}}
            series = ({"label": "s"}, {"label": "adapted", "stroke": "#2563eb", "width": 2.0}, base)
            scales = {"x": {"time": False}}
            self._curve = gui.add_uplot(_columns(Progress(curve=((0.0, 0.0),))), series, title=CURVE, scales=scales, aspect=1.6, visible=False)

    def look(self) -> Look:
        """What the page is set to."""
        against, viewer = self.against.value, self.viewer.value
        return Look(
            self.source.value, None if against == NOTHING else against, None if viewer == AS_TRAINED else viewer, int(self.pixel.value),
            None if self.time is None else self.time.value,
        )  # fmt: skip

    def show_moment(self, moment: float | None) -> None:
        """Set the slider of a moving scene to a moment; None: leave it."""
        if self.time is not None and moment is not None:
            self.time.value = moment

    def offer(self, names: Sequence[str], shown: str) -> None:
        """Offer other things to show, and show one of them."""
        self.source.options, against = tuple(names), self.against.value
        self.against.options = (NOTHING, *names)
        self.against.value = against if against in names else NOTHING
        self.source.value = shown

    def tell_picture(self, picture: Picture) -> None:
        """Show a picture's figures."""
        self.figures.content = figures(picture)
        self._stops = round(min(max(math.log2(picture.zoom), STOPS[0]), STOPS[1]), 1), self.zoom.value

    def follow(self) -> None:
        """Set the slider to the zoom of the last picture, unless a hand has moved it since; then there will be another picture."""
        if self.is_missed():
            self.zoom.value = self._stops[0]

    def is_missed(self) -> bool:
        """Whether the last picture has another zoom than the slider, which no hand has moved since."""
        stop, then = self._stops
        return self.zoom.value == then and abs(stop - then) > STOPS[2] / 2

    def tell_progress(self, progress: Progress) -> None:
        """Show how far a run is, with its curve."""
        self.adapt.disabled, self.stop.disabled = progress.running, not progress.running
        self.save.disabled = progress.adapted is None
        self.told.content = words(progress)
        if len(progress.curve) > 1:  # one point is no curve
            self._curve.data, self._curve.visible = _columns(progress), True


def _columns(progress: Progress) -> tuple[Any, ...]:
    """Seconds, dB of the run and dB of the base, each as NumPy's."""
    seconds, psnrs = zip(*progress.curve, strict=True)
    base = [progress.base_db or 0.0] * len(seconds)
    return tuple(torch.tensor(column, dtype=torch.float64).numpy() for column in (seconds, psnrs, base))


def plain(text: str) -> str:
    """A text as Markdown that shows it as it is, whatever names of files are in it."""
    return MARK.sub(r"\\\1", text)


def figures(picture: Picture) -> str:
    """A picture's figures, in Markdown."""
    splats = [] if picture.splats is None else [some_of(*picture.splats, "splat")]
    difference = [] if picture.psnr_db is None else [f"{picture.psnr_db:.2f} dB apart"]
    parts = [f"{picture.drawn.width} × {picture.drawn.height} px", f"{1000 * picture.seconds:,.0f} ms", *splats, *difference]
    return f"**×{picture.zoom:.3g}** · {plain(picture.shown)}\n\n{' · '.join(parts)}"


def words(progress: Progress) -> str:
    """How far a run is, in Markdown."""
    if progress.wish is None:
        return ""
    name = f"×{progress.wish.scale:g} for {progress.wish.viewer or 'renderers that draw as its training did'}"
    if progress.trouble:
        return f"{name}: {plain(progress.trouble)}"
    if progress.adapted is not None:
        report = progress.adapted.report
        before, after = report.psnr_before(), report.psnr_after()
        gain = "" if before is None or after is None else f"{before:.2f} → {after:.2f} dB on views that nothing was adapted to, "
        return f"{name}: {gain}{report.gaussians_before:,} → {plural(report.gaussians_after, 'splat')}, {report.seconds['total']:.1f} s"
    return f"{name}: step {progress.step}" if progress.curve else f"{name}: preparing ..."
