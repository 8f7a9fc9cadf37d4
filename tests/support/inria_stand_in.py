"""A stand-in for `diff_gaussian_rasterization` on the CPU: its names, and images that the reference renders from its arguments."""

from collections import namedtuple
from types import SimpleNamespace

import torch

from mipmap_plugin.backends.inria import NEWER, OLDER
from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.render_settings import MIN_ALPHA, USUAL
from mipmap_plugin.splatting.compositing import SortedSplats, composite, independent
from mipmap_plugin.splatting.filters import Footprint
from mipmap_plugin.splatting.harmonics import colors as colors_of
from mipmap_plugin.splatting.projection import project

DILATION, NEAR, LEAST_COMPENSATION = 0.3, 0.2, 0.005


def package(newer: bool) -> SimpleNamespace:
    """The module, of the generation with or without `antialiasing`. The arguments are kept in `received`."""
    received: list[tuple] = []

    class GaussianRasterizer:
        def __init__(self, raster_settings):
            self.settings = raster_settings

        def __call__(self, means3D, means2D, opacities, shs=None, colors_precomp=None, scales=None, rotations=None, cov3D_precomp=None):
            assert (shs is None) != (colors_precomp is None)
            assert (cov3D_precomp is None) != (scales is None or rotations is None)
            received.append((self.settings, shs, cov3D_precomp))
            splats = splats_of(means3D, opacities, scales, rotations, cov3D_precomp)
            image = draw(splats, shs, colors_precomp, self.settings)
            radii = torch.zeros(len(means3D), dtype=torch.int32)
            return (image, radii, image[:1]) if newer else (image, radii)

    settings = namedtuple("GaussianRasterizationSettings", NEWER if newer else OLDER)
    return SimpleNamespace(GaussianRasterizationSettings=settings, GaussianRasterizer=GaussianRasterizer, received=received)


def camera_of(settings) -> Camera:
    viewmat = settings.viewmatrix.T.double()
    projection = settings.projmatrix.T.double() @ torch.linalg.inv(viewmat)
    width, height = settings.image_width, settings.image_height
    fx, fy = width / settings.tanfovx / 2, height / settings.tanfovy / 2
    assert torch.allclose(projection[:2, :2], torch.diag(torch.tensor([2 * fx / width, 2 * fy / height])).double(), atol=1e-5)
    assert torch.allclose(projection[3], torch.tensor([0.0, 0.0, 1.0, 0.0]).double(), atol=1e-6)
    center = [(float(projection[axis, 2]) + 1) / 2 * size for axis, size in enumerate((width, height))]
    camera = Camera(width, height, fx, fy, *center, viewmat)
    assert torch.allclose(settings.campos.double(), camera.center, atol=1e-6)
    return camera


def splats_of(means, opacities, scales, rotations, packed) -> Gaussians:
    n = len(means)
    covariances = None
    if packed is None:
        assert torch.allclose(rotations.norm(dim=1), torch.ones(n), atol=1e-6)  # it does not normalize them
    else:
        covariances = packed[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].unflatten(1, (3, 3))
        scales, rotations = means.new_ones(n, 3), means.new_ones(n, 4)
    return Gaussians(means, rotations, scales, opacities[:, 0], means.new_zeros(n, 1, 3), covariances)


def draw(splats: Gaussians, shs, colors_precomp, settings):
    camera = camera_of(settings)
    p = project(splats, camera, NEAR)
    xx, yy = p.xx + DILATION, p.yy + DILATION
    det = xx * yy - p.xy.square()
    compensation = (p.det / det).clamp_min(LEAST_COMPENSATION**2).sqrt() if getattr(settings, "antialiasing", False) else 1.0
    footprints = Footprint(yy, p.xy / yy, det / yy, xx, splats.opacities * compensation)
    rgb = colors_precomp if shs is None else colors_of(shs, splats.means, settings.campos, settings.sh_degree)
    least = torch.full_like(splats.opacities, MIN_ALPHA)
    rows = (footprints.visible(least) & (p.depths > NEAR)).nonzero()[:, 0]
    rows = rows[p.depths[rows].argsort(stable=True)]
    chosen = SortedSplats(p.means2d[rows], footprints.packed()[rows], rgb[rows], least[rows], independent(footprints.alpha, USUAL.max_alpha, False))
    color, _ = composite(chosen, footprints.extents(least)[rows], camera, USUAL, settings.bg)
    return color.permute(2, 0, 1)
