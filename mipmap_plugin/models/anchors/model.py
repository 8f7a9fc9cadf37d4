"""Anchor models: Scaffold-GS and its descendants. Splats exist only for a camera, decoded from the features of their anchors."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mipmap_plugin.camera import Camera, every_nth
from mipmap_plugin.effects import Effect
from mipmap_plugin.errors import ShapeError, plural
from mipmap_plugin.formats.atomic import together
from mipmap_plugin.formats.ply import write_ply
from mipmap_plugin.formats.splat_transform import refuse_ending
from mipmap_plugin.formats.tags import with_tags
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.models.anchors.decoding import Anchors, decode
from mipmap_plugin.models.anchors.files import AnchorFile, cfg_text, needs_views, refuse_others, to_columns, write_beside
from mipmap_plugin.models.anchors.networks import EMBEDDING, appearance_size, packed, refuse_infinite
from mipmap_plugin.models.anchors.prefilter import in_view
from mipmap_plugin.models.base import CARRIED, Traits
from mipmap_plugin.models.columns import QUATERNION
from mipmap_plugin.models.health import LARGEST
from mipmap_plugin.models.inria_folder import write_folder
from mipmap_plugin.models.outputs import finite, refuse_parts
from mipmap_plugin.models.raw import MIN_SCALE, moved
from mipmap_plugin.splatting.rotations import unit_quaternions

# Views sampled for the opacities of anchors, and for reshaping: the networks vary slowly with the direction.
OPACITY_VIEWS = 12
RESHAPE_VIEWS = 4


class AnchorModel(ABC):
    """N anchors with k splats each.

    Raw parameters: means [N, 3], which are never optimized; offsets [N, k, 3]; features [N, F]; scales [N, 6] log, of the offsets and of
    the splats; carried [N, C], constants. The networks are shared parameters. Parameters of a copy require gradients.
    """

    family: str
    _shrink_option = ""  # `Traits.shrink_option`

    def __init__(self, read: AnchorFile, inputs: Mapping[str, tuple[str, ...]]) -> None:
        """`inputs`: the inputs of each network, in order (`decoding.decode`)."""
        self._read, self._inputs = read, dict(inputs)
        self._parameters, self._weights = dict(read.parameters), read.weights
        self.source, self.folder, self.digest = read.origin.source, read.origin.folder, read.origin.digest
        self.trained = read.trained
        self.notes = [*read.notes, *self._layout_notes()]

    def __len__(self) -> int:
        return len(self._parameters["means"])

    @property
    def traits(self) -> Traits:
        no_viewer = "networks decode its splats for each camera, which none of the viewers does"
        return Traits(no_viewer=no_viewer, effects=self._effects(), rows="anchors", thins=True, shrink_option=self._shrink_option)

    def _effects(self) -> tuple[Effect, ...]:
        products = sum(tensor.numel() for name, tensor in self.shared_parameters().items() if tensor.dim() == 2 and not name.startswith("appearance"))
        size = appearance_size(self._weights)
        reason = f"the embedding has {size} numbers a training view" if size else "the model has no embedding"
        inputs = f"{size or ''} more inputs of the color network".strip()
        decoding = f"{products:,} multiplications an anchor in view, of {len(self):,}, for each image"
        return (
            Effect("view-dependent geometry", True, "splats are decoded from anchors for each camera", decoding),
            Effect("appearance embedding", size > 0, reason, inputs),
        )

    def gaussians(self, camera: Camera) -> Gaussians:
        """The splats of the anchors in view, activated: SH of degree 0, opacities above 0."""
        rows = (self._chosen(camera) & self._in_view(camera)).nonzero()[:, 0]
        return decode(self._anchors(rows, camera), self._weights, self._inputs, camera)[0]

    def parameters(self) -> dict[str, Tensor]:
        """The raw parameters by name, without copying them."""
        return dict(self._parameters)

    def shared_parameters(self) -> dict[str, Tensor]:
        """The weights of the networks and the appearance embedding, by dotted name."""
        return {f"{name}.{key}": tensor for name, state in self._weights.items() for key, tensor in state.items()}

    def copy(self) -> AnchorModel:
        """An independent model whose parameters are leaves that require gradients; it has no digest, because it may change."""
        other = self._map(lambda tensor: tensor.detach().clone().requires_grad_())
        other.digest = ""
        return other

    def to(self, device: torch.device | str) -> AnchorModel:
        """A copy on another device, which requires gradients where this one does."""
        return self._map(partial(moved, device=device))

    def replace_parameters(self, parameters: dict[str, Tensor]) -> None:
        """Use these tensors themselves as leaves, as an optimizer requires. Raises ShapeError."""
        for name, old in self._parameters.items():
            new = parameters.get(name)
            if new is None or new.shape[1:] != old.shape[1:] or len(new) != len(parameters["means"]):
                raise ShapeError(f"{name}: expected shape [N, {', '.join(map(str, old.shape[1:]))}], got {None if new is None else list(new.shape)}")
        leaves = {name: parameters[name] if parameters[name].is_leaf else parameters[name].detach() for name in self._parameters}
        self._parameters = {name: leaf.requires_grad_() for name, leaf in leaves.items()}

    @torch.no_grad()
    def reshape(self, form: Callable[[Gaussians], tuple[Tensor, Tensor]], views: Sequence[Camera]) -> None:
        """Scale each anchor's splats so that their variances along each axis, summed over a few of the `views`, are as `form` returns them.

        Sums, for a network that makes a splat flat for one view makes it round for the next: a mean of ratios would follow the flat
        one, whose least width is thousands of times its own. An anchor has no opacity of its own: those that `form` returns are left
        to the optimization.
        """
        needs_views(views)
        before, after = (torch.zeros_like(self._parameters["means"]) for _ in range(2))
        for view in every_nth(views, RESHAPE_VIEWS):
            splats, row = self._decode_all(view)
            for variances, scales in ((before, splats.scales), (after, form(splats)[0])):
                variances.index_add_(0, row, splats.opacities[:, None] * scales.clamp_min(MIN_SCALE).square())
        self._parameters["scales"][:, 3:] += torch.where(before > 0, after / before, 1.0).log() / 2

    def thin(self, keep: Tensor) -> None:
        """Leave out the anchors where `keep` [N] is False."""
        self.replace_parameters({name: tensor.detach()[keep] for name, tensor in self._parameters.items()})

    @torch.no_grad()
    def row_opacities(self, views: Sequence[Camera]) -> Tensor:
        """The largest opacity of any splat of each anchor, [N], over a sample of the `views`, including splats outside their images."""
        needs_views(views)
        most = torch.zeros_like(self._parameters["means"][:, 0])
        for view in every_nth(views, OPACITY_VIEWS):
            splats, row = self._decode_all(view)
            most.scatter_reduce_(0, row, splats.opacities, "amax")
        return most

    def save(self, path: str | Path, *, provenance: dict[str, Any], overwrite: bool = False) -> Path:
        """Write a PLY if `path` ends in .ply, else a model folder, with the networks beside the PLY; return the PLY written.

        Networks that did not change are copied byte for byte; others are written in the format they were read from. Raises
        OutputExists, and OutputError if a file cannot be written.
        """
        path, companions = Path(path), packed(self._weights, self._read.weights, self._read.companions)
        self.refuse_output(path, overwrite=overwrite)
        for name, state in self._weights.items():
            refuse_infinite(name, state)
        decoded = finite({name: tensor for name, tensor in self._parameters.items() if name != CARRIED}, LARGEST)
        columns = to_columns({**decoded, CARRIED: self._parameters[CARRIED]}, self._read, self._second_columns())
        comments = with_tags(self._read.origin.comments, self.trained.screen_filter, provenance)
        write = partial(write_ply, columns=columns, comments=comments)
        if path.suffix.lower() == ".ply":
            with together(path):
                write_beside(path, companions, self.source, overwrite)
                return write(path, overwrite=overwrite)

        def fill(ply: Path) -> None:
            write(ply)
            write_beside(ply, companions, None, overwrite=False)

        cfg_args = cfg_text(self.folder, path, self.trained, self._cfg_options())
        return write_folder(path, self.folder, cfg_args, self._read.origin.iteration, overwrite, fill)

    def refuse_output(self, path: Path, *, overwrite: bool, networks_move: bool = False) -> None:
        """Check `path` as `save` would. `networks_move`: the networks will change. Raises OutputExists, OutputError, SettingsError."""
        lone = path.suffix.lower() == ".ply"
        refuse_parts(path, overwrite, self.source, self.folder, None if lone else "point_cloud")
        if lone:
            refuse_ending(path)  # whose name may end in .compressed.ply
            companions = packed(self._weights, self._read.weights, self._read.companions)
            refuse_others(path, dict.fromkeys(companions, b"") if networks_move else companions, self.source, overwrite)

    def _chosen(self, camera: Camera) -> Tensor:
        """Which anchors exist for this camera, [N] bool; families with levels of detail override it."""
        return torch.ones_like(self._parameters["means"][:, 0], dtype=torch.bool)

    def _anchors(self, rows: Tensor | slice, camera: Camera | None) -> Anchors:
        """The anchors at `rows`; families with levels of detail add the levels. Without a camera no level fades."""
        raw = self._parameters
        return Anchors(raw["means"][rows], raw["offsets"][rows], raw["features"][rows], raw["scales"][rows])

    @abstractmethod
    def _second_columns(self) -> dict[str, np.ndarray]:
        """The columns that follow the position in the family's PLY."""

    def _cfg_options(self) -> dict[str, Any]:
        """Options for a model without cfg_args, from which the original builds these networks."""
        takes = {name: f"add_{name.removesuffix('_mlp')}_dist" for name in ("opacity_mlp", "cov_mlp", "color_mlp")}
        offsets, features = self._parameters["offsets"], self._parameters["features"]
        sizes = {"feat_dim": features.shape[1], "n_offsets": offsets.shape[1], "appearance_dim": appearance_size(self._weights)}
        distances = {option: "distance" in self._inputs[name] for name, option in takes.items()}
        return {**sizes, "use_feat_bank": "feature_bank_mlp" in self._weights, **distances}

    def _column(self, *names: str) -> Tensor:
        """The carried columns `names`, [N, len(names)]."""
        return self._parameters[CARRIED].detach()[:, [self._read.carried.index(name) for name in names]]

    def _in_view(self, camera: Camera) -> Tensor:
        raw = self._parameters
        return in_view(raw["means"].detach(), raw["scales"].detach()[:, :3].exp(), unit_quaternions(self._column(*QUATERNION)), camera)

    def _decode_all(self, camera: Camera) -> tuple[Gaussians, Tensor]:
        """The splats of all anchors, decoded for `camera`, and the anchor of each splat."""
        return decode(self._anchors(slice(None), None), self._weights, self._inputs, camera)

    def _layout_notes(self) -> list[str]:
        each = plural(self._parameters["offsets"].shape[1], "splat")
        notes = [f"{plural(len(self), 'anchor')} with {each} each, which are decoded for each camera"]
        for name, extra in {"distance": "the distance of the camera", "level": "the anchor's level"}.items():
            if takers := [network for network, taken in self._inputs.items() if name in taken]:
                notes.append(f"{extra} goes into {', '.join(takers)}")
        if "appearance" in self._weights:
            count = len(self._weights["appearance"][EMBEDDING])
            upstream = "its project gives the n-th test view the appearance of the n-th training view (evaluate --appearance upstream)"
            notes.append(f"it has an appearance for each of {plural(count, 'training view')}; any other camera gets their mean, where {upstream}")
        return notes

    def _map(self, change: Callable[[Tensor], Tensor]) -> AnchorModel:
        other = copy.copy(self)
        other._parameters = {name: change(tensor) for name, tensor in self._parameters.items()}
        other._weights = {name: {key: change(tensor) for key, tensor in state.items()} for name, state in self._weights.items()}
        other.notes = list(self.notes)
        return other
