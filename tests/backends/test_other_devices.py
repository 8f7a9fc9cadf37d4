"""Models, adapting and saving on another device than the processor, which is pretended: nothing mixes the two, and results are the same."""

from dataclasses import replace
from types import SimpleNamespace

import anchor_checkpoints
import mip_checkpoints
import moving
import pretended
import pytest
import surfel_checkpoints
import tiny
import torch
import torch_checkpoints

from mipmap_plugin import load_model, load_scene, wrap_model
from mipmap_plugin.adaptation.optimization import run
from mipmap_plugin.adaptation.optimization.losses import compare
from mipmap_plugin.adaptation.optimization.validation import Validation
from mipmap_plugin.adaptation.start import merging
from mipmap_plugin.adaptation.start.blend_weights import may_show
from mipmap_plugin.adaptation.start.closed_form import closed_form
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.adaptation.target.upsamplers import register_upsampler
from mipmap_plugin.adaptation.views.pixel_size import mean_pixel_size
from mipmap_plugin.adaptation.views.remarks import remarks
from mipmap_plugin.adaptation.views.shown import showing
from mipmap_plugin.backends import gsplat, inria
from mipmap_plugin.backends.base import Rendered
from mipmap_plugin.backends.cpu import nearest_along
from mipmap_plugin.backends.guarded import Guarded
from mipmap_plugin.cli import main
from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.effects import SURFEL, Effects
from mipmap_plugin.evaluation.evaluate import all_rows, evaluator_of
from mipmap_plugin.formats.images import write_image
from mipmap_plugin.screen_filters import USUAL_EPS2D
from mipmap_plugin.splatting.projection import covariances_of

# Few views and small ones: each operation there is many times as slow.
VIEWS = tiny.cameras(2, width=16, height=12)
FEW = dict(extra_views=0, views_per_step=1, validation_views=2, merge_to=1.0)

# Older torch takes more operations apart there than the products of networks.
EXACT = tuple(map(int, torch.__version__.split(".")[:2])) >= (2, 10)


@pytest.fixture(autouse=True)
def plain_adam(monkeypatch):
    """Torch fuses Adam on devices that it knows to be real."""

    def update(tensors, grads, first, second, _, steps, *, lr, beta1, beta2, eps, **_others):
        for tensor, grad, mean, square, step in zip(tensors, grads, first, second, steps, strict=True):
            mean.lerp_(grad, 1 - beta1)
            square.mul_(beta2).addcmul_(grad, grad, value=1 - beta2)
            root = square.sqrt() / (1 - beta2**step).sqrt() + eps
            tensor.sub_(lr / (1 - beta1**step) * mean / root)

    monkeypatch.setattr(torch, "_fused_adam_", update)


FAMILIES = {
    "3dgs": lambda path: tiny.folder(path, tiny.cameras()),
    "2dgs": surfel_checkpoints.folder,
    "mip": lambda path: mip_checkpoints.folder(path, "mip"),
    "scaffold": lambda path: anchor_checkpoints.write(path),
    "octree": lambda path: anchor_checkpoints.write(path, anchor_checkpoints.Layout("octree", level=True)),
    "deformable": moving.write_deformable,
    "hexplane": moving.write_hexplane,
    "gsplat": lambda path: torch_checkpoints.gsplat_folder(path, torch_checkpoints.splats()),
}


@pytest.mark.parametrize(("family", "scale"), [*((family, 1 / 2) for family in FAMILIES), ("3dgs", 2), ("2dgs", 2)])
def test_each_family_adapts_and_is_saved_there(family, scale, tmp_path, monkeypatch):
    for compiled in ("start.closed_form.summed_areas", "views.pixel_size.finest_pixels"):  # which are a little more exact
        monkeypatch.setattr(f"mipmap_plugin.adaptation.{compiled}", lambda *_: None)
    model = load_model(FAMILIES[family](tmp_path / "base"))
    settings = dict(FEW, steps=2 if family == "3dgs" else 1, prune_every=1, check_every=1)
    settings["merge_to"] = 0.5 if (family, scale) == ("3dgs", 1 / 2) else 1.0
    here = wrap_model(model, cameras=VIEWS, backend="reference").adapt(scale, **settings)
    with pretended.pretending():
        there = wrap_model(model.to(pretended.DEVICE), cameras=VIEWS, backend="reference").adapt(scale, **settings)
        there.save(tmp_path / "there")
        write_image(tmp_path / "there.png", there.render(VIEWS[0]).image)
        parameters = {name: tensor.cpu() for name, tensor in there.model.parameters().items()}
    assert [point.psnr_db for point in there.report.curve] == pytest.approx([point.psnr_db for point in here.report.curve], abs=1e-3)
    if family == "3dgs" and EXACT:  # networks' products of matrices are taken apart in another way there
        assert all(torch.equal(tensor, parameters[name]) for name, tensor in here.model.parameters().items())


def test_anchors_are_left_out_there(monkeypatch, tmp_path):
    monkeypatch.setattr("mipmap_plugin.adaptation.start.thinning.PER_PIXEL", 0.0)
    model = load_model(FAMILIES["scaffold"](tmp_path / "base"))
    thinned = FEW | dict(recipe="instant", merge_to=0.5, merging_costs=99)
    here = wrap_model(model, cameras=VIEWS, backend="reference").adapt(1 / 4, **thinned)
    with pretended.pretending():
        there = wrap_model(model.to(pretended.DEVICE), cameras=VIEWS, backend="reference").adapt(1 / 4, **thinned)
    assert "a part of the base" in "".join(there.report.validation) and there.report.validation == pytest.approx(here.report.validation, abs=1e-3)


@pytest.mark.parametrize("enough", [True, False])
def test_harmful_growth_is_undone_there(enough, monkeypatch):
    register_upsampler("mine", lambda image, size: resize(image, size, "lanczos"), replace=True)
    agreements = iter([0.0, *[0.0 if enough else -1.0] * 9])
    monkeypatch.setattr(run, "decibel", lambda _: next(agreements))
    grown = dict(recipe="thorough", upsampler="mine", steps=3, prune_every=2, densify_gradient=1e-12, min_opacity=0.0, returns="last", **FEW)
    with pretended.pretending():
        model = wrap_model(tiny.model().to(pretended.DEVICE), cameras=VIEWS, backend="reference")
        there = model.adapt(2, **grown)
    assert (there.report.gaussians_after > len(tiny.model())) == enough


@pytest.mark.parametrize("method", ["box", "area", "bilinear", "pil-bicubic", "lanczos"])
def test_images_are_resampled_there(method):
    image, weights = torch.rand(24, 32, 3), torch.rand(6, 8, 3)
    results = []
    with pretended.pretending():
        for device in ("cpu", pretended.DEVICE):
            there = image.to(device).requires_grad_()
            small = resize(there, (6, 8), method)
            (gradient,) = torch.autograd.grad(small, there, weights.to(device))
            results.append((small.detach().cpu(), gradient.cpu()))
    assert all(torch.equal(*pair) for pair in zip(*results, strict=True))


@pytest.mark.parametrize("screen_filter", USUAL_EPS2D)
def test_the_reference_draws_there(screen_filter):
    views, model = tiny.cameras(), tiny.model()
    with pretended.pretending():
        image = wrap_model(model.to(pretended.DEVICE), cameras=views, backend="reference").render(views[0], 1 / 2, screen_filter, 2).image.cpu()
    assert torch.equal(image, wrap_model(model, cameras=views, backend="reference").render(views[0], 1 / 2, screen_filter, 2).image)


def test_cloning_and_splitting_there():
    settings = dict(FEW, recipe="paper", steps=4, prune_every=2, densify_gradient=1e-9)
    with pretended.pretending():
        adapted = wrap_model(tiny.model().to(pretended.DEVICE), cameras=VIEWS, backend="reference").adapt(1 / 2, **settings)
    assert adapted.report.gaussians_after > adapted.report.gaussians_before


def test_photographs_and_evaluation_there(tmp_path, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.evaluation.evaluate.FILTERS", ("scaled", "antialiased"))  # the other takes most of the time
    scene = load_scene(tiny.scene(tmp_path / "scene", test=VIEWS[:1], train=VIEWS))
    with pretended.pretending():
        wrapped = wrap_model(tiny.model().to(pretended.DEVICE), cameras=VIEWS, backend="reference")
        wrapped.adapt(2, steps=1, images=scene, **FEW)
        rows = all_rows(wrapped, evaluator_of(wrapped, scene, "P3"), (1 / 2,), ("paper",), steps=1, **FEW)
    assert all(row.psnr_db > 10 for row in rows)


@pytest.mark.parametrize("with_covariances", [False, True])
def test_arguments_of_other_rasterizers_are_on_the_device(with_covariances):
    splats, view, effects = tiny.gaussians(20), tiny.cameras()[0], Effects(1, "mip", 0.1)
    if with_covariances:
        splats = replace(splats, covariances=covariances_of(splats))
    with pretended.pretending():
        there = splats.to(pretended.DEVICE)
        arguments = gsplat.arguments(there, view, effects)
        arguments |= inria.splats_of(inria.filtered(inria.rescaled(there, view, 2.0), inria.at_the_origin(view), effects))
    assert {value.device.type for value in arguments.values() if isinstance(value, torch.Tensor)} == {pretended.DEVICE}


@pytest.mark.parametrize("scale", [1 / 2, 2])
def test_no_step_waits_for_the_device(scale):
    """Whatever the host asks for before the first step and after the last, more steps ask for no more; backends aside."""
    counts = []
    with pretended.pretending() as device:

        def count(*_):
            counts.append({line: count for line, count in device.waits.items() if not line.startswith(("backends/", "splatting/"))})

        wrapped = wrap_model(tiny.model().to(pretended.DEVICE), cameras=VIEWS, backend="reference")
        settings = dict(FEW, closed_form=False, check_every=100, prune_every=100)  # with checks after the first step and the last
        wrapped.adapt(scale, steps=4, observe=count, **settings)
    assert len(counts) == 5 and counts[1] == counts[2] == counts[3]  # of those after 0 to 4 steps


def cost(work) -> tuple[int, int]:
    """The operations that a work takes there, and how often the host waits for them."""
    with pretended.pretending() as device:
        work(tiny.gaussians(20).to(pretended.DEVICE))
        return device.operations, device.waits.total()


@pytest.mark.parametrize("scale", [1 / 4, 2])
@pytest.mark.parametrize("filters", [("classic", "classic"), ("antialiased", "classic"), (SURFEL, SURFEL)])
def test_the_closed_form_takes_as_many_operations_there_for_any_number_of_views(filters, scale):
    base, target = (Effects(1, name, USUAL_EPS2D.get(name, 0.5)) for name in filters)
    few, many = (cost(lambda splats, views=views: closed_form(splats, views, scale, base, target)) for views in map(tiny.cameras, (3, 9)))
    assert few == many


def test_views_are_looked_at_together_there():
    model = tiny.model()
    for look in (
        lambda splats, views: showing(views, splats.means, 0.2),
        lambda splats, views: remarks(views, model.to(pretended.DEVICE), 0.2, orbit=False),
        lambda splats, views: may_show(splats.opacities, 1e9 * splats.opacities, splats.means, views, views[:2]),
        lambda splats, views: mean_pixel_size(splats.means, views),
    ):
        few, many = (cost(lambda splats, views=views, look=look: look(splats, views)) for views in map(tiny.cameras, (3, 9)))
        assert few == many


@pytest.mark.parametrize("scale", [1 / 4, 2])
def test_images_of_a_step_are_compared_together_there(scale):
    config = AdaptConfig(loss="psnr", compare_at="base")

    def compared(splats, count):
        image, truth = splats.means[None], splats.scales[None]  # as [h, w, 3]
        compare([None] * count, [image] * count, [truth] * count, config, scale, None)

    few, many = (cost(lambda splats, count=count: compared(splats, count)) for count in (2, 5))
    assert few == many


def test_an_image_of_a_third_party_is_looked_at_in_one_wait_there():
    view = tiny.cameras()[0]

    def draw(splats, camera, effects):
        black = splats.means.new_zeros(*camera.size, 3)
        return Rendered(black, black[..., 0])

    _, waits = cost(lambda splats: Guarded("mine", SimpleNamespace(render=draw)).render(splats, view, Effects(1)))
    assert waits == 1


def test_a_check_waits_once_there():
    view = tiny.cameras()[0]
    truth = torch.zeros(*view.size, 3)
    waits = []
    for count in (1, 5):
        with pretended.pretending() as device:
            there = truth.to(pretended.DEVICE)
            validation = Validation([view] * count, [], 1.0, lambda _, there=there: there, [lambda *_, there=there: there], "area")
            validation.steer(tiny.model().to(pretended.DEVICE))
            waits.append(device.waits.total())
    assert waits == [1, 1]


def test_pairs_for_merging_are_those_that_compiled_code_finds(monkeypatch):
    """Bit by bit, for 300 splats along a line, in chunks of 128."""
    monkeypatch.setattr(merging, "ROWS", 128)
    splats = tiny.gaussians(300)
    shapes = torch.eye(3, dtype=torch.float64) * splats.scales[:, :1, None] ** 2
    arrays = splats.means, shapes, 20 * splats.sh[:, 0], 0.1 * splats.opacities, torch.full((300,), 0.5)
    nearest, least = merging._nearest_along(*arrays)
    known, costs = nearest_along(*arrays, reach=merging.NEIGHBORS, limits=(merging.MAX_DISTANCE**2, merging.MAX_COST))
    found = costs.isfinite()
    assert found.sum() > 10 and torch.equal(least, costs) and torch.equal(nearest[found], known[found])


def test_the_pretence_holds():
    with pretended.pretending() as device:
        there = torch.ones(3, requires_grad=True).to(pretended.DEVICE)
        assert there.device.type == pretended.DEVICE and not device.waits
        with pytest.raises(RuntimeError, match="tensors on two devices"):
            there + torch.ones(3)
        with pytest.raises(RuntimeError, match="torch has it for processors alone"):
            torch.histogram(there.detach(), 2)
        assert float((2 * there.detach()).sum()) == 6 and device.waits


@pytest.mark.parametrize(
    "words",
    [
        "render BASE --output OUT --scale 1/2 --depth --normals --supersampling 2",
        "adapt BASE --scale 1/2 --recipe instant --views given --output OUT --report",
    ],
    ids=lambda words: words.split()[0],
)
def test_commands_work_there(words, tmp_path, monkeypatch):
    monkeypatch.setattr("mipmap_plugin.wrap.device_for", lambda name: pretended.DEVICE)
    named = {"BASE": tiny.folder(tmp_path / "base", VIEWS, count=30), "OUT": tmp_path / "out"}
    with pretended.pretending():
        assert main([*(str(named.get(word, word)) for word in words.split()), "--backend", "reference"]) == 0
    assert list(tmp_path.glob("out*"))
