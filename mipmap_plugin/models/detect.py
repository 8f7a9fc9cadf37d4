"""Which family a checkpoint belongs to, told from bytes, column names and companions."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.files import settled
from mipmap_plugin.models.anchor_networks import missing_networks
from mipmap_plugin.models.cfg_args import read_cfg_args
from mipmap_plugin.models.exchange import EXCHANGE
from mipmap_plugin.models.magic import kind_of, names_in_torch_file
from mipmap_plugin.models.ply import Header, read_header
from mipmap_plugin.models.tags import provenance_of, render_mode

# Every family that is recognized, loaded or not, by the name that `register_model` takes.
FAMILIES = {
    "3dgs": "3D Gaussian splatting",
    "mip": "Mip-Splatting",
    "gof": "Gaussian Opacity Fields",
    "analytic": "Analytic-Splatting",
    "2dgs": "2D Gaussian splatting",
    "scaffold": "Scaffold-GS",
    "octree": "Octree-GS",
    "anygs": "Octree-AnyGS",
    "hac": "HAC",
    "deformable": "Deformable 3D Gaussians",
    "sc-gs": "SC-GS",
    "4dgs": "4D Gaussians",
    "spacetime": "SpacetimeGaussians",
    "gsplat": "gsplat",
    "splatfacto": "splatfacto (nerfstudio)",
    "exchange": "exchange format (SPZ, SOG, KSPLAT, SPLAT, compressed PLY)",
}

# What more is to be said of families that are not loaded.
NOT_LOADED = {
    "anygs": ": its anchors are drawn at offsets, in sizes and at levels of their own (or it is of Octree-GS before April 2024, not read either)",
    "hac": ": its networks and grids lie in checkpoint.pth (HAC++, ContextGS and others store theirs so too)",
}

# The files in the result folders of projects that save with torch: the folder they lie in, and their names.
GSPLAT_FILE = r"ckpt_(?P<step>\d+)(?:_rank(?P<rank>\d+))?\.pt"
RESULTS = {"gsplat": ("ckpts", GSPLAT_FILE), "splatfacto": ("nerfstudio_models", r"step-(?P<step>\d+)\.ckpt")}


# What the optimizer of fudan-zvg's 4D Gaussian Splatting names, and no other's; that project saves no PLY.
FUDAN = ("scaling_t", "rotation_r")


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint that was found."""

    family: str  # a key of FAMILIES
    path: Path  # the file that holds the splats
    folder: Path | None = None  # the model folder around it
    iteration: int | None = None
    notes: tuple[str, ...] = ()  # what was passed over, in sentences


def detect(path: str | Path, *, iteration: int | None = None) -> Checkpoint:
    """Find the splats at `path`, a file or a model folder, and name their family.

    Of a folder, the newest `iteration_<N>` whose PLY is whole is taken, or the one asked for.
    Raises CheckpointError for what is missing, damaged, or not a checkpoint.
    """
    path = settled(Path(path))
    if path.is_dir():
        return _detect_folder(path, iteration)
    if not path.exists():
        raise CheckpointError(f"{path} does not exist; give a PLY file or a model folder")
    if iteration is not None:
        raise CheckpointError(f"{path} is a file and has no iterations; give its model folder to choose iteration {iteration}")
    kind = kind_of(path)
    if kind == "torch":
        return _detect_torch_file(path)
    if kind in EXCHANGE:
        return Checkpoint("exchange", path)
    if kind != "ply":
        raise CheckpointError(_why_not(path, kind))
    return _detect_ply(path)


def exchange_kind(file: Path) -> str | None:
    """Which exchange format a file is in, a key of `exchange.EXCHANGE`; None for another. Raises CheckpointError."""
    kind = kind_of(file)
    return kind if kind in EXCHANGE else "compressed" if kind == "ply" and _is_compressed(read_header(file)) else None


def _is_compressed(header: Header) -> bool:
    return any("packed_position" in element.names for element in header.elements)


def not_loaded(family: str) -> str:
    """The sentence for a family that is recognized, but that nothing is registered for."""
    told = f"this is a {FAMILIES.get(family, family)} checkpoint, a family that is recognized but not loaded by this version of mipmap_plugin"
    return told + NOT_LOADED.get(family, "")


def _detect_torch_file(path: Path) -> Checkpoint:
    family, place = _family_of_torch_file(path), path.absolute().parent
    return Checkpoint(family, path, place.parent if place.name == RESULTS[family][0] else None)


def _detect_ply(path: Path) -> Checkpoint:
    header = read_header(path)
    if _is_compressed(header):
        return Checkpoint("exchange", path)
    folder, iteration = _around(path)
    return Checkpoint(_family(path, header, folder), path, folder, iteration)


def _around(ply: Path) -> tuple[Path | None, int | None]:
    """The model folder and iteration of `<folder>/point_cloud/iteration_<N>/point_cloud.ply`."""
    place = ply.absolute().parent
    number = re.fullmatch(r"(?:coarse_)?iteration_(\d+)", place.name)
    if number and place.parent.name == "point_cloud":
        return place.parent.parent, int(number[1])
    return (place if (place / "cfg_args").is_file() else None), None


def _family(path: Path, header: Header, folder: Path | None) -> str:
    """By columns first, then by companions: a dynamic scene's own PLY looks like plain 3DGS."""
    names = set(header.vertex.names)
    if {"f_offset_0", "f_anchor_feat_0"} & names:
        return _family_of_anchors(names)
    _refuse_other_columns(path, names)
    for column, family in {"trbf_center": "spacetime", "fea_0": "sc-gs"}.items():
        if column in names:
            return family
    if "filter_3D" in names:
        return _family_of_filter_3d(folder, (provenance_of(header.comments) or {}).get("family"))
    if ({"scale_0", "scale_1", "rot_0"} <= names and "scale_2" not in names) or render_mode(header.comments) == "2dgs":
        return "2dgs"
    if not {"opacity", "scale_0", "rot_0"} <= names:
        columns = ", ".join(header.vertex.names[:8])
        raise CheckpointError(f"{path} is a plain point cloud or a mesh (columns {columns}), not Gaussian splats; give a trained model")
    return _family_of_companions(path, folder)


def _family_of_anchors(names: set[str]) -> str:
    """HAC and what follows it have masks. Octree-AnyGS has explicit anchors too, and keeps its constants in the header, not in `info`."""
    if "f_mask_0" in names:
        return "hac"
    if "f_anchor_feat_0" not in names or not names & {"opacity", "nx"} or ("level" in names and "info" not in names):
        return "anygs"
    return "octree" if {"level", "extra_level", "info"} <= names else "scaffold"


def _refuse_other_columns(path: Path, names: set[str]) -> None:
    """Columns that make another thing of those of 3DGS. Raises CheckpointError."""
    if "scale_3" in names:
        raise CheckpointError(f"{path} has the column scale_3, which no splats have: it holds anchors or another model; give what it exports")
    if {"opacity1", "opacity2"} <= names:
        raise CheckpointError(f"{path} holds half-Gaussians (3D-HGS), whose two halves have opacities of their own, which are not read here")
    if "f_0" in names and "f_dc_0" not in names and "opacity" in names:
        raise CheckpointError(f"{path} holds features without colors (SAGA); give the scene_point_cloud.ply of its training")


def network_of(ply: Path, family: str) -> Path:
    """Where the network of a moving scene lies: the one of the same iteration, for any other moves other splats."""
    place = ply.absolute().parent
    return place / "deformation.pth" if family == "4dgs" else place.parent.parent / "deform" / place.name / "deform.pth"


def is_coarse(ply: Path) -> bool:
    """Whether it is of the first stage of 4D Gaussians, in which nothing moves yet."""
    return ply.absolute().parent.name.startswith("coarse_iteration_")


def _family_of_companions(ply: Path, folder: Path | None) -> str:
    if is_coarse(ply) or network_of(ply, "4dgs").exists():
        return "4dgs"
    for family, pattern in {"4dgs": "point_cloud/*iteration_*/deformation.pth", "deformable": "deform/iteration_*/deform.pth"}.items():
        if folder is not None and any(folder.glob(pattern)):
            return _family_of_network(ply, family)
    return "3dgs"


def _family_of_network(ply: Path, family: str) -> str:
    network = network_of(ply, family)
    if not network.is_file():
        raise CheckpointError(f"{ply} lacks the network that moves its splats; copy it to {network}, or choose another iteration")
    return "sc-gs" if family == "deformable" and "nodes" in names_in_torch_file(network, ("nodes",)) else family


def _family_of_filter_3d(folder: Path | None, told: Any) -> str:
    """By the options that each saves; a bare file that was written here tells its family."""
    options: dict[str, Any] = read_cfg_args(folder / "cfg_args") if folder and (folder / "cfg_args").is_file() else {}
    if not options and told in ("mip", "gof", "analytic"):
        return told
    if "use_decoupled_appearance" in options:
        return "gof"
    return "analytic" if "load_allres" in options and "kernel_size" not in options else "mip"


def _family_of_torch_file(path: Path) -> str:
    networks = {"linear.0.weight", "nodes", "deformation_net"}
    found = names_in_torch_file(path, ("splats", "pipeline", "gauss_params", "param_groups", *FUDAN, *networks))
    if "splats" in found:
        return "gsplat"
    if found & {"pipeline", "gauss_params"}:
        return "splatfacto"
    if set(FUDAN) <= found:
        raise CheckpointError(f"{path} is of 4D Gaussian Splatting (fudan-zvg), whose splats have a time of their own, which is not read here")
    if "param_groups" in found:
        raise CheckpointError(f"{path} is the state of a training run; give the point_cloud.ply or the model folder that was saved beside it")
    if found & networks:
        raise CheckpointError(f"{path} is a deformation network without its splats; give the model folder that holds both")
    raise CheckpointError(f"{path} is a torch file that holds no known checkpoint; give a PLY file or a model folder")


def _why_not(path: Path, kind: str) -> str:
    if path.suffix == ".hier":
        chunk = "the PLY of one of its chunks (trained_chunks/<name>/point_cloud/iteration_<N>)"
        return f"{path} is a hierarchy of Hierarchical 3D Gaussians, whose splats follow the distance, which is not read here; give {chunk}"
    return {
        "gsplat-png": f"{path} lists the pictures of gsplat's PngCompression, which are quantized; give the ckpts/ckpt_*.pt that they were made from",
        "glb": f"{path} is glTF, which is not read here, nor by splat-transform; export a PLY from the program that made it",
        "torchscript": f"{path} is a TorchScript network, one companion of an anchor model; give the model folder that holds its point_cloud.ply",
        "zip": f"{path} is a zip archive; unpack it and give the PLY or the folder in it",
        "gzip": f"{path} is a gzip file; unpack it first",
    }.get(kind, f"{path} is no checkpoint that is known here; give a PLY file or a model folder")


def _detect_folder(folder: Path, iteration: int | None) -> Checkpoint:
    if (folder / "point_cloud").is_dir():
        return _detect_iteration(folder, iteration)
    for family, (place, pattern) in RESULTS.items():
        if steps := _steps(folder / place, pattern):
            return _detect_step(family, folder, steps, iteration)
    if iteration is not None:
        raise CheckpointError(f"{folder} has no point_cloud/iteration_{iteration}; give the model folder above it, or no iteration")
    for name in ("meta.json", "lod-meta.json"):
        if (folder / name).is_file() and (kind := kind_of(folder / name)) in ("sog", "gsplat-png"):
            if kind == "sog":
                return Checkpoint("exchange", folder / name)
            raise CheckpointError(_why_not(folder / name, kind))
    clouds = sorted(folder.glob("*.ply"))
    if len(clouds) > 1 and folder / "point_cloud.ply" in clouds:
        clouds = [folder / "point_cloud.ply"]
    if len(clouds) == 1:
        return detect(clouds[0])
    told = f"{len(clouds)} PLY files ({', '.join(c.name for c in clouds[:5])})" if clouds else "no point_cloud folder and no PLY file"
    raise CheckpointError(f"{folder} holds {told}; give one PLY file, or a model folder with point_cloud/iteration_<N>")


def _detect_iteration(folder: Path, wanted: int | None) -> Checkpoint:
    """The newest iteration that is whole. What is passed over on the way is noted."""
    entries = {int(m[1]): entry for entry in (folder / "point_cloud").iterdir() if (m := re.fullmatch(r"iteration_(\d+)", entry.name))}
    if not entries:
        raise CheckpointError(f"{folder / 'point_cloud'} holds no iteration_<N> folder; give the PLY file itself")
    if wanted is not None and wanted not in entries:
        raise CheckpointError(f"{folder / 'point_cloud'} has no iteration_{wanted}; it has {', '.join(map(str, sorted(entries)))}")
    troubles: list[str] = []
    for number in [wanted] if wanted is not None else sorted(entries, reverse=True):
        ply = entries[number] / "point_cloud.ply"
        try:
            if not ply.exists() and (scene := ply.with_name("scene_point_cloud.ply")).exists():
                raise CheckpointError(f"{entries[number]} is of SAGA; give the PLY of its scene itself: {scene}")
            found = detect(ply)
            _refuse_incomplete(found)
            return Checkpoint(found.family, ply, folder, number, tuple(f"iteration_{number} is taken, since {trouble}" for trouble in troubles))
        except CheckpointError as error:
            troubles.append(str(error))
    raise CheckpointError(f"{folder} has no whole checkpoint: {'; '.join(troubles)}")


def _steps(folder: Path, pattern: str) -> dict[int, Path]:
    """The checkpoints of a training by their steps; of several ranks the first."""
    files = sorted(folder.iterdir(), reverse=True) if folder.is_dir() else []
    return {int(name["step"]): file for file in files if (name := re.fullmatch(pattern, file.name))}


def _detect_step(family: str, folder: Path, steps: dict[int, Path], wanted: int | None) -> Checkpoint:
    step = max(steps) if wanted is None else wanted
    if step not in steps:
        raise CheckpointError(f"{folder} has no checkpoint of step {step}; it has {', '.join(map(str, sorted(steps)))}")
    return Checkpoint(family, steps[step], folder, step)


def _refuse_incomplete(found: Checkpoint) -> None:
    """A copy is often of the PLY alone; then an older iteration may still be whole."""
    missing = missing_networks(found.path.parent) if found.family in ("scaffold", "octree") else []
    if missing:
        raise CheckpointError(f"{found.path.parent} is an incomplete checkpoint, without {', '.join(missing)}")
