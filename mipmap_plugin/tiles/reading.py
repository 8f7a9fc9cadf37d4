"""The splats that are adapted in tiles, read once: examined, and left on the disk with their cut into cores, as all jobs need them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mipmap_plugin.errors import CheckpointError, SettingsError, plural, warn
from mipmap_plugin.formats.atomic import sha256
from mipmap_plugin.formats.here import typed
from mipmap_plugin.formats.ply_rows import PlyRows
from mipmap_plugin.formats.torch_file import save_torch
from mipmap_plugin.models import Checkpoint, detect
from mipmap_plugin.models.columns import DC, RGB, extra_names, has_bright_colors, second_colors
from mipmap_plugin.models.health import MIN_DISTRIBUTION, doubts, dropped, examine, refuse_few
from mipmap_plugin.models.reading import BLANK, blank_rows, refuse_blank
from mipmap_plugin.models.surfels import SurfelModel
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.tiles.cut import cut
from mipmap_plugin.tiles.folder import BASE, CUT, FEWEST
from mipmap_plugin.tiles.splats import CHUNK, Splats
from mipmap_plugin.tiles.store import Store, write_pieces

# The families whose splats lie in a PLY row by row, each the same for all views.
KINDS: dict[str, type[VanillaModel]] = {"3dgs": VanillaModel, "2dgs": SurfelModel}

# Splats from which is told what the scene needs of a backend, and from where a capture was photographed: of those, a thousand have to be visible.
SAMPLE = 8192


def find_splats(path: Path) -> tuple[Checkpoint, type[VanillaModel]]:
    """The checkpoint at `path`, and what reads its columns. Raises CheckpointError; SettingsError for a family that cannot be cut."""
    checkpoint = detect(path)
    kind = KINDS.get(checkpoint.family)
    if checkpoint.family in ("exchange", "gltf"):
        name, plain = checkpoint.path.name, checkpoint.path.with_name(checkpoint.path.name.split(".")[0] + "_plain.ply").name
        in_python = f"load_model({name!r}).save(Path({plain!r}), provenance={{}}) in Python"
        how = f"splat-transform {typed([name, plain])}" if checkpoint.family == "exchange" else in_python
        raise SettingsError(f"{checkpoint.path}: only a plain PLY is cut into tiles; convert it first ({how}), or leave --tiles out")
    if kind is None or checkpoint.path.suffix.lower() != ".ply":
        raise SettingsError(
            f"{checkpoint.path}: a checkpoint of {checkpoint.family} cannot be cut into tiles, only the PLY of 3DGS or 2DGS, whose splats are"
            " the same for all views and stand by themselves; leave --tiles out"
        )
    return checkpoint, kind


def make_cut(path: Path, tiles: int, folder: Path) -> None:
    """Read the splats at `path` once, and leave them and their cut into cores in `folder`, as all jobs need them. Raises CheckpointError."""
    checkpoint, kind = find_splats(path)
    rows = PlyRows(checkpoint.path)
    found = _Found()
    write_pieces(folder / BASE, len(rows), (found(kind, part, rows.path) for part in _read(rows)))
    splats = Splats.of(kind, [Store(folder / BASE)])
    blank, finite = torch.cat(found.blank), torch.cat(found.finite)
    refuse_blank(blank, checkpoint.path)
    refuse_few(~finite, checkpoint.path)
    valid = finite & ~blank
    kept = valid.nonzero()[:, 0]
    if len(kept) < tiles:
        advice = "leave --tiles out" if len(kept) < FEWEST else "give fewer"
        raise CheckpointError(f"{checkpoint.path} has {plural(len(kept), 'splat')}, which cannot be cut into {tiles} tiles; {advice}")
    cores, tree = cut(splats.places[:, :3], kept, tiles)  # without sizes, which are no places
    if not found.drawn:
        raise CheckpointError(f"{checkpoint.path}: every splat has an opacity below 1/255, so none is drawn; the training or the export failed")
    told = found.doubts(len(rows))
    for doubt in told:
        warn(f"{checkpoint.path}: {doubt}")
    left_out = {BLANK: blank, "not finite once activated": ~finite}
    told += [dropped(rows_out, "splat", why, checkpoint.path) for why, rows_out in left_out.items() if rows_out.any()]
    told += second_colors(rows.header.vertex.names)
    degree_at = found.degree_at if found.highest >= 0 else int(kept[0])
    sample = torch.cat([kept[:: -(-len(kept) // SAMPLE)], torch.tensor([degree_at])]).unique()
    places = torch.where(valid[:, None], splats.places, torch.nan)  # an invalid splat is seen by no camera
    stored = {"places": places, "cores": cores, "tree": tree, "sample": sample, "digest": sha256(checkpoint.path),
              "extras": [name for name in rows.header.vertex.names if name in found.extras], "doubts": told}  # fmt: skip
    save_torch(folder / CUT, stored, overwrite=True)


def _read(rows: PlyRows) -> Iterator[dict[str, Any]]:
    """The columns of a PLY, some rows at a time. Colors in place of harmonics are in 0..1 if they are floats: a dark part does not tell in what."""
    full = 255 if DC[0] not in rows.header.vertex.names and any(map(has_bright_colors, _parts(rows))) else 1
    for columns in _parts(rows):
        yield columns if full == 1 else {name: column / full if name in RGB else column for name, column in columns.items()}


def _parts(rows: PlyRows) -> Iterator[dict[str, Any]]:
    for start in range(0, len(rows), CHUNK):
        yield rows.columns(slice(start, start + CHUNK))
        rows.release()


class _Found:
    """Which splats are finite, which rows are blank, whether one is drawn, one with the highest SH band that is used, and columns that tiles lack."""

    def __init__(self) -> None:
        self.finite: list[Tensor] = []
        self.blank: list[Tensor] = []
        self.degree_at, self.highest, self.drawn = 0, -1, False
        self.rounded, self.step = 0, 0.0  # as of `Health`; the largest step
        self.looks: list[tuple[bool, bool]] = []  # whether scales look linear, and opacities activated, where so many splats say anything
        self.extras: set[str] = set()

    def __call__(self, kind: type[VanillaModel], columns: dict[str, Any], path: Path) -> dict[str, Tensor]:
        """Examine the next splats, and return their raw parameters."""
        parameters = kind.parameters_of(columns, path)
        self.extras.update(extra_names(columns))
        health = examine(kind(parameters))
        finite = ~health.invalid
        self.drawn |= health.invisible < health.splats
        self.rounded, self.step = self.rounded + health.rounded, max(self.step, health.step)
        used = (parameters["shN"].abs().amax(dim=2) > 0) & finite[:, None]
        if used.any():
            row, band = used.nonzero()[used.nonzero()[:, 1].argmax()].tolist()
            if band > self.highest:
                self.degree_at, self.highest = sum(map(len, self.finite)) + row, band
        self.finite.append(finite)
        self.blank.append(blank_rows(parameters))
        if health.splats >= MIN_DISTRIBUTION:
            self.looks.append((health.scales_look_linear, health.opacities_look_activated))
        return parameters

    def doubts(self, splats: int) -> list[str]:
        """As of `Health`, of all splats."""
        linear, activated = map(all, zip(*self.looks, strict=True)) if self.looks else (False, False)
        return doubts(splats, self.rounded, self.step, linear, activated)
