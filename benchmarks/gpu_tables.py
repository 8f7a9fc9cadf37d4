"""Tables, as Markdown, of what was measured on a GPU."""

from __future__ import annotations

from collections.abc import Sequence

from gpu_records import Adaptation, Checked, FirstUse, Kernel, Profile, Speed, Views

from mipmap_plugin.evaluation.report import markdown

YARDSTICK = "gsplat itself"
PAPER = "Mipmap-GS needs 40 s for a zoom-out and 75 s for a zoom-in of bicycle on an A100, its targets not counted (arXiv 2408.06286)."


def speed_table(rows: Sequence[Speed], bandwidth: float) -> str:
    """`bandwidth`: bytes a second of a copy within the device's memory. Empty where nothing was timed."""
    yardsticks = {(row.splats, row.width, row.height, row.mode): row for row in rows if row.backend == YARDSTICK}
    head = ["splats", "px", "filter", "backend", "forward, ms", "fwd+bwd, ms", "x gsplat", "GB/s", "of a copy's", "peak, MiB"]
    body = []
    for row in rows:
        other = yardsticks.get((row.splats, row.width, row.height, row.mode))
        times = f"{other.forward_ms / row.forward_ms:.2f} / {other.both_ms / row.both_ms:.2f}" if other else "-"
        moved = row.both_bytes / row.both_ms * 1000
        place = [f"{row.splats:,}", f"{row.width} x {row.height}", row.mode, row.backend]
        part = f"{moved / bandwidth:.1%}" if bandwidth else "-"
        figures = [f"{row.forward_ms:.2f}", f"{row.both_ms:.2f}", times, f"{moved / 1e9:.0f}", part, f"{row.peak_mib:.0f}"]
        body.append(place + figures)
    intro = (
        "From raw parameters to the image, and back to all of them. x gsplat: how many times faster than gsplat as its own users call it, without "
        "what our backend adds, forward / both. GB/s: only what has to move at least, forward and backward. playcanvas: as the steps of an "
        "adaptation draw it, without rounding."
    )
    return f"## Speed\n\n{intro}\n\n{markdown(head, body)}" if body else ""


def views_table(rows: Sequence[Views]) -> str:
    """Empty where nothing was timed."""
    head = ["px", "views", "backend", "one after the other, ms a view", "in one call, ms a view", "a whole step, ms a view"]
    body = [
        [str(row.width), str(row.views), row.backend, f"{row.alone_ms:.3f}", "-" if row.together_ms is None else f"{row.together_ms:.3f}",
         f"{row.step_ms:.3f}"]
        for row in rows
    ]  # fmt: skip
    intro = "Small views of lego_200, forward and backward; a step in the quickest way of the backend, with Adam (elsewhere torch's, fused)."
    return f"## Small views\n\n{intro}\n\n{markdown(head, body)}" if body else ""


def profile_table(rows: Sequence[Profile], bandwidth: float) -> str:
    """Empty where nothing was profiled."""
    head = ["splats", "px", "backend", "kernel", "us", "of all kernels'", "launches", "GB/s", "of a copy's", "occupancy", "registers"]
    body = [
        [f"{row.splats:,}", f"{row.width} x {row.height}", row.backend, f"`{kernel.name}`", f"{kernel.us:.0f}", f"{kernel.us / row.all_us:.0%}",
         f"{kernel.launches:g}", *_moved(kernel, bandwidth), "-" if kernel.occupancy is None else f"{kernel.occupancy:g}%",
         str(kernel.registers or "-")]
        for row in rows for kernel in row.kernels
    ]  # fmt: skip
    intro = (
        "Those that take the most time of an image and its gradients. GB/s: only what has to move at least, if lists are read to their ends, which "
        "tiles that are opaque before do not. Occupancy: as the profiler estimates it."
    )
    return f"## Kernels\n\n{intro}\n\n{markdown(head, body)}" if body else ""


def _moved(kernel: Kernel, bandwidth: float) -> tuple[str, str]:
    """GB/s, and the part that they are of a copy's."""
    if kernel.least_bytes is None or not kernel.us:
        return "-", "-"
    moved = kernel.least_bytes / kernel.us * 1e6
    return f"{moved / 1e9:.0f}", f"{moved / bandwidth:.0%}" if bandwidth else "-"


def conformance_table(checked: Sequence[Checked]) -> str:
    """Empty where nothing was checked."""
    body, wrong = [], []
    for row in checked:
        drawn = row.cases - row.skipped
        body.append([row.backend, f"{drawn - len(row.failed)} of {drawn}", str(row.skipped), str(row.unchecked)])
        wrong += [f"- {row.backend}, {case}: {message[:240]}" for case, message in row.failed.items()]
    table = markdown(["backend", "hard cases right", "not served", "not reached"], body)
    return "\n\n".join(filter(None, ["## Hard cases", table, "\n".join(wrong)])) if body else ""


def adaptation_table(rows: Sequence[Adaptation]) -> str:
    """Empty where nothing was adapted."""
    head = ["base", "zoom", "viewer", "backend", "seconds", "again", "steps", "dB", "on a processor", "peak, MiB", "phases, s", "ended by"]
    body = [
        [row.base, f"x{row.scale:g}", row.viewer or "-", row.backend, f"{row.seconds:.2f}", f"{row.again_seconds:.2f}", str(row.steps),
         f"{row.psnr_db:.2f}",
         "-" if row.processor_db is None else f"{row.processor_db:.2f}",
         "-" if row.peak_mib is None else f"{row.peak_mib:.0f}", _phases(row), row.ended_by]
        for row in rows
    ]  # fmt: skip
    intro = (
        "Recipe `default`. dB: of lego and chair on real test images that nothing was adapted to; of flowers, and for viewers, on held-out views of "
        "the base's own. "
        f"Again: of a second adaptation, which has the base's images. {PAPER}"
    )
    return f"## Adaptation\n\n{intro}\n\n{markdown(head, body)}" if body else ""


def _phases(row: Adaptation) -> str:
    longest = sorted(row.phases.items(), key=lambda phase: -phase[1])
    return ", ".join(f"{name} {seconds:.2f}" for name, seconds in longest if name not in ("total", "loading") and seconds >= 0.005)


def first_use_table(rows: Sequence[FirstUse]) -> str:
    """Empty where nothing was measured."""
    body = [
        [row.backend, row.viewer or "-", f"{row.first_s:.1f}", f"{row.compilation_s:.1f}", f"{row.again_s:.1f}", f"{row.again_compilation_s:.1f}"]
        for row in rows
    ]
    table = markdown(["backend", "viewer", "first command, s", "of it compilation", "second command, s", "of it compilation"], body)
    return f"## First use\n\nThe command `adapt` on lego_200 at x1/4 with ten steps, and the same again.\n\n{table}" if body else ""
