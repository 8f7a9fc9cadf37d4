"""Without cameras a base and what is adapted from it are looked at from the same places."""

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import tiny
import torch
from torch_checkpoints import gsplat_folder, splatfacto_folder, splats

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.views.remarks import orbited
from mipmap_plugin.cli import main
from mipmap_plugin.errors import CheckpointError, SettingsError
from mipmap_plugin.models.adapted_scale import adapted_orbit
from mipmap_plugin.scenes.orbits import Orbit

pytestmark = pytest.mark.usefixtures("few_views")

SCALE = 0.125
Z = (0.0, 0.0, 1.0)


def poses(path, **options) -> torch.Tensor:
    return torch.stack([view.viewmat for view in wrap_model(path, **options).views()])


def heights(views, along: int = 2) -> list[float]:
    """How far views look from above what they look at, along an axis: sines of elevations."""
    return [-float(view.viewmat[2, along]) for view in views]


@pytest.fixture
def files(tmp_path):
    """A base, and a file that was adapted from it, whose splats have other means."""
    base = tiny.ply(tmp_path / "base.ply")
    adapted = wrap_model(base).adapt(SCALE, recipe="instant", extra_views=4)
    with torch.no_grad():
        adapted.model.parameters()["means"].add_(0.01)
    return base, adapted.save(tmp_path / "adapted.ply")


@pytest.mark.parametrize("kept", ["both", "report", "header"])
def test_an_adapted_file_is_seen_from_where_its_base_is(files, kept):
    base, adapted = files
    if kept == "header":
        adapted.with_name(adapted.name + ".adaptation.json").unlink()
    elif kept == "report":
        adapted.write_bytes(adapted.read_bytes().replace(b"comment mipmap_plugin {", b"comment another_plugin {"))
    assert torch.equal(poses(adapted), poses(base))


def test_and_so_is_what_is_adapted_from_it_again(files, tmp_path):
    base, _ = files
    fewer = {"recipe": "instant", "most_splats": 20, "extra_views": 4}
    first = wrap_model(base).adapt(1.0, viewer="classic", **fewer).save(tmp_path / "first.ply")
    second = wrap_model(first).adapt(SCALE, recipe="instant", extra_views=4).save(tmp_path / "second.ply")
    assert torch.equal(poses(second), poses(base))


@pytest.mark.filterwarnings("ignore:no cameras")
def test_and_so_is_what_is_adapted_in_tiles(files, tmp_path):
    base, _ = files
    first = wrap_model(base).adapt(1.0, viewer="classic", recipe="instant", most_splats=20, extra_views=4)
    first.save(tmp_path / "first.ply")
    words = ["--scale", "1/4", "--recipe", "instant", "--tiles", "2"]
    for path in (base, tmp_path / "first.ply"):
        assert main(["adapt", str(path), "--output", str(tmp_path / "tiled.ply"), "--overwrite", *words]) == 0
        assert torch.equal(poses(tmp_path / "tiled.ply"), poses(base))


def reported(adapted, orbit):
    """The adapted file with this orbit in its report, and none in its header."""
    adapted.write_bytes(adapted.read_bytes().replace(b"comment mipmap_plugin {", b"comment another_plugin {"))
    report = adapted.with_name(adapted.name + ".adaptation.json")
    report.write_text(json.dumps(json.loads(report.read_text()) | {"orbit": orbit}))
    return adapted


def test_a_report_without_an_orbit_is_taken_as_one_of_before(files):
    adapted = reported(files[1], None)
    assert adapted_orbit(adapted) is None and len(poses(adapted)) > 1


@pytest.mark.parametrize(
    "wrong",
    [{"center": [1.0, 2.0]}, {"center": [math.nan, 0, 0]}, {"up": [0.0, 0.0, 0.0]}, {"distance": 0.0}, {"distance": math.inf}, {"nearest": "far"}],
    ids=str,
)
def test_a_damaged_orbit_is_told_of(files, wrong):
    adapted = reported(files[1], {"center": [1.0, 2.0, 3.0], "up": [0.0, 0.0, 1.0], "distance": 1.0, **wrong})
    with pytest.raises(CheckpointError, match=f"{adapted.name}: the orbit around its base, which its header or its report tells, is damaged; copy"):
        poses(adapted)


def test_whole_numbers_are_places_too(files):
    assert adapted_orbit(reported(files[1], {"center": [1, 2, 3], "up": None, "distance": 2}))["center"] == (1, 2, 3)


@pytest.mark.parametrize(
    ("comment", "up"),
    [
        ("Vertical Axis: z", Z),
        ("Exported from Brush\ncomment Vertical axis: y", None),
        ("Exported from Brush\ncomment Vertical axis: 0 -0.6 0.8", (0.0, -0.6, -0.8)),  # the third number is of what is down
        ("Exported from Brush\ncomment Vertical axis: 0 -1 0", None),  # of one that said y
        ("Exported from Brush\ncomment Vertical axis: NaN 0 1", None),
        ("Exported from Brush\ncomment Vertical axis: 0 0 0", None),
        ("Exported from Brush\ncomment Vertical axis: up is there", None),
        ("Vertical axis: 0 -0.6 0.8", None),
    ],
    ids=["nerfstudio", "Brush before", "Brush", "Brush from before", "not a number", "nothing", "words", "another program"],
)
def test_a_header_tells_the_vertical_but_for_what_a_program_writes_into_every_file(tmp_path, comment, up):
    base = tiny.ply(tmp_path / "base.ply")
    base.write_bytes(base.read_bytes().replace(b"element vertex", f"comment {comment}\nelement vertex".encode(), 1))
    assert wrap_model(base).viewpoints.orbit.up == up


@pytest.mark.parametrize(
    ("make", "up"),
    [(splatfacto_folder, Z), (gsplat_folder, Z), (partial(gsplat_folder, normalized="false"), None)],
    ids=["nerfstudio", "gsplat", "gsplat, as COLMAP has it"],
)
def test_a_project_that_turns_its_scenes_tells_the_vertical(tmp_path, make, up):
    base = wrap_model(make(tmp_path / "r", splats()))
    assert base.viewpoints.orbit.up == up
    adapted = base.adapt(SCALE, recipe="instant", extra_views=40)
    assert (min(heights(adapted.adapted_to)) > -0.2) == bool(up) and (", with z up," in adapted.report.views) == bool(up)


# What the user says is up


def test_with_what_is_up_as_many_views_look_from_above_the_horizon(files):
    base, _ = files
    around, above = (wrap_model(base, **up) for up in ({}, {"up": "-x"}))
    assert len(above.views()) == len(around.views()) and -1 < min(heights(around.views(), 0)) < -0.9
    seen = [-height for height in heights(above.views(), 0)]
    assert -0.18 < min(seen) < 0 and 0.9 < max(seen) < 0.99
    assert max(abs(float(view.viewmat[0, 0])) for view in above.views()) < 1e-9  # no picture is rolled
    adapted = above.adapt(SCALE, recipe="instant", extra_views=8)
    assert min(-height for height in heights(adapted.adapted_to, 0)) > -0.18
    assert adapted.report.views == "8 views of a generated orbit from above the horizon, with -x up, at 24 px (the checkpoint came without cameras)"


def test_an_adapted_file_keeps_what_was_up_unless_it_is_said_anew(tmp_path, files):
    base, _ = files
    adapted = wrap_model(base, up="y").adapt(SCALE, recipe="instant", extra_views=4).save(tmp_path / "up.ply")
    assert torch.equal(poses(adapted), poses(base, up="y")) and not torch.equal(poses(adapted), poses(base))
    assert torch.equal(poses(adapted, up="x"), poses(base, up="x"))


@pytest.mark.filterwarnings("ignore:no cameras")
def test_tiles_and_pictures_are_of_what_is_up(tmp_path, files):
    base, _ = files
    words = ["--up", "-y", "--overwrite"]
    assert main(["adapt", str(base), "--output", str(tmp_path / "tiled.ply"), "--scale", "1/4", "--recipe", "instant", "--tiles", "2", *words]) == 0
    assert torch.equal(poses(tmp_path / "tiled.ply"), poses(base, up="-y"))
    report = json.loads((tmp_path / "tiled.ply.adaptation.json").read_text())
    assert ", with -y up," in report["views"] and report["inputs"]["up"] == "-y"
    for name, up in (("told", ["--up", "-y"]), ("kept", [])):
        assert main(["render", str(tmp_path / "tiled.ply"), "--output", str(tmp_path / name), "--view", "orbit_0001", *up, *words[2:]]) == 0
    assert (tmp_path / "told" / "train_orbit_0001.png").read_bytes() == (tmp_path / "kept" / "train_orbit_0001.png").read_bytes()


def test_without_cameras_it_is_told_where_views_look_from(files, recwarn):
    for up in ({}, {"up": "z"}):
        wrap_model(files[0], **up).adapt(SCALE, recipe="instant", extra_views=2)
    around, above = [str(each.message) for each in recwarn if str(each.message).startswith("no cameras")]
    assert "from all around" in around and "say what is up (--up" in around
    assert "from above the horizon, with z up" in above and "--up" not in above


def test_what_is_up_is_not_asked_for_where_colors_tell_from_where_to_look():
    lying = Orbit((0.0, 0.0, 0.0), None, 2.0, nearest=1.0)
    assert "--up" in orbited(None, lying) and "--up" not in orbited(None, replace(lying, seen="f", focal=500.0))


def test_of_an_spz_it_is_told_that_what_is_up_may_be_guessed_wrongly():
    """Phones write it with y up, others with the axes of a PLY."""
    guessed = Orbit((0.0, 0.0, 0.0), (0.0, -1.0, 0.0), 2.0, nearest=1.0)
    assert "--up y" in orbited(Path("a.spz"), guessed) and "--up" not in orbited(Path("a.ply"), guessed)
    assert "--up" not in orbited(Path("a.spz"), replace(guessed, said=True))


def test_what_somebody_says_is_up_is_told_with_where_a_capture_was_photographed():
    seen = Orbit((0.0, 0.0, 0.0), Z, 2.0, nearest=1.0, seen="f", focal=500.0)
    assert ", with z up" in replace(seen, said=True).told() and "up" not in seen.told()


@pytest.mark.parametrize(("floaters", "seems"), [(0, False), (1, True)], ids=["an object by itself", "splats far around it"])
def test_without_cameras_a_capture_is_told_from_an_object(tmp_path, recwarn, floaters, seems):
    model = tiny.model(40)
    with torch.no_grad():
        model.parameters()["means"].copy_(torch.rand(40, 3, generator=torch.Generator().manual_seed(0)))
        model.parameters()["means"][: 3 * floaters] *= 50
    base = model.save(tmp_path / "base.ply", provenance={})
    wrap_model(base).adapt(SCALE, recipe="instant", extra_views=2)
    [told] = [str(each.message) for each in recwarn if str(each.message).startswith("no cameras")]
    assert ("this seems to be" in told, "mipmap-plugin view" in told) == (seems, seems)


def test_cameras_leave_what_is_up_to_orbits_that_are_asked_for(tmp_path):
    folder = tiny.folder(tmp_path / "base")
    with pytest.warns(UserWarning, match="^up z: there are cameras, whose views are taken"):
        base = wrap_model(folder, up="z")
    assert base.adapt(SCALE, recipe="instant").report.views.startswith("4 train views")
    adapted = base.adapt(SCALE, recipe="instant", views="orbit", extra_views=40)
    assert min(heights(adapted.adapted_to)) > -0.18 and ", with z up," in adapted.report.views


def test_inspect_tells_what_is_up(files, capsys):
    assert main(["inspect", str(files[0]), "--no-viewers", "--up", "z"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "none beside the checkpoint; it is looked at from above the horizon, with z up" in said and "--scale 1/4 --up z" in said


@pytest.mark.parametrize("up", ["Z", "up", 2, (0, 0, 1)])
def test_what_is_no_axis_is_refused(files, up):
    with pytest.raises(SettingsError, match=r"^up must be the axis of the scene that is up, one of x, y, z, -x, -y, -z, got "):
        wrap_model(files[0], up=up)


def test_an_unknown_option_is_refused(files):
    with pytest.raises(TypeError, match=r"\) got unknown options: upwards; there are cameras, backend, threads, background, screen_filter, up$"):
        wrap_model(files[0], upwards="z")
