"""Live models of other projects, recognized by their attributes: tensors are copied; nothing is imported from these projects or changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.errors import SettingsError, ShapeError, some_of, type_of
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models import splatfacto
from mipmap_plugin.models.anchors.companions import NEEDED
from mipmap_plugin.models.anchors.networks import Weights
from mipmap_plugin.models.anchors.scaffold import scaffold_in_memory
from mipmap_plugin.models.base import CARRIED, OF_3DGS, SplatModel, TrainedScale, tensors_of
from mipmap_plugin.models.contract import OPACITY_ROUNDING, lacking
from mipmap_plugin.models.gsplat import model as gsplat
from mipmap_plugin.models.health import holds_splats, rows_where
from mipmap_plugin.models.reading import without_invalid
from mipmap_plugin.models.surfels import FLAT, SurfelModel, flat_trained
from mipmap_plugin.models.vanilla import Origin, VanillaModel

# INRIA's GaussianModel and its descendants: name of the parameter here -> attribute.
INRIA = {
    "means": "_xyz",
    "scales": "_scaling",
    "quats": "_rotation",
    "opacities": "_opacity",  # [N, 1]
    "sh0": "_features_dc",
    "shN": "_features_rest",
}

# Scaffold-GS's GaussianModel: name here -> attribute, and its shape after N; 0 is any number.
ANCHORS = {
    "means": ("_anchor", (3,)),
    "offsets": ("_offset", (0, 3)),
    "features": ("_anchor_feat", (0,)),
    "scales": ("_scaling", (6,)),
    "opacities": ("_opacity", (1,)),
    "quats": ("_rotation", (4,)),
}

# Its networks; those of the second line are None or missing if they are not used.
NETWORKS = {
    "opacity_mlp": "mlp_opacity", "cov_mlp": "mlp_cov", "color_mlp": "mlp_color",
    "feature_bank_mlp": "mlp_feature_bank", "appearance": "embedding_appearance",
}  # fmt: skip

# Deformable 3D Gaussians keeps its network in another object; among the classes with these tensors only its own has no `capture`.
MAY_MOVE = (
    "this {name} has no capture(), like that of Deformable 3D Gaussians: if a network moves its splats, these are the splats before they move;"
    " give the path of the model folder to adapt a moving scene"
)

# Attributes of descendants with further parts, and what these are.
MORE = {
    "_level": "anchors with levels (Octree-GS)",
    "_anchor": "anchors with networks other than those of Scaffold-GS",
    "_deformation": "a deformation network (4D Gaussians)",
    "filter_3D": "a 3D filter (Mip-Splatting, GOF)",
    "_trbf_center": "splats that move (SpacetimeGaussians)",
}


def adopt(model: Any) -> SplatModel:
    """A model of this package itself, or a copy of another project's live model.

    Accepted are:
    - the `GaussianModel` of INRIA's 3DGS, of projects that only train it differently, and of Scaffold-GS;
    - gsplat's `splats` (a dict or a ParameterDict), or what holds them under that name, as its trainer and its checkpoints do;
    - splatfacto's model, its `gauss_params`, and nerfstudio's pipeline or trainer around it;
    - `Gaussians`.

    Tensors may be NumPy arrays. The copy is on the original's device. Splats that are not finite are dropped, as when a file is loaded.
    Raises SettingsError for another object, ShapeError for tensors that do not fit together, CheckpointError for networks that do not fit their
    anchors.
    """
    if callable(getattr(model, "gaussians", None)):
        if members := lacking(model):
            raise SettingsError(f"this {_name(model)} has gaussians() as a model has, but lacks {', '.join(members)}; see mipmap_plugin.models.base")
        inference = any(tensor.is_inference() for tensor in tensors_of(model).values())
        return _checked(model.to(model.parameters()["means"].device) if inference else model)  # no gradient passes such tensors
    if isinstance(model, Gaussians):
        if model.covariances is None:  # others are refused below, whatever else they hold
            _refuse_raw(model)
        splats = replace(model, **_copied(model, {name: tensor for name, tensor in vars(model).items() if tensor is not None}))
        return without_invalid(VanillaModel.from_gaussians(splats).noted("made of Gaussians"))
    parts = [what for name, what in MORE.items() if hasattr(model, name)]
    if parts == [MORE["_anchor"]] and _is_scaffold(model):
        return scaffold_in_memory(_anchors(model), _networks(model), _name(model))
    if parts:
        raise SettingsError(f"this {_name(model)} has {parts[0]}, which are read from files only; save it, and give the path")
    if all(hasattr(model, name) for name in INRIA.values()):
        raw = _copied(model, {name: getattr(model, attribute) for name, attribute in INRIA.items()})
        raw["opacities"] = raw["opacities"].reshape(-1)
        if raw["scales"].dim() == 2 and raw["scales"].shape[1] == 2:  # 2DGS and its descendants
            raw["scales"] = torch.cat([raw["scales"], torch.full_like(raw["scales"][:, :1], FLAT)], dim=1)
            return _adopted(model, raw, flat_trained(TrainedScale()), Origin(), SurfelModel)
        adopted = _adopted(model, raw, TrainedScale(), Origin())
        adopted.notes += [] if hasattr(model, "capture") else [MAY_MOVE.format(name=_name(model))]
        return adopted
    model = _of_nerfstudio(model)
    tensors = _mapping(getattr(model, "gauss_params", getattr(model, "splats", model)))
    tensors = _mapping(tensors["splats"]) if isinstance(tensors.get("splats"), Mapping | torch.nn.ParameterDict) else tensors
    if set(splatfacto.NAMES) <= set(tensors):
        raw = splatfacto.to_parameters(_copied(model, {name: tensors[name] for name in splatfacto.NAMES}))
        return _adopted(model, raw, TrainedScale(near_plane=splatfacto.NEAR_PLANE, up=splatfacto.UP), Origin())
    if set(OF_3DGS) == set(tensors):
        return _adopted(model, _copied(model, tensors), TrainedScale(near_plane=gsplat.NEAR_PLANE, up=gsplat.UP), Origin(host=gsplat.GsplatHost()))
    content = f" with {', '.join(map(str, list(tensors)[:8]))}" if tensors else ""
    raise SettingsError(f"{type_of(model)}{content} is not a known kind of model; {_advice(model, tensors)}")


def _refuse_raw(gaussians: Gaussians) -> None:
    """Raise SettingsError for Gaussians of raw parameters, which as activated ones are mostly points of no opacity."""
    low, high = (float(end) for end in gaussians.opacities.detach().aminmax()) if len(gaussians) else (0.0, 1.0)
    outside = [f"opacities from {low:.3g} to {high:.3g}"] * (low < -OPACITY_ROUNDING or high > 1 + OPACITY_ROUNDING)
    negative = ["negative scales"] * bool((gaussians.scales.detach() < 0).any())
    if wrong := [*negative, *outside]:
        raw = "raw parameters are activated by scales.exp() and opacities.sigmoid(), or given as a dictionary, as gsplat has them"
        raise SettingsError(f"these Gaussians have {' and '.join(wrong)}, but scales are lengths, and opacities 0..1; {raw}")


def _of_nerfstudio(model: Any) -> Any:
    """The model within nerfstudio's pipeline or trainer; anything else as it is."""
    within = getattr(getattr(model, "pipeline", model), "model", None)
    return within if hasattr(within, "gauss_params") else model


def _advice(model: Any, tensors: Mapping[str, Any]) -> str:
    """What to give instead of an object that is not known."""
    if isinstance(model, torch.nn.Module) and isinstance(getattr(model, "module", None), torch.nn.Module):  # DistributedDataParallel, for one
        return "give its attribute `module`"
    if callable(getattr(getattr(model, "model", None), "gaussians", None)):  # what is wrapped, or adapted
        return "give its attribute `model`"
    if "means" in tensors:
        lacks, beside = (", ".join(sorted(map(str, names))) for names in (set(OF_3DGS) - set(tensors), set(tensors) - set(OF_3DGS)))
        unlike = [f"lacks {lacks}"] * bool(lacks) + [f"has {beside} besides"] * bool(beside)
        return f"gsplat's dictionary has {', '.join(OF_3DGS)} (for SH degree 0 shN is empty, [N, 0, 3]), and this one {' and '.join(unlike)}"
    return "give a path, a GaussianModel, gsplat's dictionary of splats, or nerfstudio's model"


def _checked(model: SplatModel) -> SplatModel:
    """The model without splats that are not finite. Raises SettingsError for NaN in a model of another class, whose rows cannot be dropped."""
    if isinstance(model, VanillaModel) and holds_splats(model):  # a class derived from it may have other parameters
        return without_invalid(model)
    for name, tensor in model.parameters().items():
        if rows := rows_where(torch.isnan, tensor.detach()):
            raise SettingsError(f"this {_name(model)} holds a NaN in {name} of {some_of(rows, len(tensor), 'row')}; drop these first")
    return model


def _is_scaffold(model: Any) -> bool:
    networks = [getattr(model, NETWORKS[name], None) for name in NEEDED]
    return all(hasattr(model, name) for name, _ in ANCHORS.values()) and all(isinstance(network, torch.nn.Module) for network in networks)


def _anchors(model: Any) -> dict[str, Tensor]:
    raw = _copied(model, {name: getattr(model, attribute) for name, (attribute, _) in ANCHORS.items()})
    for name, (attribute, rest) in ANCHORS.items():
        shape = raw[name].shape
        if len(shape) != 1 + len(rest) or any(size not in (0, held) for size, held in zip((len(raw["means"]), *rest), shape, strict=True)):
            wanted = ", ".join(str(size or "any") for size in (len(raw["means"]), *rest))
            raise ShapeError(f"{attribute}: expected shape [{wanted}], got {list(shape)}")
    carried = torch.cat([raw.pop("opacities"), raw.pop("quats")], 1)
    return {**raw, CARRIED: carried}


def _networks(model: Any) -> Weights:
    used = {name: network for name, attribute in NETWORKS.items() if (network := getattr(model, attribute, None)) is not None}
    return {name: _copied(model, network.state_dict()) for name, network in used.items()}


def _mapping(model: Any) -> dict[str, Any]:
    return dict(model.items()) if isinstance(model, (Mapping, torch.nn.ParameterDict)) else {}


def _copied(model: Any, tensors: Mapping[str, Any]) -> dict[str, Tensor]:
    """Contiguous float32 copies. Raises SettingsError for values that are neither tensors nor arrays of real numbers, and for empty ones."""
    tensors = {name: torch.from_numpy(np.array(value, np.float32)) if _is_array(value) else value for name, value in tensors.items()}
    if missing := [name for name, tensor in tensors.items() if not _is_dense(tensor)]:
        lacks = f"holds no tensor of real numbers for {', '.join(missing)}"
        raise SettingsError(f"this {_name(model)} {lacks}; load or train it first, or give dense tensors or arrays")
    if any(len(tensor) == 0 for tensor in tensors.values()):
        raise SettingsError(f"this {_name(model)} has no splats yet; load or train it first")
    return {name: tensor.detach().to(torch.float32, copy=True, memory_format=torch.contiguous_format) for name, tensor in tensors.items()}


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray) and value.ndim > 0 and value.dtype.kind in "fiu"


def _is_dense(value: Any) -> bool:
    """Whether it is a tensor that holds real numbers: one on the device meta holds none, before a model is loaded."""
    return torch.is_tensor(value) and value.layout == torch.strided and value.dim() > 0 and not (value.is_meta or value.is_complex())


def _adopted(model: Any, raw: dict[str, Tensor], trained: TrainedScale, origin: Origin, kind: type[VanillaModel] = VanillaModel) -> VanillaModel:
    return without_invalid(kind(raw, trained, origin, [f"copied from a live {_name(model)}"]))


def _name(model: Any) -> str:
    return type(model).__name__
