"""What a demo ends with: a line for each zoom, what it was drawn for, how long it took, and where to look."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mipmap_plugin.errors import plural
from mipmap_plugin.evaluation.evaluate import Row
from mipmap_plugin.formats.here import from_here

# What is wrong with a base at other zooms (Mip-Splatting, section 1).
ZOOMED_OUT, ZOOMED_IN = "thick and bright", "needles and holes"


def story(rows: Sequence[Row], viewer: str | None, seconds: float, output: Path, page: Path | None) -> str:
    """Lines for people. rows: the evaluations named base and adapted of each scale, among others; seconds: of the whole demo."""
    by_name = {(row.scale, row.name): row for row in rows}
    scales = list(dict.fromkeys(row.scale for row in rows))
    drawn = f"in {viewer}" if viewer else "in viewers that draw as 3DGS does"
    lines = [f"The embedded scene {drawn}, three views that nothing was trained on, dB against the ray-traced world:"]
    for scale in scales:
        base, adapted = by_name[scale, "base"], by_name[scale, "adapted"]
        fault = f" ({ZOOMED_OUT if scale < 1 else ZOOMED_IN})" if scale != 1 else ""
        change = f"base {base.psnr_db:.1f} dB{fault} -> adapted {adapted.psnr_db:.1f} dB"
        lines.append(f"  {_zoom(scale):5}{change}, {base.gaussians:,} -> {plural(adapted.gaussians, 'splat')}, in {adapted.adapt_seconds:.0f} s")
    lines.append(f"All of it took {seconds:.0f} s. Files and pictures (base | adapted | truth): {from_here(output)}")
    return "\n".join([*lines, *([f"page: {from_here(page)}"] if page else [])])


def _zoom(scale: float) -> str:
    return f"x1/{1 / scale:g}" if scale < 1 else f"x{scale:g}"
