"""Whether third-party families keep the contract of a model (`base`), before anything relies on it; a breach is a PluginError that names them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from inspect import isfunction, signature
from pathlib import Path
from types import NoneType
from typing import Any, cast

import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import CheckpointError, PluginError, ShapeError, type_of
from mipmap_plugin.formats.atomic import staged
from mipmap_plugin.formats.magic import kind_of
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.base import CARRIED, OF_3DGS, PARAMETERS, Filtered, Placed, Rebuilt, SplatModel, Thinned, TrainedScale, Traits, tensors_of
from mipmap_plugin.models.detect import detect
from mipmap_plugin.plugin_errors import is_third_party, naming, naming_any
from mipmap_plugin.splatting.eigen import by_axes

# What a model with a trait provides beside what every model does.
PROMISED = {"same_for_all_views": Rebuilt, "placed": Placed, "thins": Thinned, "filtered": Filtered}

# The types of a model's attributes.
TYPES: dict[str, tuple[type, ...]] = {
    "traits": (Traits,), "family": (str,), "trained": (TrainedScale,), "notes": (list,), "source": (Path, NoneType), "folder": (Path, NoneType),
    "digest": (str,),
}  # fmt: skip

# Types of what is optimized: steps are lost in float16, and no backend draws it.
DRAWN = (torch.float32, torch.float64)

# By which the activation of a third-party family may leave 0..1.
OPACITY_ROUNDING = 1e-4

# By how much of its largest entry a third-party family's covariance may lack symmetry, or a variance be below 0.
COVARIANCE_ROUNDING = 1e-3

# Types of files by the endings that third-party families may write beside their own.
ENDINGS = {".ply": "ply", ".spz": "spz", ".sog": "sog"}


def lacking(model: Any) -> list[str]:
    """What an object lacks to be a SplatModel: members, types, arguments, or the right parameters; [] if nothing. Raises PluginError if it fails."""
    with naming_any({f"this {type(model).__name__}": model}):  # any attribute may be a property
        return _lacking(model)


def _lacking(model: Any) -> list[str]:
    traits = getattr(model, "traits", None)
    protocols = [SplatModel, *(protocol for trait, protocol in PROMISED.items() if getattr(traits, trait, False))]
    methods = {name: method for protocol in protocols for name, method in vars(protocol).items() if isfunction(method) and name[0] != "_"}
    if missing := [name for name in (*TYPES, *methods) if not hasattr(model, name)]:
        return missing
    types = [f"{name} of the type {_names(kinds)}" for name, kinds in TYPES.items() if not isinstance(getattr(model, name), kinds)]
    calls = [call for name, method in methods.items() if (call := _refused_call(name, method, getattr(model, name)))]
    return types or calls or _wrong_parameters(model)


def _names(kinds: tuple[type, ...]) -> str:
    return " or ".join("None" if kind is NoneType else kind.__name__ for kind in kinds)


def _refused_call(name: str, promised: Callable[..., Any], own: Any) -> str:
    """The call of a method, such as "reshape(form, views)", if `own` does not take what is `promised`; "" if it does."""
    parameters = list(signature(promised).parameters.values())[1:]
    by_place = [each.name for each in parameters if each.kind is not each.KEYWORD_ONLY]
    by_name = [each.name for each in parameters if each.kind is each.KEYWORD_ONLY]
    try:
        signature(own).bind(*by_place, **dict.fromkeys(by_name))
    except TypeError:
        return f"{name}({', '.join([*by_place, *['*'] * bool(by_name), *by_name])})"
    except ValueError:  # compiled code does not tell what it takes
        pass
    return ""


def _wrong_parameters(model: SplatModel) -> list[str]:
    """What `lacking` says of parameters: their names, and that each has one row for each splat or anchor."""
    with naming_any({f"family {model.family!r}": model}):
        parameters: Any = model.parameters()
        shared: Any = model.shared_parameters()
    returned = {"parameters": parameters, "shared_parameters": shared}
    if no_dictionary := [f"{name}() that returns a dictionary" for name, got in returned.items() if not isinstance(got, dict)]:
        return no_dictionary
    wrong = ["the parameter 'means'"] * ("means" not in parameters)
    wrong += [f"a name of PARAMETERS for {name!r}" for name in parameters if name not in PARAMETERS]
    wrong += [f"the parameters {', '.join(OF_3DGS)}, which its trait `plain` promises"] * (model.traits.plain and {*parameters} != {*OF_3DGS})
    if others := [name for name, tensor in {**parameters, **shared}.items() if not isinstance(tensor, Tensor)]:
        wrong.append(f"tensors as the parameters {', '.join(map(str, others))}")
    if undrawn := [f"{name} of {tensor.dtype}" for name, tensor in parameters.items() if not wrong and name != CARRIED and tensor.dtype not in DRAWN]:
        wrong.append(f"parameters of float32: it has {', '.join(undrawn)}")
    rows = {name: len(tensor) if tensor.ndim else "single" for name, tensor in parameters.items()} if not wrong else {}
    if len({*rows.values()}) > 1:
        wrong.append(f"parameters of one length: it has {', '.join(f'{count} {name}' for name, count in rows.items())}")
    return wrong


def refuse_broken(model: SplatModel, camera: Camera, *, steps: bool) -> None:
    """Raise PluginError for a model whose copies are no copies, as the base would change with them. `steps`: for splats without gradients, too."""
    if not is_third_party(model):
        return
    family = f"family {model.family!r}"
    with naming(family):
        copied = model.copy()
        if missing := lacking(copied):
            raise PluginError(f"{family}: copy() returned {type_of(copied)}, which lacks {', '.join(missing)}")
        own, theirs = tensors_of(model), tensors_of(copied)
    places = {tensor.untyped_storage().data_ptr() for tensor in own.values() if tensor.numel()}
    if shared := [name for name, tensor in theirs.items() if tensor.untyped_storage().data_ptr() in places]:
        raise PluginError(f"{family}: copy() shares {', '.join(shared)} with the model itself, which adaptation would change; clone the tensors")
    fixed = [name for name, tensor in copied.parameters().items() if name != CARRIED and not (tensor.is_leaf and tensor.requires_grad)]
    fixed += [name for name, tensor in copied.shared_parameters().items() if not tensor.is_leaf]
    if fixed:
        raise PluginError(f"{family}: copy() has to return parameters that are leaves and require gradients; {', '.join(fixed)} cannot be optimized")
    if steps:
        with naming(family):
            _refuse_gradients(family, copied, camera)


def checked_splats(model: SplatModel, camera: Camera) -> Gaussians:
    """The splats that a camera sees. Raises PluginError if a third-party family returns something else, or splats that no image can show."""
    if not is_third_party(model):
        return model.gaussians(camera)
    try:
        gaussians: Any = model.gaussians(camera)
    except ShapeError as error:  # of the record that it makes
        raise PluginError(f"family {model.family!r}: gaussians() returned splats that do not fit together: {error}") from error
    if not isinstance(gaussians, Gaussians):
        raise PluginError(f"family {model.family!r}: gaussians() has to return Gaussians; it returned {type_of(gaussians)}")
    tensors = {name: tensor for name, tensor in vars(gaussians).items() if isinstance(tensor, Tensor)}
    if wrong := [name for name, tensor in tensors.items() if not tensor.isfinite().all()]:
        raise PluginError(f"family {model.family!r}: gaussians() returned NaN or infinity in {', '.join(wrong)}; leave such splats out while loading")
    least, most = gaussians.opacities.detach().aminmax() if len(gaussians) else (0.0, 0.0)
    if least < -OPACITY_ROUNDING or most > 1 + OPACITY_ROUNDING:
        outside = f"opacities from {float(least):.3g} to {float(most):.3g}"
        raise PluginError(f"family {model.family!r}: gaussians() returned {outside}, which have to lie in 0..1; activate or clamp them")
    if shapeless := _no_shapes(gaussians):
        raise PluginError(f"family {model.family!r}: gaussians() returned {shapeless}")
    return gaussians


@torch.no_grad()
def _no_shapes(gaussians: Gaussians) -> str:
    """Why scales are no lengths, or covariances are none, and what to do; empty if they are."""
    if gaussians.covariances is None:
        negative = bool((gaussians.scales < 0).any())
        return "negative scales, which have to be lengths; activate them by exp(), or take abs()" if negative else ""
    slack = COVARIANCE_ROUNDING * gaussians.covariances.abs().amax((1, 2), keepdim=True)
    if ((gaussians.covariances - gaussians.covariances.mT).abs() > slack).any():
        return "covariances that are not symmetric; of a factor L give L @ L.mT"
    negative = bool((gaussians.covariances.diagonal(dim1=1, dim2=2) < -slack[:, :, 0]).any())
    return "covariances with negative variances on the diagonal; check their signs and the order of their numbers" if negative else ""


def _refuse_gradients(family: str, copied: SplatModel, camera: Camera) -> None:
    """Raise PluginError if the splats of a copy have no gradients, or such that are not finite."""
    splats = checked_splats(copied, camera)
    tensors = [tensor for tensor in vars(splats).values() if isinstance(tensor, Tensor) and tensor.requires_grad]
    if not tensors and len(splats):
        raise PluginError(f"{family}: gaussians() returned splats without gradients; make them of parameters() by torch's operations, not detached")
    if tensors:
        torch.stack([tensor.sum() for tensor in tensors]).sum().backward()
    if wrong := [name for name, leaf in copied.parameters().items() if leaf.grad is not None and not leaf.grad.isfinite().all()]:
        raise PluginError(f"{family}: gaussians() has gradients with NaN or infinity in {', '.join(wrong)}; a root or a norm of 0 has none, for one")


def row_opacities(model: SplatModel, views: Sequence[Camera]) -> Tensor:
    """The model's `row_opacities`, [N]. Raises PluginError for anything else."""
    with naming_any({f"family {model.family!r}": model}):
        opacities: Any = model.row_opacities(views)
    rows = len(model.parameters()["means"])
    if not isinstance(opacities, Tensor) or tuple(opacities.shape) != (rows,) or not opacities.isfinite().all():
        got = f"a tensor {list(opacities.shape)}" if isinstance(opacities, Tensor) else type_of(opacities)
        got += ", not all finite" if isinstance(opacities, Tensor) and not opacities.isfinite().all() else ""
        wanted = f"{rows} finite numbers, one for each row of its parameters"
        raise PluginError(f"family {model.family!r}: row_opacities() has to return {wanted}; it returned {got}")
    return opacities


def rebuild(model: SplatModel, form: Callable[[Gaussians], Gaussians]) -> None:
    """Have the model rebuilt, from splats without covariances. Raises PluginError if it does not hold the splats of `form` then, or NaN."""
    made: list[int] = []

    def counted(gaussians: Gaussians) -> Gaussians:
        formed = form(by_axes(gaussians))
        made.append(len(formed))
        return formed

    cast(Rebuilt, model).rebuild(counted)
    rows = len(model.parameters()["means"])
    if made != [rows]:
        got = f"called it {len(made)} times" if len(made) != 1 else f"holds {rows} splats after it returned {made[0]}"
        raise PluginError(f"family {model.family!r}: rebuild(form) has to hold the splats that `form` returns; it {got}")
    _refuse_not_finite(model, "rebuild(form)")


def replace_parameters(model: SplatModel, parameters: dict[str, Tensor]) -> None:
    """Give the model these tensors as its leaves. Raises PluginError if it holds others then, which no optimizer would move."""
    model.replace_parameters(parameters)
    held = model.parameters() if is_third_party(model) else parameters
    if others := [name for name, tensor in parameters.items() if held.get(name) is not tensor]:
        raise PluginError(f"family {model.family!r}: replace_parameters() has to keep the tensors themselves; {', '.join(others)} are others then")


def reshape(model: SplatModel, form: Callable[[Gaussians], tuple[Tensor, Tensor]], views: Sequence[Camera]) -> None:
    """Have the splats reshaped. Raises PluginError if their parameters hold NaN then."""
    model.reshape(form, views)
    _refuse_not_finite(model, "reshape(form, views)")


def _refuse_not_finite(model: SplatModel, call: str) -> None:
    """Raise PluginError if a third-party family left a NaN. An infinity may be the logit of 1, or the logarithm of 0."""
    if is_third_party(model) and (wrong := [name for name, tensor in model.parameters().items() if tensor.isnan().any()]):
        raise PluginError(f"family {model.family!r}: {call} left NaN in {', '.join(wrong)}; keep what it divides by, or takes a root of, above 0")


def save(model: SplatModel, path: Path, provenance: dict[str, Any], *, overwrite: bool = False) -> Path:
    """Save the model; return the file. Raises what the model raises, and PluginError if there is no file, or one that is not what its ending says
    or that no family knows."""
    saved: Any = model.save(path, provenance=provenance, overwrite=overwrite)
    if not isinstance(saved, (str, Path)):
        wrong = f"save() has to return the path of the file that it wrote; it returned {type_of(saved)}"
        raise PluginError(f"family {model.family!r}: {wrong}, so that {path} is left without a report")
    if is_third_party(model):
        _refuse_unlike(f"family {model.family!r}", Path(saved))
    return Path(saved)


def _refuse_unlike(family: str, saved: Path) -> None:
    """Raise PluginError if no file was saved, or one that is not what its ending says."""
    file, wanted = staged(saved), ENDINGS.get(saved.suffix.lower())
    if not file.is_file():
        raise PluginError(f"{family}: save() returned {saved}, where it wrote no file")
    if wanted and (kind := kind_of(file)) != wanted:
        mend = "write what the ending says, as VanillaModel.save does, or refuse it in refuse_output()"
        raise PluginError(f"{family}: save() wrote a file of the type {kind} to {saved}, which other programs take for a {wanted}; {mend}")
    try:
        detect(file)
    except CheckpointError as error:
        mend = "give it the ending by which the family knows its files; its author may refuse other names in refuse_output()"
        raise PluginError(f"{family}: {saved} could not be read again, for no family recognizes what save() wrote under that name; {mend}") from error
