"""How models look in a notebook: a table with a picture; elsewhere a line of text."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

from torch import Tensor

from mipmap_plugin.adaptation.report import Report
from mipmap_plugin.camera import Camera
from mipmap_plugin.formats.images import data_uri
from mipmap_plugin.scenes.base import sizes_of

if TYPE_CHECKING:
    from mipmap_plugin.models.base import SplatModel, TrainedScale

# px: the part of a view that is drawn, and the width at which it is shown.
DRAWN, SHOWN = 256, 256

Render = Callable[[Camera], Tensor]  # a camera -> [h, w, 3]


def base_facts(model: SplatModel, cameras: Sequence[Camera], trained: TrainedScale) -> dict[str, str]:
    """What a base is, by name."""
    views = f"{len(cameras)} of {sizes_of(cameras)}" if cameras else "none"
    return {
        "family": model.family,
        "splats": f"{len(model.parameters()['means']):,}",
        "cameras": views,
        "drawn with": trained.told(),
        "file": "in memory" if model.source is None else str(model.source),
    }


def adapted_facts(model: SplatModel, report: Report) -> dict[str, str]:
    """What an adapted model is and gained, by name."""
    before, after = report.psnr_before(), report.psnr_after()
    gain = {} if before is None or after is None else {"PSNR": f"{before:.2f} -> {after:.2f} dB on views that nothing was adapted to"}
    return {
        "family": model.family,
        "scale": f"x{report.scale:g}",
        "made for": report.viewer or f"what draws with {model.trained.told()}",
        "splats": f"{report.gaussians_before:,} -> {report.gaussians_after:,}",
        **gain,
        "seconds": f"{report.seconds['total']:.1f}, ended by {report.ended_by}",
    }


def line(kind: str, facts: Mapping[str, str]) -> str:
    return f"<{kind}: {', '.join(f'{name} {value}' for name, value in facts.items())}>"


def table(kind: str, facts: Mapping[str, str], render: Render, view: Camera) -> str:
    """The facts as an HTML table, beside the middle of a view in whole pixels."""
    left = "style='text-align:left'"
    rows = "".join(f"<tr><th {left}>{escape(name)}</th><td {left}>{escape(value)}</td></tr>" for name, value in facts.items())
    image = render(view.window(DRAWN, DRAWN))
    picture = f"<img src='{data_uri(image, DRAWN)}' alt='{escape(view.name)}' style='width:{SHOWN}px;image-rendering:pixelated'>"
    return f"<div style='display:flex;gap:1.5em;align-items:center'>{picture}<div><b>{escape(kind)}</b><table>{rows}</table></div></div>"
