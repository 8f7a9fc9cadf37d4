"""Published results, to compare with a user's rows: means over a data set, each with its protocol and source."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

DataSet = Literal["nerf-synthetic", "mip-nerf-360"]

# A zoom is relative to the size that the papers trained at, which is not that of every user's base.
TITLE = {
    "nerf-synthetic": "mean over the 8 scenes of NeRF-Synthetic, trained at 800 px for zoom-out and at 100 px for zoom-in",
    "mip-nerf-360": "mean over the 9 scenes of mip-NeRF 360, trained at full size for zoom-out and at an eighth of it for zoom-in",
}

# LPIPS in these papers: VGG with images in 0..1. Where a table copies rows of another, the protocol is that of the original.
LPIPS_LABEL = "LPIPS (vgg, 0..1)"

MIPMAP = "Mipmap-GS (arXiv 2408.06286)"
FROM_MIP = "Mip-Splatting, as copied by Mipmap-GS"
BLENDING = "Gaussian Blending (AAAI 2026), second-hand"
AA2DGS = "AA-2DGS, second-hand"
OURS_ON_SCORED = "Mipmap-GS, adapted on the scored views"


@dataclass(frozen=True)
class Published:
    """One method at one scale."""

    dataset: DataSet
    scale: float
    method: str
    protocol: str
    source: str
    psnr_db: float
    ssim: float | None = None
    lpips: float | None = None


# (method, protocol, source, then (PSNR, SSIM, LPIPS) for each scale; None: not published)
_Line = tuple[str, str, str, tuple[tuple[float | None, ...], ...]]

_SYNTHETIC_OUT: tuple[_Line, ...] = (
    ("3DGS", "P3", MIPMAP, ((27.14, 0.951, 0.031), (21.39, 0.875, 0.067), (17.59, 0.763, 0.127))),
    ("3DGS", "P1", BLENDING, ((27.04,), (21.43,), (17.74,))),
    ("3DGS + EWA", "P1", FROM_MIP, ((31.66, 0.971, 0.024), (27.82, 0.959, 0.033), (24.62, 0.940, 0.047))),
    ("Mip-Splatting", "P1", FROM_MIP, ((34.00, 0.977, 0.019), (31.85, 0.978, 0.019), (28.67, 0.973, 0.026))),
    ("Analytic-Splatting", "P1", MIPMAP, ((34.21, 0.977, 0.019), (31.49, 0.977, 0.021), (28.42, 0.969, 0.031))),
    ("Analytic-Splatting", "P1", BLENDING, ((34.20,), (31.16,), (27.22,))),
    ("AA-2DGS", "P1", AA2DGS, ((34.10,), (32.11,), (29.00,))),
    (f"Scaffold-GS + {OURS_ON_SCORED}", "P3", MIPMAP, ((32.71, 0.971, 0.026), (32.46, 0.975, 0.023), (30.81, 0.976, 0.028))),
    (OURS_ON_SCORED, "P3", MIPMAP, ((34.18, 0.977, 0.019), (32.51, 0.978, 0.021), (30.64, 0.976, 0.026))),
    ("Gaussian Blending, trained with it", "P1", BLENDING, ((35.80,), (36.82,), (35.79,))),
    ("Gaussian Blending, at test time only", "P1", BLENDING, ((35.72,), (37.36,), (36.51,))),
)
_SYNTHETIC_IN: tuple[_Line, ...] = (
    ("3DGS", "P3", MIPMAP, ((23.38, 0.907, 0.068), (19.93, 0.832, 0.128), (18.52, 0.824, 0.153))),
    ("Mip-Splatting", "P3", MIPMAP, ((30.08, 0.960, 0.051), (27.12, 0.917, 0.105), (25.71, 0.886, 0.136))),
    (f"Scaffold-GS + {OURS_ON_SCORED}", "P3", MIPMAP, ((30.79, 0.968, 0.043), (28.20, 0.936, 0.078), (26.59, 0.911, 0.153))),
    (OURS_ON_SCORED, "P3", MIPMAP, ((31.23, 0.964, 0.041), (28.29, 0.927, 0.081), (26.43, 0.897, 0.119))),
)
_360_OUT: tuple[_Line, ...] = (
    ("3DGS", "P3", MIPMAP, ((26.66, 0.774, 0.291), (22.87, 0.721, 0.241), (25.36, 0.763, 0.250))),
    ("Octree-GS", "P3", MIPMAP, ((27.13, 0.793, 0.261), (26.44, 0.805, 0.199), (23.92, 0.784, 0.182))),
    ("Mip-Splatting", "P3", MIPMAP, ((27.44, 0.812, 0.233), (27.16, 0.799, 0.209), (27.03, 0.744, 0.326))),
    ("Analytic-Splatting", "P3", MIPMAP, ((25.70, 0.713, 0.350), (27.04, 0.791, 0.216), (29.44, 0.880, 0.106))),
    ("GOF", "P3", MIPMAP, ((27.17, 0.803, 0.251), (27.61, 0.825, 0.185), (27.21, 0.838, 0.155))),
    (OURS_ON_SCORED, "P3", MIPMAP, ((28.57, 0.854, 0.156), (28.34, 0.828, 0.199), (28.57, 0.854, 0.154))),
)
_360_IN: tuple[_Line, ...] = (
    ("3DGS", "P3", MIPMAP, ((23.49, 0.740, 0.243), (20.69, 0.619, 0.394), (19.21, 0.603, 0.477))),
    ("3DGS + EWA", "P3", FROM_MIP, ((25.90, 0.775, 0.236), (23.70, 0.667, 0.369), (22.81, 0.643, 0.449))),
    ("Mip-Splatting", "P3", FROM_MIP, ((27.39, 0.808, 0.205), (26.47, 0.754, 0.305), (26.22, 0.765, 0.392))),
    ("GOF", "P3", MIPMAP, ((27.05, 0.802, 0.206), (26.17, 0.744, 0.313), (25.90, 0.758, 0.411))),
    ("AA-2DGS", "P3", AA2DGS, ((27.16,), (26.10,), (25.77,))),
    (OURS_ON_SCORED, "P3", MIPMAP, ((27.17, 0.799, 0.209), (26.22, 0.744, 0.302), (25.91, 0.761, 0.399))),
)

_OUT, _IN = (1 / 2, 1 / 4, 1 / 8), (2, 4, 8)


def _read(dataset: DataSet, scales: tuple[float, ...], lines: tuple[_Line, ...]) -> list[Published]:
    return [
        Published(dataset, scale, method, protocol, source, *values)  # type: ignore[arg-type]
        for method, protocol, source, triples in lines
        for scale, values in zip(scales, triples, strict=True)
    ]


PUBLISHED = (
    *_read("nerf-synthetic", _OUT, _SYNTHETIC_OUT),
    *_read("nerf-synthetic", _IN, _SYNTHETIC_IN),
    *_read("mip-nerf-360", _OUT, _360_OUT),
    *_read("mip-nerf-360", _IN, _360_IN),
)


def published(dataset: DataSet, scales: list[float]) -> list[Published]:
    """The published rows of a data set at the given scales, in their order."""
    return [row for scale in scales for row in PUBLISHED if row.dataset == dataset and row.scale == scale]
