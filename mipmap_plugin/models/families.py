"""The built-in families: how each is recognized and loaded. A new family is one more record, here or in a package of its own."""

from __future__ import annotations

from collections.abc import Callable

from mipmap_plugin.errors import PluginError, with_article
from mipmap_plugin.formats.splat_transform import EXCHANGE
from mipmap_plugin.formats.tags import render_mode
from mipmap_plugin.formats.zipped import only_ply
from mipmap_plugin.models.anchors.companions import missing_networks
from mipmap_plugin.models.family import API_VERSION, BY_COMPANIONS, CERTAIN, PLAIN, Family, Files, Match
from mipmap_plugin.models.places import GSPLAT, NETWORKS, SPLATFACTO, is_coarse, network_of
from mipmap_plugin.models.refusals import ANCHOR_COLUMNS, FILTERED, FLAT_OR_FILTERED, OF_MORE_COLUMNS, REFUSED, family
from mipmap_plugin.registry import Registry

Recognize = Callable[[Files], Match | None]


def where(test: Callable[[Files], object], why: str, *, sure: float = CERTAIN) -> Recognize:
    """Recognize files that pass `test`."""
    return lambda files: Match(sure, why) if test(files) else None


def anchors(name: str) -> Recognize:
    """Recognize a PLY with the anchors of the family `name`."""
    return lambda files: Match(CERTAIN, "columns of anchors", lacks=_networks(files, name)) if _kind_of_anchors(files.columns) == name else None


def _kind_of_anchors(columns: frozenset[str]) -> str | None:
    """The family of an anchor PLY. HAC and its successors have masks. Octree-AnyGS has explicit anchors too, and its constants in the header."""
    if not ANCHOR_COLUMNS & columns:
        return None
    if "f_mask_0" in columns:
        return "hac"
    if "f_anchor_feat_0" not in columns or not columns & {"opacity", "nx"} or ("level" in columns and "info" not in columns):
        return "anygs"
    return "octree" if {"level", "extra_level", "info"} <= columns else "scaffold"


def _networks(files: Files, name: str) -> tuple[str, ...]:
    return tuple(missing_networks(files.path.parent)) if name in ("scaffold", "octree") else ()


def filtered(name: str) -> Recognize:
    """Recognize a PLY with a 3D filter by the options that its project saves, or by the provenance in a file written by this package."""

    def recognize(files: Files) -> Match | None:
        if "filter_3D" not in files.columns:
            return None
        written_as, options = files.provenance.get("family"), files.options
        if not options and written_as in FILTERED:
            project = written_as
        elif "use_decoupled_appearance" in options:
            project = "gof"
        else:
            project = "analytic" if "load_allres" in options and "kernel_size" not in options else "mip"
        return Match(CERTAIN, "column filter_3D, and what cfg_args says") if project == name else None

    return recognize


def _is_flat(files: Files) -> bool:
    return ({"scale_0", "scale_1", "rot_0"} <= files.columns and "scale_2" not in files.columns) or render_mode(files.comments) == "2dgs"


def hexplane(files: Files) -> Match | None:
    """Recognize 4D Gaussians."""
    if files.holds_splats and (is_coarse(files.path) or network_of(files.path, "4dgs").exists()):
        return Match(BY_COMPANIONS, "a deformation.pth beside it")
    return _lost_network(files, "4dgs")


def deformable(files: Files) -> Match | None:
    """Recognize Deformable 3D Gaussians."""
    if (nodes := _nodes_of_network(files)) is None:
        return _lost_network(files, "deformable")
    return None if nodes else Match(BY_COMPANIONS, "a deform.pth of its iteration")


def controlled(files: Files) -> Match | None:
    """Recognize SC-GS, whose network has control nodes."""
    if "fea_0" in files.columns:
        return Match(CERTAIN, "column fea_0")
    return Match(BY_COMPANIONS, "a deform.pth of its iteration, with nodes") if _nodes_of_network(files) else None


def _nodes_of_network(files: Files) -> bool | None:
    """Whether the deform.pth of the splats' iteration has the nodes of SC-GS; None if there is no such file."""
    network = network_of(files.path, "deformable")
    return bool(Files(network).words("nodes")) if files.holds_splats and files.folder and network.is_file() else None


def _lost_network(files: Files, family: str) -> Match | None:
    """Recognize splats without a network in a folder whose other iterations have one."""
    if not files.holds_splats or files.folder is None or not any(files.folder.glob(NETWORKS[family])):
        return None
    trouble = f"{files.path} lacks the network that moves its splats; copy it to {network_of(files.path, family)}, or choose another iteration"
    return Match(BY_COMPANIONS, "networks of other iterations", trouble)


LOADERS = "mipmap_plugin.models"

BUILT_IN = (
    family(
        "3dgs", "3D Gaussian splatting", where(lambda files: files.holds_splats, "columns of splats", sure=PLAIN),
        load=f"{LOADERS}.reading:load_vanilla",
    ),
    *(
        family(name, title, filtered(name), load=f"{LOADERS}.mip:load_mip", before=("2dgs",))
        for name, title in {"mip": "Mip-Splatting", "gof": "Gaussian Opacity Fields", "analytic": "Analytic-Splatting"}.items()
    ),
    family("2dgs", "2D Gaussian splatting", where(_is_flat, "two scales"), load=f"{LOADERS}.surfels:load_surfels"),
    family("scaffold", "Scaffold-GS", anchors("scaffold"), load=f"{LOADERS}.anchors.scaffold:load_scaffold", before=FLAT_OR_FILTERED),
    family("octree", "Octree-GS", anchors("octree"), load=f"{LOADERS}.anchors.octree:load_octree", before=FLAT_OR_FILTERED),
    family("deformable", "Deformable 3D Gaussians", deformable, load=f"{LOADERS}.moving.deformable:load_deformable"),
    family("4dgs", "4D Gaussians", hexplane, load=f"{LOADERS}.moving.hexplane:load_hexplane", before=("deformable", "sc-gs")),
    family(
        "gsplat", "gsplat", where(lambda files: files.strings("splats"), "holds splats"),  # as a key
        load=f"{LOADERS}.gsplat.model:load_gsplat", before=("splatfacto",), place=GSPLAT,
    ),
    family(
        "splatfacto", "splatfacto (nerfstudio)", where(lambda files: files.words("pipeline", "gauss_params"), "holds pipeline"),
        load=f"{LOADERS}.splatfacto:load_splatfacto", place=SPLATFACTO,
    ),
    family(
        "exchange", "exchange format (SPZ, SOG, KSPLAT, SPLAT, compressed PLY)",
        where(lambda files: files.kind in EXCHANGE or files.compressed, "its first bytes"),
        load=f"{LOADERS}.exchanged:load_exchanged", place=("", r"(lod-)?meta\.json"),
    ),
    family("gltf", "glTF (KHR_gaussian_splatting)", where(lambda files: files.kind == "glb", "its first bytes"), load=f"{LOADERS}.gltf:load_gltf"),
    family(
        "zipped", "PLY in a zip archive", where(lambda files: files.kind == "zip" and only_ply(files.path), "a zip archive of one PLY"),
        load=f"{LOADERS}.exchanged:load_zipped",
    ),
    # Recognized in order to be refused with a clear message.
    family(
        "anygs", "Octree-AnyGS", anchors("anygs"), before=FLAT_OR_FILTERED,
        not_loaded=": its anchors are drawn at offsets, in sizes and at levels of their own"
        " (or it is of Octree-GS before April 2024, not read either)",
    ),
    family(
        "hac", "HAC", anchors("hac"), before=FLAT_OR_FILTERED,
        not_loaded=": its networks and grids lie in checkpoint.pth (HAC++, ContextGS and others store theirs so too)",
    ),
    family("spacetime", "SpacetimeGaussians", where(lambda files: "trbf_center" in files.columns, "columns trbf_center"), before=OF_MORE_COLUMNS),
    family("sc-gs", "SC-GS", controlled, before=FLAT_OR_FILTERED),
    *REFUSED,
)  # fmt: skip

# All families by name; others are added by `register_model` and by the entry-point group.
FAMILIES = Registry("mipmap_plugin.models", {record.name: record for record in BUILT_IN})


def find_family(name: str) -> Family:
    """The family `name`. Raises SettingsError if it is unknown, PluginError if its target is not a valid Family of this API version."""
    record = FAMILIES.get(name)
    if not isinstance(record, Family):
        raise PluginError(f"family {name!r} is of type {type(record).__name__}; make it a mipmap_plugin.models.Family")
    if record.name != name:
        raise PluginError(f"family {name!r} calls itself {record.name!r}; register it under its own name")
    if not isinstance(record.before, tuple):
        raise PluginError(f"family {name!r}: `before` must be a tuple of names, got {record.before!r}")
    if record.saves is not None and not str(record.saves).startswith("."):
        raise PluginError(f"family {name!r}: `saves` must be the ending of a file's name, such as .ply, got {record.saves!r}")
    if record.api_version != API_VERSION:
        raise PluginError(f"family {name!r} is written for API version {record.api_version}, but this package has API version {API_VERSION}")
    return record


def not_loaded(name: str) -> str:
    """The message for a family that is recognized but not loaded."""
    record = find_family(name)
    message = f"this is {with_article(record.title)} checkpoint, a family that is recognized but not loaded by this version of mipmap_plugin"
    return message + record.not_loaded
