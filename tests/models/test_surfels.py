"""2D Gaussian Splatting: flat splats met by rays, against the paper's homographies in float64; read, adapted and saved."""

import math
from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from oracle import color_one
from samples import camera, gaussians, leaves
from surfel_checkpoints import columns, folder
from torch_checkpoints import live_model

from mipmap_plugin.adaptation.start.surfel_form import visible_area, widened_for_slant
from mipmap_plugin.backends import choose_backend, survey
from mipmap_plugin.backends.base import Needs
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.errors import BackendUnavailable
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models import detect, load_model
from mipmap_plugin.models.live import adopt
from mipmap_plugin.models.surfels import FLAT, SurfelModel, flat_trained, flattened
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.render_settings import RenderSettings
from mipmap_plugin.splatting.projection import Projected
from mipmap_plugin.splatting.rotations import rotations
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

EFFECTS = Effects(1, "surfel", 0.5)


def flat(splats: Gaussians) -> Gaussians:
    return replace(splats, scales=splats.scales * splats.scales.new_tensor([1.0, 1.0, 0.0]))


def by_the_paper(splats, view, eps2d=0.5, near=0.2):
    """[H, W, 3] over black, one sum a pixel: rays as two planes in the surfel's plane (Huang et al. 2024, equations 4 to 11)."""
    g, to_view = splats.to(dtype=torch.float64), view.viewmat
    p = g.means @ to_view[:3, :3].T + to_view[:3, 3]
    ys, xs = torch.meshgrid(torch.arange(view.height) + 0.5, torch.arange(view.width) + 0.5, indexing="ij")
    xs, ys = xs.double(), ys.double()
    lens = torch.tensor([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]], dtype=torch.float64)
    image, through = torch.zeros(view.height, view.width, 3, dtype=torch.float64), torch.ones(view.height, view.width, dtype=torch.float64)
    done = torch.zeros_like(through, dtype=torch.bool)
    for i in p[:, 2].argsort(stable=True).tolist():
        turned = to_view[:3, :3] @ rotations(g.quats[i : i + 1])[0]
        h = lens @ torch.stack([turned[:, 0] * g.scales[i, 0], turned[:, 1] * g.scales[i, 1], p[i]], 1)
        dual = h @ torch.diag(torch.tensor([9.0, 9.0, -1.0], dtype=torch.float64)) @ h.T
        if p[i, 2] <= near or dual[2, 2] >= 0:
            continue
        center = dual[:2, 2] / dual[2, 2]
        first, second = xs[..., None] * h[2] - h[0], ys[..., None] * h[2] - h[1]
        line = torch.linalg.cross(first, second)
        u, v = line[..., 0] / line[..., 2], line[..., 1] / line[..., 2]
        depth = u * h[2, 0] + v * h[2, 1] + h[2, 2]
        screen = ((xs - center[0]) ** 2 + (ys - center[1]) ** 2) / eps2d
        alpha = (g.opacities[i] * torch.exp(-torch.minimum(u**2 + v**2, screen) / 2)).clamp_max(0.99)
        alpha = torch.where((alpha >= 1 / 255) & (depth >= near), alpha, 0.0)
        done = done | ((through * (1 - alpha) < 1e-4) & (alpha > 0))
        alpha = torch.where(done, 0.0, alpha)
        image += (through * alpha)[..., None] * color_one(g, i, view)
        through = through * (1 - alpha)
    return image


@pytest.mark.parametrize(("seed", "near"), [(0, 0.2), (1, 0.2), (2, 0.2), (0, 2.0)])
def test_the_image_is_that_of_the_papers_formula(seed, near):
    splats = flat(gaussians(60, seed=seed))
    image = ReferenceBackend().render(splats, camera(), replace(EFFECTS, near_plane=near)).image
    torch.testing.assert_close(image, by_the_paper(splats, camera(), near=near), atol=1e-9, rtol=0)
    assert image.amax() > 0.3


def test_perspective_bends_what_an_affine_projection_does_not():
    """A large surfel at a slant near the eye: its own Gaussian, and neither its affine shadow nor nothing."""
    quats = torch.tensor([[math.cos(0.6), 0.0, math.sin(0.6), 0.0]], dtype=torch.float64)
    mean, scales = quats.new_tensor([[0.0, 0.0, 2.0]]), quats.new_tensor([[0.45, 0.3, 0.0]])
    one = Gaussians(mean, quats, scales, quats.new_full((1,), 0.9), quats.new_ones(1, 1, 3))
    view = camera()
    image = ReferenceBackend().render(one, view, EFFECTS).image
    affine = ReferenceBackend().render(one, view, Effects(0, "classic", 0.0)).image
    torch.testing.assert_close(image, by_the_paper(one, view), atol=1e-9, rtol=0)
    assert (image - affine).abs().max() > 0.1


def test_what_is_smaller_than_a_pixel_is_still_a_dot():
    """The low-pass of equation 11: in float32 too, and of its own variance."""
    mean, quat, scales = (torch.tensor([row]) for row in ([0.0, 0.0, 3.0], [1.0, 0.0, 0.0, 0.0], [1e-6, 1e-6, 0.0]))
    dot = Gaussians(mean, quat, scales, torch.tensor([0.8]), torch.ones(1, 1, 3))
    view = camera(fx=45.0, fy=45.0)
    for width in (0.5, 2.0):
        alpha = ReferenceBackend().render(dot, view, Effects(0, "surfel", width)).alpha
        assert float(alpha.sum()) == pytest.approx(0.8 * 2 * math.pi * width, rel=0.05)


def test_gradients_equal_finite_differences():
    splats = flat(gaussians(12, seed=3))
    tensors, held = leaves(splats)
    weights = torch.rand(32, 40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def loss(g):
        return (ReferenceBackend().render(g, camera(), EFFECTS).image * weights).sum()

    grads = torch.autograd.grad(loss(held), tensors)
    generator = torch.Generator().manual_seed(1)
    for tensor, grad, size in zip(tensors, grads, (1e-7,) * 5, strict=True):
        way = torch.randn(tensor.shape, generator=generator, dtype=tensor.dtype)
        if tensor.shape == (12, 3) and tensor is tensors[2]:
            way[:, 2] = 0
        with torch.no_grad():
            tensor += size * way
            after = loss(held)
            tensor -= 2 * size * way
            before = loss(held)
            tensor += size * way
        assert float((after - before) / (2 * size)) == pytest.approx(float((grad * way).sum()), rel=2e-4, abs=1e-6)


def test_hard_cases_have_finite_images_and_gradients():
    """Edge-on, around the eye, of no size, of all sizes, in float32."""
    rows = [
        ((0, 0, 3), (0.7071068, 0, 0.7071068, 0), (0.3, 0.3)),  # edge-on
        ((0, 0, 0.21), (0.9, 0.3, 0.1, 0.2), (5.0, 5.0)),  # reaches behind the eye
        ((0.1, 0, 2), (1, 0, 0, 0), (1e-18, 1e-18)),
        ((0, 0.1, 2), (0, 0, 0, 0), (1e-30, 0.2)),
        ((0, 0, 4), (1, 0.2, 0, 0), (1e4, 1e-9)),
        ((0, 0, -1), (1, 0, 0, 0), (0.3, 0.3)),
        ((0, 0, 5e5), (1, 0, 0, 0), (1e5, 1e5)),
    ]
    means, quats, scales = (torch.tensor([row[i] for row in rows], dtype=torch.float32) for i in range(3))
    scales = torch.cat([scales, torch.zeros(len(rows), 1)], 1)
    tensors, held = leaves(Gaussians(means, quats, scales, torch.full((len(rows),), 0.7), torch.ones(len(rows), 4, 3)))
    rendered = ReferenceBackend().render(held, camera(), EFFECTS)
    grads = torch.autograd.grad(rendered.image.sum(), tensors)
    assert rendered.image.isfinite().all() and all(grad.isfinite().all() for grad in grads)
    assert rendered.alpha.max() > 0.5


def test_a_tile_changes_nothing_but_the_time():
    splats = flat(gaussians(40, seed=5))
    images = [ReferenceBackend().render(splats, camera(), replace(EFFECTS, settings=RenderSettings(tile=tile))).image for tile in (4, 16, 64)]
    torch.testing.assert_close(images[0], images[1], atol=1e-12, rtol=0)
    torch.testing.assert_close(images[2], images[1], atol=1e-12, rtol=0)


def test_only_the_reference_serves_it():
    needs = Needs("cpu", torch.float32, gradients=True, sh_degree=1, screen_filter="surfel")
    assert [name for name, reasons in survey(needs).items() if not reasons] == ["reference"]
    with pytest.raises(BackendUnavailable, match="not surfel"):
        choose_backend("cpu", needs)


@pytest.mark.parametrize("axes", [(3.0, 2.0), (0.2, 0.1), (3.0, 0.1), (0.8, 0.7), (50.0, 0.01)])
def test_the_area_is_that_of_the_larger_of_both(axes):
    a, b = axes
    sides = [torch.linspace(-6, 6, 1001, dtype=torch.float64) * max(axis, 0.5**0.5) for axis in axes]
    x, y = torch.meshgrid(*sides, indexing="ij")
    cell = float((sides[0][1] - sides[0][0]) * (sides[1][1] - sides[1][0]))
    squared = torch.minimum(x**2 / a**2 + y**2 / b**2, (x**2 + y**2) / 0.5)
    turn = torch.tensor([[0.8, -0.6], [0.6, 0.8]], dtype=torch.float64)
    spread = turn @ torch.diag(torch.tensor([a * a, b * b], dtype=torch.float64)) @ turn.T
    entries = (spread[i, j].reshape(1) for i, j in ((0, 0), (0, 1), (1, 1)))
    shown = Projected(torch.zeros(1, 2), torch.ones(1), *entries, torch.tensor([a * a * b * b]))
    assert float(2 * math.pi * visible_area(shown, 0.5)) == pytest.approx(float(torch.exp(-squared / 2).sum()) * cell, rel=1e-3)


def test_a_surfel_grows_for_slant_along_what_the_filter_widened_and_to_at_most_twice_its_area():
    own, wide = torch.tensor([[1.0, 0.1, 0.0], [0.1, 0.1, 0.0], [1.0, 1.0, 0.0]]), torch.tensor([[1.0, 0.5, 0.0], [0.5, 0.5, 0.0], [1.0, 1.0, 0.0]])
    grown = widened_for_slant(own, wide, torch.tensor([1.5, 9.0, 9.0]))
    torch.testing.assert_close(grown, torch.tensor([[1.0, 0.75, 0.0], [0.5 * 2**0.5, 0.5 * 2**0.5, 0.0], [1.0, 1.0, 0.0]]))


def test_a_checkpoint_is_read_as_it_is(tmp_path):
    model = load_model(folder(tmp_path / "model"))
    held = columns()
    assert (model.family, model.trained.screen_filter, model.trained.eps2d, model.trained.keeps_filter) == ("2dgs", "surfel", 0.5, True)
    splats = model.gaussians()
    np.testing.assert_allclose(splats.scales[:, 0], np.exp(held["scale_0"]), rtol=1e-6)
    np.testing.assert_allclose(splats.scales[:, 1], np.exp(held["scale_1"]), rtol=1e-6)
    assert (splats.scales[:, 2] == 0).all()
    assert any("flat" in note for note in model.notes)
    tagged = load_model(model.save(tmp_path / "tagged.ply", provenance={}))
    assert tagged.trained.eps2d == 0.5 and not any("0.3 px²" in note for note in tagged.notes)  # the dilation of others


def test_rendered_by_its_own_convention(tmp_path):
    wrapped = wrap_model(folder(tmp_path / "model"))
    view = wrapped.cameras[0]
    torch.testing.assert_close(wrapped.render(view).image.double(), by_the_paper(wrapped.model.gaussians(), view), atol=2e-5, rtol=0)


def test_saved_without_change(tmp_path):
    model = load_model(folder(tmp_path / "model"))
    saved = model.save(tmp_path / "copy", provenance={})
    before, after = (read_ply(path).columns for path in (model.source, saved))
    assert list(before) == list(after)
    assert all(np.array_equal(before[name], after[name]) for name in before)
    assert "render_items" in (tmp_path / "copy" / "cfg_args").read_text()
    assert detect(saved).family == "2dgs"


@pytest.mark.parametrize("scale", [1 / 2, 2.0])
def test_adapts_end_to_end(tmp_path, scale):
    """Nearer to the truth than the base is, flat, and in the columns of its project."""
    wrapped = wrap_model(folder(tmp_path / "model"))
    adapted = wrapped.adapt(scale, steps=6, extra_views=2)
    saved = adapted.save(tmp_path / "adapted")
    assert "scale_2" not in read_ply(saved).columns and "scale_1" in read_ply(saved).columns
    view = wrapped.cameras[0].zoomed(scale)
    if scale < 1:
        truth = wrapped.render(view, scale, "scaled", supersampling=2).image
        errors = [(image - truth).square().mean() for image in (adapted.render(view).image, wrapped.render(view).image)]
        assert errors[0] < 0.5 * errors[1]


def test_the_closed_form_alone_keeps_what_the_base_showed():
    """Zoom-in: dots of the base stay as large on the object as they were."""
    splats = replace(tiny.gaussians(30), scales=torch.full((30, 3), 1e-4))
    model = SurfelModel(VanillaModel.from_gaussians(splats).parameters(), flat_trained(tiny.model().trained))
    wrapped = wrap_model(model, cameras=tiny.cameras())
    adapted = wrapped.adapt(4.0, recipe="instant")
    view = wrapped.cameras[0]
    shown, base = adapted.render(view.zoomed(4)).alpha.mean(), wrapped.render(view).alpha.mean()
    assert float(shown) == pytest.approx(float(base), rel=0.3)
    assert float(wrapped.render(view.zoomed(4)).alpha.mean()) < 0.3 * float(base)


def test_merged_splats_are_flat_again():
    rng = torch.Generator().manual_seed(0)
    quats = torch.nn.functional.normalize(torch.randn(20, 4, generator=rng), dim=1)
    scales = torch.rand(20, 3, generator=rng) + 0.1
    turned = flattened(Gaussians(torch.zeros(20, 3), quats, scales, torch.ones(20) / 2, torch.zeros(20, 1, 3)))
    spread = lambda q, s: (rotations(q) * s[:, None].square()) @ rotations(q).mT  # noqa: E731
    thin = scales.argsort(1, descending=True)
    kept = scales * (scales != scales.gather(1, thin[:, 2:]))
    torch.testing.assert_close(spread(turned.quats, turned.scales), spread(quats, kept), atol=1e-5, rtol=0)
    assert (turned.scales[:, 2] == 0).all()
    assert flattened(turned) is turned


def test_merging_returns_fewer_splats_that_are_flat(tmp_path):
    adapted = wrap_model(folder(tmp_path / "model")).adapt(1 / 8, recipe="instant", merge_to=0.3, merging_costs=99)
    assert len(adapted.model) < 50
    assert "scale_2" not in read_ply(adapted.save(tmp_path / "a.ply")).columns


def test_a_live_object_is_recognized_by_its_two_scales():
    raw = tiny.model().parameters()
    live = live_model(raw | {"scales": raw["scales"][:, :2].clone()})
    model = adopt(live)
    assert isinstance(model, SurfelModel) and model.trained.screen_filter == "surfel"
    assert torch.equal(model.parameters()["scales"][:, :2], live._scaling)
    assert (model.parameters()["scales"][:, 2] == FLAT).all()
