"""Where a capture without cameras is looked at from: so near that its splats are about as large as pixels, but not from within it."""

from dataclasses import replace

import pytest
import tiny
import torch

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.views.viewpoints import orbit_of
from mipmap_plugin.scenes.orbits import MIDDLE, NEARER, SHARP_FOCAL, SHARP_PX, Orbit, frame, sharp_size

COUNT = 400


def capture(count: int = COUNT) -> torch.Tensor:
    """Places of splats [N, 3]: a table that is 20 wide, and a tenth of them 60 times as far away."""
    means = 20 * torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 10
    means[: count // 10] *= 60
    return means


def seen_from(far: float) -> Orbit:
    """Around a capture whose sharp splats are as large as pixels should be from so far away."""
    return Orbit.around(capture(), sharp=lambda: far * SHARP_PX / SHARP_FOCAL)


def test_it_is_seen_from_where_sharp_splats_have_the_size_of_pixels_and_from_nearer():
    assert not frame(capture())[2]
    orbit = seen_from(30.0)
    assert (orbit.distance, orbit.nearest) == (pytest.approx(30), pytest.approx(NEARER * 30))
    views = orbit.views((8, 8), 40, torch.Generator().manual_seed(0))
    far = torch.stack([view.center - torch.tensor(orbit.center, dtype=view.center.dtype) for view in views]).norm(dim=1)
    assert 16 <= int(torch.isclose(far, far.new_tensor(orbit.distance)).sum()) <= 24
    assert int((torch.isclose(far, far.new_tensor(orbit.distance)) | torch.isclose(far, far.new_tensor(orbit.nearest))).sum()) == 40


@pytest.mark.parametrize("up", [None, (0.0, 0.0, 1.0)], ids=["not known", "said"])
def test_near_and_far_views_are_on_all_sides(up):
    orbit = replace(seen_from(30.0), up=up, said=up is not None)
    views = orbit.views((8, 8), 80, torch.Generator().manual_seed(0))
    ways = torch.stack([view.center.double() for view in views]) - torch.tensor(orbit.center, dtype=torch.float64)
    far, level = ways.norm(dim=1) > 20, ways[:, :2] if up else ways[:, [0, 2]]
    level = level / level.norm(dim=1, keepdim=True)
    assert all(float(level[chosen].mean(0).norm()) < 0.2 for chosen in (far, ~far))  # 0.6 where they are on one half of the turn
    assert all(0.3 < float(far[half::2].double().mean()) < 0.7 for half in (0, 1))  # of both halves of the checks


def test_from_farther_than_where_the_most_of_it_is_framed_it_is_not_seen():
    framed = Orbit.around(capture()).distance
    assert seen_from(1e9) == replace(seen_from(1e9), distance=framed, nearest=framed)


def test_it_is_not_seen_from_within_its_middle():
    orbit = seen_from(1e-3)
    distances = (capture() - torch.tensor(orbit.center)).norm(dim=1)
    assert orbit.distance == orbit.nearest == pytest.approx(float(distances.quantile(MIDDLE)), rel=0.05)


def test_an_object_is_framed_whatever_its_splats():
    means = capture()[COUNT // 10 :]
    assert Orbit.around(means, sharp=lambda: 1e-6) == Orbit.around(means) and Orbit.around(means).nearest == 0


def test_sharp_splats_are_those_that_can_be_seen():
    splats = tiny.gaussians(8)
    scales = torch.tensor([[0.0, 1.0, 4.0]] * 4 + [[9.0, 9.0, 9.0]] * 4, dtype=splats.scales.dtype)
    opacities = torch.tensor([0.5, 0.5, 0.5, 0.5, 0.01, 0.01, float("nan"), 0.0], dtype=splats.opacities.dtype)
    assert sharp_size(replace(splats, scales=scales, opacities=opacities)) == pytest.approx(2)
    assert sharp_size(replace(splats, opacities=0 * opacities.nan_to_num())) == float("inf")


def test_sharp_splats_are_those_of_the_inner_half():
    splats = tiny.gaussians(9)
    far = torch.tensor([0.0, 0.1, -0.1, 0.2, -0.2, 5.0, -5.0, 6.0, -6.0], dtype=splats.means.dtype)
    means = far[:, None] * torch.ones(3, dtype=far.dtype)
    sizes = torch.tensor([1.0, 1.0, 2.0, 3.0, 3.0, 9.0, 9.0, 9.0, 9.0], dtype=far.dtype)[:, None].expand(9, 3)
    assert sharp_size(replace(splats, means=means, scales=sizes, opacities=torch.ones_like(far))) in (1, 2)


def test_what_is_adapted_is_seen_from_the_same_places(tmp_path):
    model = tiny.model(COUNT)
    with torch.no_grad():
        model.parameters()["means"].copy_(capture())
        model.parameters()["scales"].fill_(-2.7)
    file = wrap_model(model).adapt(1 / 4, recipe="instant", extra_views=4).save(tmp_path / "adapted.ply")
    base, adapted = orbit_of(model, model.trained), orbit_of(wrap_model(file).model, model.trained)
    assert 0 < base.nearest < base.distance and adapted == base
