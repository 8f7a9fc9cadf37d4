"""Files made for a viewer: adapted as it draws, and named after it."""

import gc
import weakref
from pathlib import Path
from unittest.mock import Mock

import anchor_checkpoints
import moving
import numpy as np
import pytest
import tiny
import torch

from mipmap_plugin.cli import main
from mipmap_plugin.commands.adapt import _made_for
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.ply import read_ply
from mipmap_plugin.formats.tags import provenance_of
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.loaders import for_loader_of
from mipmap_plugin.models.surfels import SurfelModel, flat_trained, flattened
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.process.garbage import uncollected
from mipmap_plugin.wrap import wrap_model

BRIEF = dict(steps=2, extra_views=2, merge_to=1.0, warm_up=0)


def write_flat(path):
    """A model folder of 2DGS."""
    splats = VanillaModel.from_gaussians(flattened(tiny.gaussians(40))).parameters()
    return SurfelModel(splats, flat_trained(TrainedScale())).save(path, provenance={}).parents[2]


def wrapped(**trained):
    return wrap_model(tiny.model(40, TrainedScale(**trained)), cameras=tiny.cameras())


@pytest.mark.parametrize("viewer", ["spark", "playcanvas"])
def test_an_adapted_model_is_drawn_as_its_viewer_does(viewer):
    model = wrapped()
    adapted = model.adapt(1 / 4, viewer=viewer, **BRIEF)
    assert adapted.effects == model.effects(viewer=viewer) != model.effects()
    assert (adapted.model.trained.screen_filter, adapted.model.trained.eps2d) == (adapted.effects.screen_filter, adapted.effects.eps2d)


# By the near plane of a base's training, a viewer that draws from another depth on.
OTHER_NEAR = {0.2: "gsplat", 0.01: "classic"}


@pytest.mark.parametrize(("near", "viewer"), OTHER_NEAR.items())
@pytest.mark.parametrize("scale", [1 / 2, 1])
def test_a_viewer_that_differs_in_its_near_plane_alone_changes_nothing_where_no_splat_is_near(near, viewer, scale):
    model = wrapped(near_plane=near)
    plain, file = (model.adapt(scale, viewer=name, **BRIEF) for name in (None, viewer))
    assert (file.report.viewer, file.report.returned) == (viewer, plain.report.returned)
    assert all(torch.equal(tensor, plain.model.parameters()[name]) for name, tensor in file.model.parameters().items())
    assert ("as it is" in file.report.returned) == (scale == 1)


def test_gsplat_draws_the_bands_of_degree_4_that_it_trained():
    model = wrap_model(tiny.model(40, TrainedScale(near_plane=0.01), degree=4), cameras=tiny.cameras())
    assert model.effects().sh_degree == 4 and model.target("gsplat") == model.effects()
    assert (model.effects(viewer="babylon").sh_degree, model.effects(viewer="classic").sh_degree) == (4, 3)


@pytest.mark.parametrize(("near", "viewer"), OTHER_NEAR.items())
def test_it_is_another_renderer_where_a_view_shows_a_splat_between_both_near_planes(near, viewer):
    views, trained = tiny.cameras(), TrainedScale(near_plane=near)
    close, beside = (views[2].center + depth @ views[2].viewmat[:3, :3] for depth in torch.tensor([[0, 0, 0.1], [9, 0, 0.1]], dtype=torch.float64))
    for point, drawn in ((close, True), (beside, False)):
        splats = tiny.gaussians(40)
        splats.means[0], splats.scales[0] = point, 0.005
        model = wrap_model(VanillaModel.from_gaussians(splats, trained), cameras=views)
        assert (model.target(viewer) == model.effects(viewer=viewer)) == drawn
        assert (model.target(viewer) == model.effects()) != drawn
        assert model.targets(viewer, views[:2])[viewer] == model.effects()


def test_splats_are_activated_once_for_all_views_that_near_planes_are_looked_at_from(monkeypatch):
    """A million of them take longer than what is drawn of them: half a minute for 300 views."""
    views, splats, asked = tiny.cameras(6), tiny.gaussians(40), []
    beside = torch.tensor([9, 0, 0.1], dtype=torch.float64)
    splats.means[:6] = torch.stack([view.center + beside @ view.viewmat[:3, :3] for view in views])
    model = wrap_model(VanillaModel.from_gaussians(splats, TrainedScale()), cameras=views)
    model.effects()  # which looks at the splats, too
    gaussians = model.model.gaussians
    monkeypatch.setattr(model.model, "gaussians", lambda view: asked.append(view) or gaussians(view))
    assert model.target("gsplat") == model.effects() and len(asked) == 1


def test_a_base_whose_near_planes_were_looked_at_is_freed_at_once():
    model = wrapped()
    gc.collect()
    assert model.target("gsplat") == model.effects()
    freed = weakref.ref(model)
    with uncollected():
        del model
        assert freed() is None


def test_files_of_a_family_that_keeps_its_filter_are_for_no_viewer():
    with pytest.raises(SettingsError, match="3dgs: it says that its files are for its own project alone; leave the viewer spark out"):
        wrapped(keeps_filter=True).adapt(1 / 4, viewer="spark")


WRITERS = {"2dgs": write_flat, "scaffold": anchor_checkpoints.write, "deformable": moving.write_deformable, "4dgs": moving.write_hexplane}


@pytest.mark.parametrize(
    ("family", "why"),
    [
        ("2dgs", "its splats are flat (2DGS), which none of the viewers draws"),
        ("scaffold", "networks decode its splats for each camera, which none of the viewers does"),
        ("deformable", "a network moves its splats, which none of the viewers supports"),
        ("4dgs", "a network moves its splats, which none of the viewers supports"),
    ],
)
def test_what_no_viewer_draws_is_refused_before_any_work_and_inspect_says_why(tmp_path, capsys, family, why):
    base = WRITERS[family](tmp_path / "base")
    assert main(["adapt", str(base), "--scale", "1", "--viewer", "spark"]) == 2
    assert f"{family}: {why}; leave the viewer spark out" in capsys.readouterr().err
    assert main(["inspect", str(base)]) == 0
    assert f"not drawn: {why}" in capsys.readouterr().out
    assert not (tmp_path / "base_x1_spark").exists()


@pytest.mark.parametrize("viewer", ["spark", "playcanvas"])
def test_at_scale_one_a_viewer_comes_closer_to_the_bases_own_picture(viewer):
    model = wrapped()
    adapted = model.adapt(1, viewer=viewer, steps=10, extra_views=8)
    for camera in tiny.cameras(3, seed=9):  # that nothing was adapted to
        own, naive, new = model.render(camera).image, model.render(camera, viewer=viewer).image, adapted.render(camera).image
        assert psnr(new, own) > psnr(naive, own) + 1


def test_the_command_writes_a_file_for_each_viewer_and_says_what_it_holds(tmp_path, capsys):
    base = tiny.folder(tmp_path / "base", tiny.cameras(3))
    words = ["adapt", base, "--scale", "1/4", "--viewer", "spark", "--viewer", "playcanvas", "--steps", "2", "--views", "given"]
    assert main([*map(str, words), "--log", str(tmp_path / "log")]) == 0
    out, log = capsys.readouterr().out, (tmp_path / "log").read_text()
    for viewer in ("spark", "playcanvas"):
        ply = tmp_path / f"base_x0.25_{viewer}" / "point_cloud/iteration_30000/point_cloud.ply"
        assert provenance_of(read_ply(ply).comments)["viewer"] == viewer
        assert f"x0.25 in {viewer}: " in out and f"{ply}, made for {viewer}\n" in out
    assert log.count("  holds the ") == log.count("(dB on views that nothing was adapted to: the base as it is ") == 2
    assert "give --viewer" not in out


def test_the_command_says_whom_a_file_without_a_viewer_is_for(tmp_path, capsys):
    words = ["adapt", tiny.folder(tmp_path / "base", tiny.cameras(3)), "--scale", "1/4", "--recipe", "instant"]
    assert main([str(word) for word in words]) == 0
    renderers = "made for renderers that draw as 3DGS does (INRIA, and gsplat and nerfstudio where no splat is nearer than 0.2 units)"
    assert f"{renderers}; for others give --viewer spark" in capsys.readouterr().out


def test_a_file_of_a_third_party_format_is_for_its_own_project():
    theirs = type("Theirs", (VanillaModel,), {"__module__": "theirs"})(tiny.model(3).parameters())
    assert _made_for(Mock(viewer=None), theirs, Path("a.npz")).startswith("made for its own project; for others give --viewer")
    assert "draw as 3DGS does" in _made_for(Mock(viewer=None), theirs, Path("a.ply"))


def test_a_file_of_a_base_that_gsplat_trained_is_for_inria_s_viewer_too_if_nothing_is_near():
    said = _made_for(Mock(viewer=None), tiny.model(3, TrainedScale(near_plane=0.01)), Path("a.ply"))
    assert "3DGS does (gsplat, nerfstudio, and INRIA where no splat is nearer than 0.2 units)" in said


# By its source, the SH degree of the file for each loader: that of the splats, unless it reads only others right.
WRITTEN_DEGREES = {
    "unity": (0, 3, 3, 3, 3), "gdgs": (3, 3, 3, 3, 3), "3dgs.cpp": (3, 3, 3, 3, 3), "kiri": (1, 1, 2, 3, 3), "spark": (0, 1, 2, 3, 3),
    "supersplat": (0, 1, 2, 3, 3), "portable": (0, 3, 3, 3, 3), "brush": (0, 1, 2, 3, 4), "classic": (0, 1, 2, 3, 4), None: (0, 1, 2, 3, 4),
}  # fmt: skip


@pytest.mark.parametrize("viewer", WRITTEN_DEGREES)
@pytest.mark.parametrize("degree", range(5))
def test_a_file_has_the_sh_bands_that_the_loader_of_its_viewer_reads(tmp_path, viewer, degree):
    model, each = tiny.model(5).with_degree(degree), (degree + 1) ** 2 - 1
    columns = read_ply(for_loader_of(viewer, model, tmp_path / "a.ply").save(tmp_path / "a.ply", provenance={})).columns
    count = sum(name.startswith("f_rest_") for name in columns) // 3
    assert count == (WRITTEN_DEGREES[viewer][degree] + 1) ** 2 - 1
    rest = torch.zeros(5, max(count, each), 3)
    rest[:, :each] = model.parameters()["shN"]
    written = [columns[f"f_rest_{channel * count + number}"].tolist() for number in range(count) for channel in range(3)]
    assert written == rest[:, :count].flatten(1).T.tolist()


def test_bands_that_the_loader_of_a_viewer_does_not_read_are_told_of(tmp_path):
    model = wrap_model(tiny.model(40).with_degree(4), cameras=tiny.cameras())
    adapted = model.adapt(1 / 4, viewer="spark", recipe="instant")
    lost = "SH bands above degree 3 are left out, which loaders of spark do not read right"
    with pytest.warns(UserWarning, match=lost):
        file = adapted.save(tmp_path / "a.ply")
    assert lost in adapted.report_of(file).notes and lost not in adapted.report_of(tmp_path / "a.spz").notes


KEPT = {"unity": False, "gsplat-js": False, "inria": False, "portable": False, "spark": True, None: True}


@pytest.mark.parametrize(("viewer", "kept"), KEPT.items())
def test_columns_that_the_loader_of_a_viewer_takes_for_others_are_left_out(tmp_path, viewer, kept):
    """Some take columns by their places, and some count all with 4 bytes, or none but floats."""
    model = tiny.model(5).with_extras({"segment": np.arange(5, dtype=np.int16)})
    columns = read_ply(for_loader_of(viewer, model, tmp_path / "a.ply").save(tmp_path / "a.ply", provenance={})).columns
    assert ("segment" in columns) == kept and len(columns) == 17 + (45 if viewer in ("unity", "portable") else 9) + kept
