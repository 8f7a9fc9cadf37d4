"""Live objects of other projects: copied by their attributes, never changed, adapted like a file."""

from dataclasses import replace
from types import SimpleNamespace

import anchor_checkpoints as checkpoints
import numpy as np
import pytest
import tiny
import torch
from anchor_checkpoints import Layout
from torch_checkpoints import splatfacto_state, splats

from mipmap_plugin.errors import CheckpointError, SettingsError, ShapeError
from mipmap_plugin.models import load_model
from mipmap_plugin.models.live import adopt
from mipmap_plugin.wrap import wrap_model


class GaussianModel:
    """What INRIA's class holds after training: parameters under these names, in these shapes, and an optimizer."""

    def __init__(self, raw):
        grow = lambda tensor: torch.nn.Parameter(tensor.clone())  # noqa: E731
        self.active_sh_degree = self.max_sh_degree = 1
        self._xyz, self._scaling, self._rotation = grow(raw["means"]), grow(raw["scales"]), grow(raw["quats"])
        self._opacity = grow(raw["opacities"][:, None])
        # 3DGS stores its features transposed, so that they are not contiguous until a step has been taken
        self._features_dc = torch.nn.Parameter(raw["sh0"].transpose(1, 2).contiguous().transpose(1, 2))
        self._features_rest = torch.nn.Parameter(raw["shN"].transpose(1, 2).contiguous().transpose(1, 2))
        self.optimizer = SimpleNamespace(param_groups=[{"params": [self._xyz]}])  # a real one loads a compiler, for seconds


def live_objects(raw):
    gauss_params = torch.nn.ParameterDict({name.rpartition(".")[2]: tensor for name, tensor in splatfacto_state(raw).items()})

    class SplatfactoModel(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.gauss_params = gauss_params

    return {
        "inria": GaussianModel(raw),
        "gsplat dict": dict(raw),
        "gsplat ParameterDict": torch.nn.ParameterDict({name: tensor.clone() for name, tensor in raw.items()}),
        "splatfacto": SplatfactoModel(),
        "gauss_params": gauss_params,
    }


KINDS = list(live_objects(splats()))


def tensors_of(thing):
    if isinstance(thing, GaussianModel):
        return [value for value in vars(thing).values() if torch.is_tensor(value)]
    return list(thing.parameters()) if isinstance(thing, torch.nn.Module) else list(thing.values())


@pytest.mark.parametrize("kind", KINDS)
def test_the_numbers_are_those_of_the_live_model(kind):
    raw = splats()
    adopted = adopt(live_objects(raw)[kind])
    assert all(torch.equal(adopted.parameters()[name], tensor) for name, tensor in raw.items())
    assert all(tensor.is_contiguous() and not tensor.requires_grad for tensor in adopted.parameters().values())


@pytest.mark.parametrize("kind", KINDS)
def test_adapting_never_changes_the_live_model(kind):
    thing = live_objects(splats(60))[kind]
    before = [(tensor.clone(), tensor._version, tensor.requires_grad, tensor.data_ptr()) for tensor in tensors_of(thing)]
    adapted = wrap_model(thing, cameras=tiny.cameras()).adapt(1 / 4, steps=2, extra_views=1)
    assert adapted.report.gaussians_before == 60
    for tensor, (value, version, requires_grad, place) in zip(tensors_of(thing), before, strict=True):
        assert torch.equal(tensor, value)
        assert (tensor._version, tensor.requires_grad, tensor.data_ptr(), tensor.grad) == (version, requires_grad, place, None)


def test_a_change_of_the_live_model_does_not_reach_the_copy():
    thing = GaussianModel(splats())
    adopted = adopt(thing)
    with torch.no_grad():
        thing._xyz.add_(1)
    assert torch.equal(adopted.parameters()["means"] + 1, thing._xyz)


def test_a_live_model_is_saved_in_its_own_format(tmp_path):
    raw = splats()
    assert adopt(GaussianModel(raw)).save(tmp_path / "inria", provenance={}).name == "point_cloud.ply"
    assert adopt(dict(raw)).save(tmp_path / "gsplat", provenance={}).name == "ckpt_0_rank0.pt"
    for folder in ("inria", "gsplat"):
        assert torch.equal(load_model(tmp_path / folder).parameters()["scales"], raw["scales"])


def test_a_model_of_this_package_stays_itself():
    model = tiny.model()
    assert adopt(model) is model and wrap_model(model).model is model


class Empty(GaussianModel):
    def __init__(self):
        super().__init__({**splats(), "means": torch.empty(0)})


class Mip(GaussianModel):
    def __init__(self):
        super().__init__(splats())
        self.filter_3D = torch.ones(30, 1)


class Anchors:
    _anchor = _offset = torch.zeros(2, 3)


@pytest.mark.parametrize(
    ("thing", "sentence"),
    [
        (Empty(), "this Empty has no splats yet; load or train it first"),
        (dict.fromkeys(splats()), "holds no tensor of real numbers for means, .*; load or train it first, or give dense tensors or arrays"),
        ({**splats(), "means": np.array(["a"])}, "holds no tensor of real numbers for means;"),
        ({name: tensor.to("meta") for name, tensor in splats().items()}, "holds no tensor of real numbers for means, .*; load or train it first"),
        ({**splats(), "sh0": splats()["sh0"].to_sparse()}, "holds no tensor of real numbers for sh0;"),
        ({**splats(), "sh0": splats()["sh0"].to(torch.complex64)}, "holds no tensor of real numbers for sh0;"),
        ({**splats(), "opacities": torch.tensor(0.5)}, "holds no tensor of real numbers for opacities;"),
        (Mip(), "has a 3D filter .* give the path"),
        (Anchors(), "has anchors with networks .* give the path"),
        ({name: tensor for name, tensor in splats().items() if name != "shN"}, r"shN is empty, \[N, 0, 3\]\), and this one lacks shN$"),
        ({**splats(), "features": torch.zeros(30, 32)}, r"a dict with means, .*is not a known kind of model.* and this one has features besides$"),
        (wrap_model(splats()), "a Wrapped is not a known kind of model; give its attribute `model`$"),
        (torch.nn.DataParallel(torch.nn.Linear(1, 1)), "a DataParallel is not a known kind of model; give its attribute `module`$"),
        (7, "an int is not a known kind of model; give a path"),
    ],
)
def test_other_objects_are_refused_in_one_sentence(thing, sentence):
    with pytest.raises(SettingsError, match=sentence):
        wrap_model(thing)


def trainer(raw):
    """As gsplat's simple_trainer keeps its splats."""
    held = torch.nn.Module()
    held.splats = torch.nn.ParameterDict({name: tensor.clone() for name, tensor in raw.items()})
    return held


@pytest.mark.parametrize(
    "thing",
    [
        lambda raw: {name: tensor.numpy() for name, tensor in raw.items()},
        lambda raw: {name: tensor.double().numpy() for name, tensor in raw.items()},
        lambda raw: {"splats": raw},
        lambda raw: {"step": 7, "splats": torch.nn.ParameterDict(raw)},
        trainer,
    ],
)
def test_splats_in_other_hands_are_those_of_gsplat(thing):
    raw = splats()
    held = thing(raw)
    adopted = adopt(held)
    assert all(torch.equal(adopted.parameters()[name], tensor) for name, tensor in raw.items())
    with torch.no_grad():
        for tensor in adopted.parameters().values():
            tensor.zero_()
    assert adopt(held).parameters()["means"].abs().sum() > 0


def test_nerfstudio_s_pipeline_and_trainer_hold_its_model():
    pipeline = SimpleNamespace(model=live_objects(raw := splats())["splatfacto"])
    for each in (pipeline, SimpleNamespace(pipeline=pipeline)):
        assert torch.equal(adopt(each).parameters()["means"], raw["means"])


def test_gaussians_are_taken_as_splats_of_3dgs():
    given = adopt(splats()).gaussians().detach()
    adopted = adopt(given)
    taken = adopted.gaussians()
    for name in ("means", "scales", "opacities", "sh"):
        torch.testing.assert_close(getattr(taken, name), getattr(given, name))
    with torch.no_grad():
        adopted.parameters()["means"].zero_()
    assert given.means.abs().sum() > 0
    with pytest.raises(SettingsError, match="Gaussians with covariances cannot be stored"):
        adopt(replace(given, scales=-given.scales, covariances=torch.eye(3).expand(len(given), 3, 3)))
    with pytest.raises(SettingsError, match="this Gaussians has no splats yet"):
        adopt(given[:0])


def test_gaussians_of_raw_parameters_are_refused():
    given = adopt(splats()).gaussians().detach()
    with pytest.raises(SettingsError, match=r"these Gaussians have negative scales, but scales are lengths, .* activated by scales\.exp\(\)"):
        wrap_model(replace(given, scales=given.scales.log()))
    with pytest.raises(SettingsError, match=r"these Gaussians have opacities from -\d.* to \d.*, but"):
        wrap_model(replace(given, opacities=given.opacities.logit()))


def test_scales_of_no_shape_are_refused():
    with pytest.raises(ShapeError, match=r"scales: expected shape \[30, 3\], got \[30, 4\]"):
        adopt(GaussianModel({**splats(), "scales": torch.zeros(30, 4)}))


# Scaffold-GS

LAYOUTS = [Layout(), Layout(bank=True, distance=("opacity_mlp", "color_mlp"), appearance=(3, 2))]


class ScaffoldGaussianModel:
    """What Scaffold-GS's class holds after training, with the numbers that the generator writes."""

    def __init__(self, layout):
        columns = {name: torch.from_numpy(column) for name, column in checkpoints.columns(layout).items()}
        stack = lambda prefix: torch.stack([columns[name] for name in columns if name.startswith(prefix)], 1)  # noqa: E731
        self._anchor = torch.nn.Parameter(torch.stack([columns[name] for name in "xyz"], 1))
        self._offset = torch.nn.Parameter(stack("f_offset_").unflatten(1, (3, -1)).transpose(1, 2))
        self._anchor_feat, self._scaling = torch.nn.Parameter(stack("f_anchor_feat_")), torch.nn.Parameter(stack("scale_"))
        self._rotation, self._opacity = stack("rot_"), stack("opacity")
        self.embedding_appearance = None
        for name, state in checkpoints.weights(layout).items():
            state = {key: torch.from_numpy(held) for key, held in state.items()}
            if name == "appearance":
                network, attribute = checkpoints.Embedding(*layout.appearance), "embedding_appearance"
            else:
                hidden, count = state["0.weight"].shape[0], len(state["2.bias"])
                network = torch.nn.Sequential(torch.nn.Linear(layout.inputs(name), hidden), torch.nn.ReLU(True), torch.nn.Linear(hidden, count))
                attribute = "mlp_" + name.removesuffix("_mlp")
            network.load_state_dict(state)
            setattr(self, attribute, network)

    def tensors(self):
        held = vars(self).values()
        return [member for member in held if torch.is_tensor(member)] + [p for m in held if isinstance(m, torch.nn.Module) for p in m.parameters()]


def is_same(one, other):
    """Whether two models show the same splats, bit by bit, to a camera of the training and to one of none."""
    pairs = [(one.gaussians(camera), other.gaussians(camera)) for camera in tiny.cameras()]
    parts = ("means", "scales", "quats", "opacities", "sh")
    return all(len(a) == len(b) > 5 and all(torch.equal(getattr(a, part), getattr(b, part)) for part in parts) for a, b in pairs)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_live_anchors_decode_as_those_of_the_file(layout, tmp_path):
    checkpoints.write(tmp_path / "model", layout)
    assert is_same(adopt(ScaffoldGaussianModel(layout)), load_model(tmp_path / "model"))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_adapting_live_anchors_leaves_them_and_a_saved_one_loads_the_same(layout, tmp_path):
    thing = ScaffoldGaussianModel(layout)
    before = [(tensor.detach().clone(), tensor._version, tensor.data_ptr()) for tensor in thing.tensors()]
    adapted = wrap_model(thing, cameras=tiny.cameras()).adapt(1 / 4, steps=2, extra_views=1)
    for tensor, (value, version, place) in zip(thing.tensors(), before, strict=True):
        assert torch.equal(tensor, value) and (tensor._version, tensor.data_ptr(), tensor.grad) == (version, place, None)
    adapted.model.save(tmp_path / "saved", provenance={})
    assert not is_same(adapted.model, adopt(thing)) and is_same(adapted.model, load_model(tmp_path / "saved"))


def test_live_networks_are_saved_as_the_torchscript_that_the_original_loads(tmp_path):
    thing = ScaffoldGaussianModel(LAYOUTS[0])
    ply = adopt(thing).save(tmp_path / "saved", provenance={})
    features = torch.linspace(-1, 1, 2 * LAYOUTS[0].inputs("opacity_mlp")).reshape(2, -1)
    assert torch.allclose(torch.jit.load(ply.parent / "opacity_mlp.pt")(features), thing.mlp_opacity(features).tanh())


def test_live_anchors_that_do_not_fit_are_refused():
    thing, octree = ScaffoldGaussianModel(Layout()), ScaffoldGaussianModel(Layout())
    octree._level = torch.zeros(40, 1)
    with pytest.raises(SettingsError, match=r"has anchors with levels .* give the path"):
        adopt(octree)
    thing._scaling = thing._scaling[:, :3]
    with pytest.raises(ShapeError, match=r"_scaling: expected shape \[40, 6\], got \[40, 3\]"):
        adopt(thing)
    thing = ScaffoldGaussianModel(Layout())
    thing.mlp_cov = thing.mlp_opacity
    with pytest.raises(CheckpointError, match="ScaffoldGaussianModel: cov_mlp gives 3 numbers, but anchors with 3 splats need 21"):
        adopt(thing)
