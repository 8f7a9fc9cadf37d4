"""`mipmap-plugin demo`: adapts the embedded scene, and evaluates the result against its ray-traced truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from torch import Tensor

from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.camera import Camera
from mipmap_plugin.demo.story import story
from mipmap_plugin.demo.world import render_world
from mipmap_plugin.evaluation.evaluate import Evaluator, Row, adapted_row, training_free_rows
from mipmap_plugin.evaluation.protocols import Protocol
from mipmap_plugin.evaluation.report import table
from mipmap_plugin.formats.atomic import refuse_output, refuse_unwritable
from mipmap_plugin.formats.images import beside_each_other, write_image
from mipmap_plugin.pages.gallery import Gallery
from mipmap_plugin.pages.html import write_page
from mipmap_plugin.pages.reports import evaluation_page
from mipmap_plugin.process import threads
from mipmap_plugin.progress import announced
from mipmap_plugin.scenes import read_cameras
from mipmap_plugin.wrap import Wrapped, wrap_model

PROTOCOL = Protocol("demo", "box")

# Number of views to evaluate on, and the fraction of each side that is evaluated at zoom-in, since the truth has to be ray-traced.
JUDGED, MIDDLE = 3, 1 / 3

# What the images are compared with, and the page that shows them.
TRUTH, PAGE = "the ray-traced world", "report.html"

# Samples per pixel of the truth: more where pixels are larger and fewer.
SAMPLES = {True: 64, False: 4}  # zoomed out, zoomed in

# Pictures are shown at this many px, so that a small image is enlarged pixel by pixel and the eye sees what a screen shows.
SHOWN = 480

# Seconds to adapt to each scale at most, where there is only the reference: the demo should end within three minutes. It then adapts to
# every so many-th training view, one a step, for the truth of a view costs as much as some steps.
REFERENCE_BUDGET_S = 45.0
REFERENCE_EVERY = 4


class WorldView:
    """A view with a truth at any scale, because the world is ray-traced."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera

    @cache  # noqa: B019  views live as long as the demo
    def truth(self, scale: float, protocol: Protocol) -> Tensor:
        """[h, w, 3] at `scale` times the base scale."""
        return protocol.quantized(render_world(self.camera.zoomed(scale), samples=SAMPLES[scale < 1]))


def embedded() -> Wrapped:
    """Wrap the demo's base checkpoint with its cameras."""
    home = Path(str(files("mipmap_plugin.demo")))
    return wrap_model(home / "base.ply", cameras=read_cameras(home / "cameras.json", {"eval": True}), background=(1.0, 1.0, 1.0))


def run_demo(
    output: Path,
    scales: Sequence[float],
    viewer: str | None = None,
    *,
    report: bool = False,
    overwrite: bool = False,
    detail: Callable[[str], None] = lambda text: None,
) -> str:
    """Adapt to each scale, write checkpoints, pictures and (`report`) a page into `output`, and return what it tells people; `detail` gets the table.

    Raises OutputExists.
    """
    began = time.perf_counter()
    base = embedded()
    base.target(viewer)
    for name in (*(f"x{scale:g}.ply" for scale in scales), *([PAGE] if report else ())):
        refuse_output(output / name, overwrite, is_file=True)
        refuse_unwritable(output / name)
    rows, gallery = list[Row](), Gallery(base, TRUTH) if report else None
    for scale in scales:
        judge = Evaluator(judged_views(base, scale), PROTOCOL, watcher=gallery)
        # Adapted first, because that begins with all compilation, on two cores.
        adapted = base.adapt(scale, viewer=viewer, resize="box", **settings_for(base))
        # Without the window filter, which takes most of a minute a view on the reference.
        rows += training_free_rows(base, judge, scale, filters=("scaled", "antialiased"), viewer=viewer)
        rows.append(adapted_row("adapted", adapted, judge))
        adapted.save(output / f"x{scale:g}.ply", overwrite=overwrite)
        view = judge.views[0]
        camera = view.camera.zoomed(scale)
        pictures = [base.render(camera, viewer=viewer).image, adapted.render(camera).image, view.truth(scale, PROTOCOL)]
        write_image(output / f"x{scale:g}_base_adapted_truth.png", shown(pictures), overwrite=overwrite)
    page = _page(output, gallery, rows, viewer, overwrite) if gallery else None
    detail(table(rows))
    return story(rows, viewer, time.perf_counter() - began, output, page)


def _page(output: Path, gallery: Gallery, rows: Sequence[Row], viewer: str | None, overwrite: bool) -> Path:
    """Write the page of a demo; return its path."""
    scales = dict.fromkeys(row.scale for row in rows)
    options = [*(f"--scale {scale:g}" for scale in scales), *([f"--viewer {viewer}"] if viewer else [])]
    commands = [f"mipmap-plugin {' '.join([command, *options])}" for command in ("demo", "adapt YOUR_CHECKPOINT")]
    page = evaluation_page("The embedded scene, at other zooms", [gallery], rows, commands=commands)
    return write_page(output.resolve() / PAGE, page, overwrite)


def judged_views(base: Wrapped, scale: float) -> list[WorldView]:
    """Test views, of a zoom-in their middle, whose true images at `scale` are made."""
    cameras = [camera for camera in base.cameras if camera.split == "test"]
    cameras = cameras[:: len(cameras) // JUDGED][:JUDGED]
    if scale > 1:
        cameras = [camera.window(round(camera.width * MIDDLE), round(camera.height * MIDDLE)) for camera in cameras]
    views = [WorldView(camera) for camera in cameras]
    with announced(f"ray-tracing the truth x{scale:g}"), threads.limited(None, shared=True):
        list(threads.side_by_side(lambda view: view.truth(scale, PROTOCOL), views, threads.for_views()))
    return views


def settings_for(base: Wrapped) -> dict[str, Any]:
    """Those of the recipe, and less work where only the reference can do it."""
    if base.backend(gradients=True)[0].name != "reference":
        return {}
    train = [camera for camera in base.cameras if camera.split == "train"][::REFERENCE_EVERY]
    return dict(cameras=train, views="given", views_per_step=1, time_budget_s=REFERENCE_BUDGET_S)


def shown(pictures: Sequence[Tensor]) -> Tensor:
    """Pictures [h, w, 3] of one size beside each other, each about SHOWN px high."""
    height, width = pictures[0].shape[:2]
    if height > SHOWN:
        pictures = [resize(picture.cpu(), (SHOWN, round(width * SHOWN / height)), "pil-bicubic") for picture in pictures]
    return beside_each_other(pictures, SHOWN, SHOWN // 40)
