"""What a command or a model may write to: never the base or a part of it, by no name; and what would fail at the end is refused first."""

import os
import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest
import tiny
import torch
from corpus import SAMPLES
from writers import WRITERS, adapted, base_and_output, contents

from mipmap_plugin.adaptation.target import disk_cache
from mipmap_plugin.cli import main
from mipmap_plugin.errors import OutputError, OutputExists, SettingsError
from mipmap_plugin.formats import atomic as files
from mipmap_plugin.levels.request import LadderRequest
from mipmap_plugin.levels.room import room_for
from mipmap_plugin.models import load_model
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")

INSTANT = ["--recipe", "instant"]


@pytest.fixture
def refused(capsys):
    """Call the command line, which has to end in one sentence; return it."""

    def call(*words) -> str:
        capsys.readouterr()
        assert main([str(word) for word in words]) == 2
        said = capsys.readouterr()
        assert said.out == "" and said.err.startswith("mipmap-plugin: ") and said.err.count("\n") == 1
        return said.err

    return call


@pytest.fixture
def no_work(monkeypatch):
    monkeypatch.setattr("mipmap_plugin.wrap.Wrapped.adapt", lambda *_, **__: pytest.fail("worked in vain"))


def names_of(base: Path, folder: Path) -> list[Path]:
    """The base by other names."""
    (folder / "soft.ply").symlink_to(base)
    os.link(base, folder / "hard.ply")
    (folder / "by").symlink_to(base.parent)
    return [base, folder / "soft.ply", folder / "hard.ply", folder / "by" / base.name]


@pytest.mark.parametrize("which", range(4), ids=["itself", "link", "hard link", "linked folder"])
def test_a_base_is_never_overwritten_by_what_is_adapted_from_it(tmp_path, refused, which):
    base = tiny.ply(tmp_path / "base.ply")
    before, name = base.read_bytes(), names_of(base, tmp_path)[which]
    assert "is the base checkpoint itself" in refused("adapt", base, "--scale", "1/2", "--output", name, "--overwrite", *INSTANT)
    with pytest.raises(OutputExists, match="is the base checkpoint itself"):
        adapted(base, 1 / 2).save(name, overwrite=True)
    with pytest.raises(OutputExists, match="is the base checkpoint itself"):
        load_model(base).save(name, provenance={}, overwrite=True)
    assert base.read_bytes() == before


@pytest.mark.parametrize("name", WRITERS)
def test_no_part_of_a_base_is_ever_overwritten(tmp_path, name):
    """Nor a folder around one."""
    base = SAMPLES[name].make(tmp_path / "base")
    before, new = contents(tmp_path), adapted(base, 1 / 2)
    folder = base if base.is_dir() else base.parent
    parts = [path for path in folder.rglob("*") if base.is_dir() or path == base]
    for part in [tmp_path, folder, *parts]:
        with pytest.raises((OutputExists, OutputError, SettingsError)):
            new.save(part, overwrite=True)
    assert contents(tmp_path) == before


def test_a_rank_of_a_training_is_a_part_of_the_base(tmp_path):
    folder = SAMPLES["ckpt of gsplat"].make(tmp_path / "base")
    first = folder / "ckpts/ckpt_6999_rank0.pt"
    first = Path(shutil.copytree(first.parent, tmp_path / "lone"), first.name)
    second = Path(shutil.copy(first, first.with_name("ckpt_6999_rank1.pt")))
    with pytest.raises(OutputExists, match=r"rank1\.pt is the base checkpoint itself"):
        load_model(first).save(second, provenance={}, overwrite=True)


def test_what_was_adapted_before_may_be_overwritten_also_among_the_base(tmp_path):
    folder = tiny.folder(tmp_path / "base", tiny.cameras(2))
    model = wrap_model(folder / "point_cloud/iteration_30000/point_cloud.ply")
    out = folder / "point_cloud/iteration_30000/point_cloud_x0.5.ply"
    for scale in (1 / 2, 1 / 4):
        model.adapt(scale, recipe="instant").save(out, overwrite=True)
    with pytest.raises(OutputExists, match=r"point_cloud\.ply is the base checkpoint itself"):
        model.adapt(1 / 2, recipe="instant").save(out.with_name("point_cloud.ply"), overwrite=True)


@pytest.mark.parametrize("words", [[], ["--overwrite"]])
def test_nodes_that_are_no_files_are_refused_before_any_work(tmp_path, refused, no_work, words):
    base = tiny.ply(tmp_path / "base.ply")
    (tmp_path / "dangling.ply").symlink_to(tmp_path / "nothing")
    (tmp_path / "loop.ply").symlink_to(tmp_path / "loop.ply")
    os.mkfifo(tmp_path / "pipe.ply")
    for output in ("/dev/null", *(tmp_path / f"{name}.ply" for name in ("dangling", "loop", "pipe"))):
        assert str(output) in refused("adapt", base, "--scale", "1/2", "--output", output, *words, *INSTANT)
    for beside in (".adaptation.json", ".resume"):
        (tmp_path / f"new.ply{beside}").symlink_to(base)
        assert "is the base checkpoint itself" in refused("adapt", base, "--scale", "1/2", "--output", tmp_path / "new.ply", *words, *INSTANT)
        (tmp_path / f"new.ply{beside}").unlink()


def test_what_cannot_be_saved_is_refused_before_any_work(tmp_path, refused, no_work, monkeypatch):
    moving, anchors = SAMPLES["deform.pth"].make(tmp_path / "moving"), SAMPLES["opacity_mlp.pt"].make(tmp_path / "anchors")
    base, full = tiny.ply(tmp_path / "base.ply"), tmp_path / "full"
    full.mkdir()
    (full / "precious").write_text("")
    words = ["--scale", "1/2", *INSTANT, "--overwrite", "--output"]
    assert "a PLY has no room for the network" in refused("adapt", moving, *words, tmp_path / "new.ply")
    assert "this format has no room for the network" in refused("adapt", moving, *words, tmp_path / "new.spz")
    assert "is not written as SPZ" in refused("adapt", anchors, *words, tmp_path / "new.spz")
    assert "is not written as SPLAT" in refused("adapt", base, *words, tmp_path / "new.splat")
    assert "is the root of a disk" in refused("adapt", base, *words, "/")
    assert "is a folder with other things in it" in refused("adapt", moving, *words, full)
    assert "is a folder, which no file replaces" in refused("adapt", base, *words, full.rename(tmp_path / "full.ply"))
    splats = anchors / "point_cloud/iteration_30000/point_cloud.ply"
    beside = splats.with_name("new.ply")
    assert "holds other networks" in refused("adapt", splats, "--scale", "1/2", "--output", beside)
    monkeypatch.setattr(files.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(100, 90, 10))
    assert "its disk has 10 bytes free, and the base takes" in refused("adapt", base, *words, tmp_path / "new.ply")


def test_a_disk_without_room_for_levels_or_tiles_is_noticed_before_any_work(tmp_path, refused, no_work, monkeypatch):
    """Both keep a copy until all is done; what goes on has made that one already."""
    base = tiny.folder(tmp_path / "base")
    size = next(base.rglob("*.ply")).stat().st_size
    ladder = ["levels", base, "--viewer", "classic", "--by", "zoom", "--output", tmp_path / "ladder"]
    tiled = ["adapt", base, "--scale", "1/2", "--tiles", "2", "--output", tmp_path / "new.ply"]
    # The levels below x1 have half of the base's splats, and all are there twice until the ladder is complete.
    wrapped, request = wrap_model(base), LadderRequest("classic")
    levels = room_for(wrapped, request, tmp_path / "ladder.resume")
    assert 2.8 < levels / (60 * 26 * 4) <= 3
    free = [0]
    monkeypatch.setattr(files.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 0, free[0]))
    monkeypatch.setattr("mipmap_plugin.tiles.plan.make_cut", lambda *_: pytest.fail("worked in vain"))
    for words, room, told in ((ladder, levels, "the levels take about"), (tiled, 2 * size, "the tiles take at least")):
        free[0] = room - 1
        assert f"its disk has {room - 1:,} bytes free, and {told} {room:,}" in refused(*words)
    assert [file.name for file in tmp_path.iterdir()] == ["base"]
    for made in ("ladder.resume/level_0.ply", "new.ply.tiles/cut.pt"):
        (tmp_path / made).parent.mkdir()
        (tmp_path / made).write_bytes(bytes(size))
    free[0] = levels
    assert "unfinished ladders are kept there" in refused(*ladder) and "holds other things" in refused(*tiled)
    for words, room in ((ladder, levels - size), (tiled, size)):
        free[0] = room - 1
        assert f"{room:,}" in refused(*words)


def test_a_format_that_nothing_here_writes_is_refused_before_any_work(tmp_path, refused, no_work, monkeypatch):
    monkeypatch.setenv("PATH", "")
    base = tiny.ply(tmp_path / "base.ply")
    assert "run: npm install" in refused("adapt", base, "--scale", "1/2", "--output", tmp_path / "new.spz", *INSTANT)


@pytest.mark.parametrize("output", [".", "./"])
def test_the_working_folder_is_a_folder_like_others(tmp_path, refused, monkeypatch, output):
    base = tiny.ply(tmp_path / "base.ply")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path)
    assert "holds the base checkpoint itself" in refused("adapt", base, "--scale", "1/2", "--output", output, "--overwrite", *INSTANT)
    monkeypatch.chdir(tmp_path / "here")
    assert "give the path of what is to be written, such as base_x0.5.ply" in refused("adapt", base, "--scale", "1/2", "--output", output, *INSTANT)


def test_other_commands_spare_the_checkpoint_too(tmp_path, refused):
    folder = tiny.folder(tmp_path / "base", tiny.cameras(2))
    scene = tiny.scene(tmp_path / "scene")
    before = contents(folder)
    for part in ("cfg_args", "cameras.json", "point_cloud/iteration_30000/point_cloud.ply"):
        words = ["--images", scene, "--scale", "1", "--output", folder / part, "--overwrite"]
        assert "is the base checkpoint itself" in refused("evaluate", folder, *words)
    (tmp_path / "out").mkdir()
    (tmp_path / "out/train_view_0.png").symlink_to(folder / "cameras.json")
    assert "is the base checkpoint itself" in refused("render", folder, "--output", tmp_path / "out", "--overwrite")
    assert contents(folder) == before


@pytest.mark.parametrize("name", WRITERS)
def test_an_output_error_names_the_output(tmp_path, monkeypatch, name):
    base, out = base_and_output(tmp_path, name)
    new, full = adapted(base, 1 / 2), Mock(side_effect=OSError(28, "No space left on device"))
    monkeypatch.setattr(os, "fsync", full)
    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OutputError) as told:
        new.save(out)
    reason = "cannot be written: No space left on device; free some, or choose another disk"
    assert str(told.value).startswith(str(out)) and str(told.value).endswith(reason)
    assert ".tmp" not in str(told.value)


def test_no_model_appears_without_its_report(tmp_path, monkeypatch):
    for name in ("new.ply", "new"):
        new = adapted(tiny.ply(tmp_path / f"base of {name}.ply"), 1 / 2)
        monkeypatch.setattr("mipmap_plugin.formats.atomic.json_text", lambda _: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            new.save(tmp_path / "out" / name)
        monkeypatch.undo()
        assert not (tmp_path / "out").exists()


def test_a_name_that_leaves_no_room_for_a_reports_is_read(tmp_path):
    base = tiny.ply(tmp_path / "base.ply", count=20).rename(tmp_path / f"{'a' * 246}.ply")
    assert main(["adapt", str(base), "--scale", "1/2", "--output", str(tmp_path / "new.ply"), *INSTANT]) == 0


# The cache


@pytest.mark.parametrize("folder", ["a file", "a file/below"])
def test_a_cache_that_cannot_be_written_costs_a_warning(tmp_path, monkeypatch, folder):
    (tmp_path / "a file").write_text("")
    monkeypatch.setenv(disk_cache.VARIABLE, str(tmp_path / folder))
    with pytest.warns(UserWarning, match="the image is not cached: .* cannot be written"):
        image = disk_cache.cached("ab", lambda: torch.ones(2, 2, 3))
    assert torch.equal(image, torch.ones(2, 2, 3))


@pytest.mark.parametrize("content", [5, {}, torch.ones(2), torch.ones(2, 2, 3, dtype=torch.int64)], ids=str)
def test_a_cache_that_holds_something_else_is_made_anew(tmp_path, monkeypatch, content):
    monkeypatch.setenv(disk_cache.VARIABLE, str(tmp_path))
    (tmp_path / "ab").mkdir()
    torch.save(content, tmp_path / "ab/ab.pt")
    assert torch.equal(disk_cache.cached("ab", lambda: torch.zeros(2, 2, 3)), torch.zeros(2, 2, 3))
    assert torch.equal(disk_cache.cached("ab", lambda: pytest.fail("made again")), torch.zeros(2, 2, 3))
