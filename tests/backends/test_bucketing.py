"""The compiled order by buckets of depth is that of torch, splat by splat."""

import pytest
import torch

pytest.importorskip("numba", reason="the compiled kernels need numba")

from mipmap_plugin.backends.cpu_kernels import bucketing
from mipmap_plugin.camera import Camera
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.buckets import ranks

EYE = torch.eye(4)
TURNED = torch.tensor([[0.6, 0.0, -0.8, 0.3], [0.0, 1.0, 0.0, -0.2], [0.8, 0.0, 0.6, 5.0], [0.0, 0.0, 0.0, 1.0]])


def scene(count: int, extent: float) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(count)
    return extent * torch.randn(count, 3, generator=generator), torch.rand(count, 3, generator=generator)


def assert_same(means: torch.Tensor, scales: torch.Tensor, pose: torch.Tensor) -> None:
    camera, count = Camera(8, 8, 9.0, 9.0, 4.0, 4.0, pose), len(means)
    splats = Gaussians(means, torch.ones(count, 4), scales, torch.ones(count), torch.zeros(count, 1, 3))
    assert torch.equal(torch.from_numpy(bucketing.ranks(means.numpy(), scales.numpy(), camera)), ranks(splats, [camera])[0])


@pytest.mark.parametrize("pose", [EYE, TURNED], ids=["eye", "turned"])
@pytest.mark.parametrize(("count", "extent"), [(0, 1.0), (1, 1.0), (2, 3.0), (5_000, 1e-3), (5_000, 50.0), (70_000, 4.0)])
def test_scenes_of_all_sizes(count, extent, pose):
    assert_same(*scene(count, extent), pose)


def test_splats_in_one_place_keep_their_order():
    means, scales = torch.full((100, 3), 2.5), torch.zeros(100, 3)
    assert_same(means, scales, EYE)
    camera = Camera(8, 8, 9.0, 9.0, 4.0, 4.0, EYE)
    assert bucketing.ranks(means.numpy(), scales.numpy(), camera).tolist() == list(range(100))


def test_numbers_that_are_not_finite_count_as_0():
    means, scales = scene(300, 2.0)
    means[7], means[8, 1], scales[9, 2], scales[10] = torch.nan, torch.inf, -torch.inf, torch.nan
    assert_same(means, scales, TURNED)
