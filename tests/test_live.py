"""Live objects of other projects: copied by their attributes, never changed, adapted like a file."""

import pytest
import tiny
import torch
from torch_checkpoints import splatfacto_state, splats

from mipmap_plugin.errors import SettingsError, ShapeError
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
        self.optimizer = torch.optim.Adam([self._xyz])


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
    adapted = wrap_model(thing, cameras=tiny.cameras(), backend="reference").adapt(1 / 4, steps=2, extra_views=1)
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


def test_each_is_saved_in_its_own_format(tmp_path):
    raw = splats()
    assert adopt(GaussianModel(raw)).save(tmp_path / "inria", provenance={}).name == "point_cloud.ply"
    assert adopt(dict(raw)).save(tmp_path / "gsplat", provenance={}).name == "ckpt_0_rank0.pt"
    for folder in ("inria", "gsplat"):
        assert torch.equal(load_model(tmp_path / folder).parameters()["scales"], raw["scales"])


def test_a_model_of_this_package_stays_itself():
    model = tiny.model()
    assert adopt(model) is model and wrap_model(model).model is model


def test_splats_that_are_not_finite_are_dropped_from_the_copy():
    thing = GaussianModel(splats())
    with torch.no_grad():
        thing._xyz[3] = torch.nan
    adopted = adopt(thing)
    assert len(adopted) == 29 and "1 of 30 splats hold a NaN in means" in " ".join(adopted.notes)


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
        (dict.fromkeys(splats()), "holds no tensor for means"),
        (Mip(), "has a 3D filter .* give the path"),
        (Anchors(), "has anchors with networks .* give the path"),
        ({**splats(), "features": torch.zeros(30, 32)}, "a dict with means, .*is no model that is known"),
        (7, "a int is no model that is known; give a path"),
    ],
)
def test_other_objects_are_refused_in_one_sentence(thing, sentence):
    with pytest.raises(SettingsError, match=sentence):
        wrap_model(thing)


def test_flat_splats_are_refused():
    with pytest.raises(ShapeError, match=r"scales: expected shape \[30, 3\], got \[30, 2\]"):
        adopt(GaussianModel({**splats(), "scales": torch.zeros(30, 2)}))
