"""Families whose files are recognized in order to be refused with a clear message: what they are, and what to give in their place."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.cfg_args import read_cfg_args_and_rest
from mipmap_plugin.models.family import API_VERSION, BY_COMPANIONS, CERTAIN, OF_SPLATS, Family, Files, Match

# Names that only the optimizer of fudan-zvg's 4D Gaussian Splatting has; that project saves no PLY.
FUDAN = ("scaling_t", "rotation_r")

# Names of parameters in the checkpoints of nv-tlabs/3dgrut.
GRUT = ("features_albedo", "density")

# Columns of splats whose colors are computed elsewhere: of Spec-Gaussian, 3DGS-DR and Gaussian in the Wild; and the two of GaussianShader.
SHADED, OF_SHADER = {"f_asg_0", "refl", "f_intr_0"}, {"roughness", "specular0"}

# Options that only EVER saves.
EVER = {"max_opacity", "tmin"}

# What Compact3D (UCDvision) leaves to its codebooks. Its script writes the whole beside them.
CODEBOOKS, IN_CODEBOOKS, DECOMPRESSED = "kmeans_centers.pth", OF_SPLATS | {"f_dc_0", "f_rest_0"}, "point_cloud_decompressed.ply"

ANCHOR_COLUMNS = {"f_offset_0", "f_anchor_feat_0"}
FILTERED = ("mip", "gof", "analytic")
FLAT_OR_FILTERED = (*FILTERED, "2dgs")
OF_MORE_COLUMNS = ("sc-gs", *FLAT_OR_FILTERED)

family = partial(Family, api_version=API_VERSION)


def refused(name: str, title: str, test: Callable[[Files], object], why: str, trouble: str, *, sure: float = CERTAIN, **facts: Any) -> Family:
    """A family whose files, which pass `test`, are refused in a sentence: their path and `trouble`. `facts`: further ones of `Family`."""
    return family(name, title, lambda files: Match(sure, why, f"{files.path} {trouble}") if test(files) else None, **facts)


def part_of_scene(files: Files) -> Match | None:
    """Recognize one of several files of Grendel-GS, each of which has some splats of the scene; a scene in one file is named so, too."""
    found = re.search(r"_rk\d+(_ws(\d+)\.ply)$", files.path.name)
    if found is None or int(found[2]) == 1 or not files.holds_splats:
        return None
    pattern = f"{files.path.name[: found.start()]}_rk*{found[1]}"
    why = f"has some of the splats, and the others are in {pattern}, {found[2]} files in all (Grendel-GS)"
    return Match(CERTAIN, "its name", f"{files.path} {why}; join them: splat-transform {pattern} joined.ply")


def _is_shaded(files: Files) -> bool:
    return files.holds_splats and bool(SHADED & files.columns or files.columns >= OF_SHADER)


def _left_to_codebooks(files: Files) -> bool:
    """Whether a PLY of Compact3D lacks columns that are in the codebooks beside it."""
    beside = files.path.name != DECOMPRESSED and (files.path.parent / CODEBOOKS).is_file()
    return beside and bool(files.columns) and not files.columns >= IN_CODEBOOKS


def _is_of_ever(files: Files) -> bool:
    if not (files.holds_splats and files.folder and (files.folder / "cfg_args").is_file()):
        return False
    try:
        return read_cfg_args_and_rest(files.folder / "cfg_args")[0].keys() >= EVER
    except CheckpointError:  # whoever loads it says so
        return False


def _is_of_e_d3dgs(files: Files) -> bool:
    """Other tools may call features so, but have no network beside them that moves splats."""
    return files.holds_splats and "embedding_0" in files.columns and (files.path.parent / "deformation.pth").is_file()


REFUSED = (
    family("part", "Grendel-GS", part_of_scene, before=OF_MORE_COLUMNS),
    refused(
        "many-scales", "another model", lambda files: "scale_3" in files.columns and not ANCHOR_COLUMNS & files.columns, "column scale_3",
        "has the column scale_3, which no splats have: it holds anchors or another model; give what it exports",
        before=("spacetime", *OF_MORE_COLUMNS),
    ),
    refused(
        "3d-hgs", "3D-HGS", lambda files: {"opacity1", "opacity2"} <= files.columns, "columns opacity1, opacity2",
        "holds half-Gaussians (3D-HGS), whose two halves have opacities of their own, which are not read here",
        before=("many-scales", "spacetime", *OF_MORE_COLUMNS),
    ),
    refused(
        "saga", "SAGA", lambda files: {"f_0", "opacity"} <= files.columns and "f_dc_0" not in files.columns, "features without colors",
        "holds features without colors (SAGA); give the scene_point_cloud.ply of its training",
        before=("spacetime", *OF_MORE_COLUMNS),
    ),
    refused(
        "shaded", "splats that are shaded", _is_shaded, "columns of materials",
        "has colors that a network or an environment map beside it makes or completes (as of Spec-Gaussian, GaussianShader, 3DGS-DR, GS-W),"
        " which is not read here; give a training of 3DGS", before=OF_MORE_COLUMNS,
    ),
    refused(
        "bound", "GaussianAvatars", lambda files: files.holds_splats and "binding_0" in files.columns, "column binding_0",
        "holds splats that are bound to the triangles of a mesh and lie in their frames (GaussianAvatars), which is not read here",
        before=OF_MORE_COLUMNS,
    ),
    refused(
        "student", "Student Splatting and Scooping", lambda files: files.holds_splats and {"degree", "negative"} <= files.columns,
        "columns degree, negative", "is of Student Splatting and Scooping, whose kernels are no Gaussians, which is not read here",
    ),
    refused(
        "ever", "EVER", _is_of_ever, "what cfg_args says",
        "is of EVER, whose ellipsoids are no Gaussians and are stored in another way, which is not read here", sure=BY_COMPANIONS,
    ),
    refused(
        "e-d3dgs", "E-D3DGS", _is_of_e_d3dgs, "column embedding_0 and a network beside it",
        "is of E-D3DGS, whose network moves splats by embeddings of their own, which is not read here", before=("4dgs", *OF_MORE_COLUMNS),
    ),
    refused(
        "compact3d", "Compact3D", _left_to_codebooks, f"a {CODEBOOKS} beside it",
        f"leaves columns to the {CODEBOOKS} beside it (Compact3D), which is not read here; run its decompress_to_ply.py, and give {DECOMPRESSED}",
        sure=BY_COMPANIONS,
    ),
    refused(
        "gsplat-png", "gsplat's PngCompression", lambda files: files.kind == "gsplat-png", "a meta.json of pictures",
        "lists the pictures of gsplat's PngCompression, which are quantized; give the ckpts/ckpt_*.pt that they were made from",
        place=("", r"meta\.json"),
    ),
    refused(
        "beta", "Deformable Beta Splatting", lambda files: {"beta", "sh0_0"} <= files.columns, "columns beta, sh0_0",
        "is of Deformable Beta Splatting, whose kernels are no Gaussians, which is not read here",
    ),
    refused(
        "3dgrut", "3DGRUT", lambda files: files.words(*GRUT) == set(GRUT), "its parameters' names",
        "is of 3DGRUT, whose checkpoints are not read here; give the PLY that it exports (export_ply.enabled=true)",
    ),
    refused(
        "fudan", "4D Gaussian Splatting (fudan-zvg)", lambda files: files.words(*FUDAN) == set(FUDAN), "its optimizer's names",
        "is of 4D Gaussian Splatting (fudan-zvg), whose splats have a time of their own, which is not read here", sure=BY_COMPANIONS,
    ),
    refused(
        "training", "a training run", lambda files: files.words("param_groups"), "holds param_groups",
        "is the state of a training run; give the point_cloud.ply or the model folder that was saved beside it", sure=0.3,
    ),
    refused(
        "network", "a deformation network", lambda files: files.words("linear.0.weight", "nodes", "deformation_net"), "holds linear.0.weight",
        "is a deformation network without its splats; give the model folder that holds both", sure=0.2,
    ),
)  # fmt: skip
