"""How exact the backends are: float32 against float64 over scale, distance and shape, and known errors of usual formulas beside our own.

    python benchmarks/numerics.py          # a minute; prints the tables, writes results/numerics.md and docs/numerics.png

Every figure is computed from the same numbers, rounded to float32 first, so that only the arithmetic differs. The float64 reference is
the yardstick; its own gradients are checked against finite differences in the tests.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import torch
from numerics_usual import UsualFormulas, gsplat_compensation_slope, mip_compensation, published_gradient_share, unnormalized_axes

from mipmap_plugin.adaptation.plot import figure_class
from mipmap_plugin.backends import get_backend
from mipmap_plugin.backends.conformance.cases import HardCase, crowd, far_from_the_origin, odd_row, view
from mipmap_plugin.backends.conformance.checks import Answer, draw
from mipmap_plugin.camera import Camera
from mipmap_plugin.effects import Effects
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import RenderSettings
from mipmap_plugin.splatting.filters import LEAST_COMPENSATION, footprint
from mipmap_plugin.splatting.projection import Projected, _from_factors

HERE = Path(__file__).parent
SUBJECTS = {"reference": lambda: get_backend("reference"), "cpu": lambda: get_backend("cpu"), "usual formulas": UsualFormulas}
Row = tuple[str, ...]


def at_scale(scale: float) -> HardCase:
    return HardCase(crowd(48), view(8, 6).zoomed(scale), Effects(1))


def at_distance(distance: float) -> HardCase:
    """The scene and all in it `distance` times as large, seen from the same eye: the image is the same."""
    splats = crowd(48)
    larger = Gaussians(splats.means * distance, splats.quats, splats.scales * distance, splats.opacities, splats.sh)
    return HardCase(larger, view(turned=True), Effects(1, near_plane=1e-4))


def needle(ratio: float) -> HardCase:
    """A needle among others, `ratio` between the eigenvalues of its covariance."""
    stretch = ratio**0.25
    row = {"scales": torch.tensor([0.1 * stretch, 0.1 / stretch, 0.1 / stretch], dtype=torch.float64)}
    return odd_row({**row, "quats": torch.tensor([0.8, 0.1, -0.3, 0.5], dtype=torch.float64)})


SWEEPS: dict[str, tuple[Callable[[float], HardCase], list[float]]] = {
    "scale": (at_scale, [2.0**k for k in range(-6, 7)]),
    "distance, world units": (at_distance, [10.0**k for k in range(-3, 7)]),
    "units from the world's origin": (partial(far_from_the_origin, size=1.0), [10.0**k for k in range(7)]),
    "ratio of eigenvalues": (needle, [10.0**k for k in range(0, 13)]),
}


def errors(build: Callable[[float], HardCase], value: float) -> dict[str, tuple[float, float]]:
    """By subject: the largest error of the image, in units of its brightest pixel, and the largest of a gradient, relative, by field."""
    case = build(value)
    rounded = case.gaussians.to(dtype=torch.float32)
    exact = draw(get_backend("reference"), case._replace(gaussians=rounded.to(dtype=torch.float64)))
    return {name: _gap(draw(make(), case._replace(gaussians=rounded)), exact) for name, make in SUBJECTS.items()}


def _gap(actual: Answer, exact: Answer) -> tuple[float, float]:
    image = float((actual.image - exact.image).abs().max()) / max(1.0, float(exact.image.abs().max()))
    gradients = [float((actual.gradients[name] - right).norm() / right.norm()) for name, right in exact.gradients.items() if right.norm() > 0]
    return image, max(gradients, default=0.0)


# Known errors of usual formulas, each measured on the smallest example.


def vanishing_gradients() -> list[Row]:
    """A round splat far below a pixel under a dilation that shrinks with the zoom: d(opacity on its center)/d(log scale) against float64."""
    rows = []
    for zoom in (1, 1 / 4, 1 / 16, 1 / 64):
        eps2d = 0.3 * zoom
        share = published_gradient_share(torch.tensor(eps2d**2, dtype=torch.float64))
        own = _scale_gradient(eps2d, torch.float32) / _scale_gradient(eps2d, torch.float64)
        rows.append((f"{eps2d:.3g}", f"{float(share):.3f}", f"{own:.6f}"))
    return rows


def _scale_gradient(eps2d: float, dtype: torch.dtype) -> float:
    camera = Camera(9, 9, 30.0, 30.0, 4.55, 4.47, torch.eye(4))
    scales = torch.full((1, 3), 1e-3, dtype=dtype, requires_grad=True)
    one = torch.tensor([[0.0, 0.0, 3.0]], dtype=dtype)
    splat = Gaussians(one, torch.tensor([[1.0, 0, 0, 0]], dtype=dtype), scales, torch.tensor([0.9], dtype=dtype), torch.ones(1, 1, 3, dtype=dtype))
    get_backend("reference").render(splat, camera, Effects(0, eps2d=eps2d)).alpha.sum().backward()
    return float(scales.grad.sum())


def compensation_slopes() -> list[Row]:
    floor, rows = LEAST_COMPENSATION["antialiased"], []
    for ratio in (1e-2, 1e-4, 1e-5, 1e-6, 1e-8):
        value = torch.tensor([ratio], dtype=torch.float64, requires_grad=True)
        own = torch.autograd.grad(_compensation(value).sum(), value)[0]
        step = ratio * 1e-4
        exact = (_compensation(value.detach() + step) - _compensation(value.detach() - step)) / (2 * step)
        rows.append((f"{ratio:g}", f"{float(exact):.4g}", f"{float(gsplat_compensation_slope(value.detach(), floor)):.4g}", f"{float(own):.4g}"))
    return rows


def _compensation(ratio: torch.Tensor) -> torch.Tensor:
    """sqrt(det / dilated det) of a splat for which this share is `ratio`, as our filter computes it."""
    one, zero, eps2d = torch.ones_like(ratio), torch.zeros_like(ratio), 0.3
    # xx = yy = v with det = d free: d + 2·eps·v + eps² is the dilated one; v is chosen so that the share is `ratio` at d = 1.
    variance = (1 / ratio.detach() - 1 - eps2d**2) / (2 * eps2d)
    det = ratio * (2 * eps2d * variance + eps2d**2) / (1 - ratio)
    flat = Projected(torch.zeros(1, 2).to(ratio), one, variance, zero, variance, det)
    return footprint(flat, one, "antialiased", eps2d).opacities


def deleted_light() -> list[Row]:
    rows = []
    for sigma in (1.0, 0.1, 0.05, 0.032, 0.03, 0.01, 0.001):
        det = torch.tensor([sigma**4])
        round_ = Projected(torch.zeros(1, 2), torch.ones(1), det.sqrt(), torch.zeros(1), det.sqrt(), det)
        own = footprint(round_, torch.ones(1), "mip", 0.1).opacities
        rows.append((f"{sigma:g}", f"{sigma**2 / (sigma**2 + 0.1):.5f}", f"{float(mip_compensation(det, 0.1)):.5f}", f"{float(own):.5f}"))
    return rows


def determinants(turns: int = 2000) -> list[Row]:
    """Needles of a hundredth of a pixel at random angles: det + dilation in float32 by both formulas."""
    angle = torch.rand(turns, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * math.pi
    rows = []
    for length in (10.0, 1e2, 1e3, 1e4, 1e5):
        axes = torch.stack([torch.stack([angle.cos(), -angle.sin()], -1), torch.stack([angle.sin(), angle.cos()], -1)], 1)
        factor = (axes * torch.tensor([length, 0.01], dtype=torch.float64)).float()
        factor = torch.cat([factor, torch.zeros(turns, 2, 1)], -1)
        exact = _dilated_det(factor.double())
        own = _dilated_det(factor)
        xx, xy, yy, _ = _from_factors(factor)
        usual = (xx + 0.3) * (yy + 0.3) - xy * xy
        off = [((det.double() - exact).abs() / exact) for det in (usual, own)]
        rows.append((f"{length:g}", f"{off[0].max():.1e}", f"{float((usual <= 0).double().mean()):.1%}", f"{off[1].max():.1e}", "0.0%"))
        assert (own > 0).all()
    return rows


def _dilated_det(factor: torch.Tensor) -> torch.Tensor:
    xx, _, yy, det = _from_factors(factor)
    return det + 0.3 * (xx + yy) + 0.3**2


def lost_by_cutting() -> list[Row]:
    """400 faint splats over a frame, zoomed out: the alpha that the cut at 1/255 removes, with the antialiased filter."""
    rows = []
    splats = crowd(400, degree=0)
    faint = Gaussians(splats.means, splats.quats, splats.scales / 8, splats.opacities / 4, splats.sh)
    for zoom in (1, 1 / 2, 1 / 4, 1 / 8):
        camera = view(64, 48).zoomed(zoom)
        coverage = []
        for settings in (RenderSettings(), RenderSettings(min_alpha=1e-6)):
            coverage.append(float(get_backend("reference").render(faint, camera, Effects(0, "antialiased", settings=settings)).alpha.mean()))
        rows.append((f"x1/{round(1 / zoom)}", f"{1 - coverage[0] / coverage[1]:.1%}"))
    return rows


def near_planes() -> list[Row]:
    rows = []
    for distance in (0.5, 0.25, 0.19, 0.1, 0.02):
        splats = crowd(48)
        close = Gaussians(splats.means * distance / 3, splats.quats, splats.scales * distance / 3, splats.opacities, splats.sh)
        alpha = [float(get_backend("reference").render(close, view(), Effects(1, near_plane=near)).alpha.mean()) for near in (0.2, 1e-3)]
        rows.append((f"{distance:g}", *(f"{value:.3f}" for value in alpha)))
    return rows


def quaternions() -> list[Row]:
    rows = []
    unit = torch.nn.functional.normalize(torch.tensor([[0.8, 0.1, -0.3, 0.5]], dtype=torch.float64))
    for norm in (0.0, 0.5, 0.9, 1.1, 2.0):
        volume = float(torch.linalg.det(unnormalized_axes(norm * unit)).abs())
        rows.append((f"{norm:g}", f"{volume:.3g}", "1"))
    return rows


FAULTS: dict[str, tuple[Row, Callable[[], list[Row]]]] = {
    "Gradients of shape under a small dilation": (("dilation, px²", "share left by 1/(det² + 1e-7)", "left here, float32"), vanishing_gradients),
    "The slope of the compensation below its floor": (("det share", "finite differences", "gsplat 1.6", "here"), compensation_slopes),
    "Light of small round splats under a filter that keeps it": (("σ, px", "exact", "Mip-Splatting", "here"), deleted_light),
    "Determinant of needles, float32": (
        ("length, px", "xx·yy - xy²: worst relative error", "of them ≤ 0", "here: worst", "of them ≤ 0"),
        determinants,
    ),
    "Light lost to the cut at 1/255": (("zoom", "lost, of what there is without the cut"), lost_by_cutting),
    "Mean alpha of a scene that comes close": (("distance, units", "near plane 0.2", "near plane 0.001"), near_planes),
    "Volume of a splat with a quaternion that is not of length 1": (("norm", "as the kernel of 3DGS sees it", "here"), quaternions),
}


def markdown(header: Row, rows: Iterable[Row]) -> str:
    lines = [header, tuple("---:" for _ in header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def plot(measured: dict[str, dict[float, dict[str, tuple[float, float]]]], path: Path) -> None:
    figure = figure_class()(figsize=(16, 7))
    axes = figure.subplots(2, len(measured), sharey="row")
    for column, (sweep, by_value) in enumerate(measured.items()):
        for row, what in enumerate(("image", "gradients")):
            axis = axes[row][column]
            for name, style in zip(SUBJECTS, ("o-", "s-", "x--"), strict=True):
                axis.plot(list(by_value), [max(1e-9, by[name][row]) for by in by_value.values()], style, label=name, markersize=4)
            axis.set(xscale="log", yscale="log", title=f"{what}: error in float32" if column == 0 else what, xlabel=sweep)
            axis.grid(alpha=0.3)
    axes[0][0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=80)


def main() -> None:
    torch.set_num_threads(1)
    parts, measured = [], {}
    for sweep, (build, values) in SWEEPS.items():
        measured[sweep] = {value: errors(build, value) for value in values}
        rows = [(f"{value:.4g}", *(f"{error:.0e}" for pair in by.values() for error in pair)) for value, by in measured[sweep].items()]
        header = (sweep, *(f"{name}, {what}" for name in SUBJECTS for what in ("image", "gradient")))
        parts.append(f"### Error over {sweep}\n\n{markdown(header, rows)}\n")
    for title, (header, rows_of) in FAULTS.items():
        parts.append(f"### {title}\n\n{markdown(header, rows_of())}\n")
    text = "\n".join(parts)
    print(text)
    (HERE / "results/numerics.md").write_text(text, encoding="utf-8")
    plot(measured, HERE.parent / "docs/numerics.png")


if __name__ == "__main__":
    main()
