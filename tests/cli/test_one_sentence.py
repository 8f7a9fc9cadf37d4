"""One sentence instead of a traceback for everything that is wrong, and the words of the command line."""

import inspect
import os
import re
from pathlib import Path
from typing import get_args

import pytest
import tiny
from commands_run import refused

from mipmap_plugin.cli import COMMANDS, EXAMPLES
from mipmap_plugin.commands.types import read_scale, read_viewer
from mipmap_plugin.config import ResizeFilter

pytestmark = pytest.mark.usefixtures("few_views")


def refused_once_named(answer, *words):
    """As `refused`, after lines on stdout that say what the file is."""
    code, out, err = answer
    assert [line.split(":")[0] for line in out.splitlines()] in ([], ["file", "family"])
    return refused((code, "", err), *words)


def test_the_version(run):
    assert re.fullmatch(r"mipmap-plugin \d+\.\d+\.\d+\S*\n", run("--version")[1])
    assert "mipmap-plugin --version tells" in " ".join(run("--help")[1].split())


def test_no_command(run):
    assert run()[0] == 2


@pytest.mark.parametrize(("word", "meant"), [("adpat", "; did you mean adapt?\n"), ("scene.ply", "tradeoff, backends, list, demo\n")])
def test_a_command_that_there_is_not(run, word, meant):
    """All its words were said to be misplaced options, and --scale to be what was meant."""
    assert refused(run(word, "a.ply", "--scale", "1/4"), f"there is no command '{word}'; choose from inspect, adapt, ").endswith(meant)


def test_a_path_that_begins_with_a_dash(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tiny.ply(Path("./-a.ply"))
    refused(run("inspect", "-a.ply"), "-a.ply: options begin with two dashes (but for -h); a path that begins with a dash is given as ./-a.ply")
    refused(run("render", "./-a.ply", "--output", "-out"), "is given as ./-out")
    for words in (["./-a.ply"], ["--", "-a.ply"]):
        code, out, _ = run("inspect", "--no-viewers", "--up=-z", *words)
        assert code == 0 and "next: mipmap-plugin adapt ./-a.ply --scale 1/4" in out
    assert "two dashes" not in run("adapt", "./-a.ply", "--scale", "1/2", "--up", "-z", "--steps", "-1")[2]


def test_help_names_options_as_they_are_typed():
    """Neither by the names of Python's parameters nor between backticks."""
    for command in COMMANDS.values():
        told = re.sub(r"^ +\w+: ", "", inspect.getdoc(command), flags=re.MULTILINE)
        names = re.findall(r"`\w+`|\b[a-z]+_[a-z]+\b", told)
        assert [name for name in names if "`" in name or name in inspect.signature(command).parameters] == []


@pytest.mark.parametrize("command", COMMANDS.values())
def test_the_help_of_an_option_is_one_paragraph(command):
    """A second line of a docstring would begin a new line of the help, in the middle of a sentence."""
    assert re.findall(r"^ {12}.*", command.__doc__, re.MULTILINE) == []


def malformed(folder: Path) -> dict[str, Path]:
    sound = tiny.ply(folder / "sound.ply").read_bytes()
    header = sound.index(b"end_header\n") + len(b"end_header\n")
    contents = {
        "empty.ply": b"",
        "text.ply": b"not a splat",
        "header_only.ply": sound[: header - 20],
        "cut.ply": sound[:-100],
        "no_rows.ply": sound[:header],
        "mesh.ply": b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n",
        "lfs.ply": b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n",
        "zip.ply": b"PK\x03\x04" + b"\0" * 40,
        "poison.ply": sound[:header] + b"\xff" * (len(sound) - header),
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    (folder / "empty_folder").mkdir()
    return {name: folder / name for name in [*contents, "empty_folder", "absent.ply"]}


@pytest.mark.parametrize("command", ["inspect", "adapt"])
def test_malformed_checkpoints_end_in_one_sentence(run, tmp_path, command):
    for name, path in malformed(tmp_path).items():
        words = ["--scale", "4"] if command == "adapt" else []
        assert name in refused_once_named(run(command, path, *words)), name
    assert not [path for path in tmp_path.iterdir() if "_x4" in path.name]


@pytest.mark.parametrize("content", ["", "{", "[]", "[1]", '[{"id": 0}]', '{"frames": []}', "\0"])
def test_malformed_cameras_end_in_one_sentence(run, model_folder, content):
    (model_folder / "cameras.json").write_text(content)
    assert "cameras.json" in refused_once_named(run("inspect", model_folder))


@pytest.mark.parametrize("content", ["", "{}", '{"frames": []}', '{"frames": [{"file_path": "a"}]}', '{"frames": [{"w": 4, "h": 4}]}'])
def test_malformed_scenes_end_in_one_sentence(run, model_folder, tmp_path, content):
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene/transforms_test.json").write_text(content)
    refused(run("evaluate", model_folder, "--images", tmp_path / "scene", "--scale", "1"), "scene")


def test_a_damaged_photograph_ends_in_one_sentence(run, model_folder, tmp_path):
    scene = tiny.scene(tmp_path / "scene")
    picture = scene / "test/view_0.png"
    picture.write_bytes(picture.read_bytes()[:200])
    refused(run("evaluate", model_folder, "--images", scene, "--scale", "1"), "view_0.png")


def test_requests_that_cannot_be_served_end_in_one_sentence(run, model_folder):
    refused(run("adapt", model_folder, "--scale", "4", "--backend", "gpu"), "there is no backend 'gpu'; choose from", "reference")
    refused(run("adapt", model_folder, "--scale", "4", "--upsampler", "swin"), "there is no upsampler 'swin'; choose from bicubic, lanczos")
    refused(run("adapt", model_folder, "--scale", "4", "--steps", "-1"), "setting steps: must be a whole number of at least 0, got -1")
    refused(run("adapt", model_folder), "--scale is required; give --scale 1/4")
    refused(run("evaluate", model_folder, "--images", model_folder), "--scale is required; give --scale 1/4")
    refused(run("adapt", model_folder, "--scale", "4", "--cameras", "nowhere.json"), "nowhere.json: there is no such file")


@pytest.mark.usefixtures("brief_ladders")
def test_levels_without_cameras_are_told_of_once(run, tmp_path):
    """Each of several levels is adapted to the orbit."""
    base = tiny.ply(tmp_path / "base.ply")
    words = ["--viewer", "playcanvas", "--coarsest", "1/2", "--steps", "0", "--backend", "cpu", "--threads", "1"]
    code, _, err = run("levels", base, *words, "--output", tmp_path / "levels")
    assert code == 0 and err.count("views of a generated orbit are adapted to") == 1
    assert err.count("would change levels at the distances of a generated orbit") == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("adapt base.ply --scale 1/2 --output gone.ply", "mipmap-plugin: gone.ply is a link to something that is not there"),
        ("adapt base.ply --scale 1/2 --tiles 99", "mipmap-plugin: base.ply has 60 splats, which cannot be cut into 99 tiles"),
    ],
)
def test_what_is_refused_is_told_by_its_path_from_here(run, tmp_path, monkeypatch, words, told):
    monkeypatch.chdir(tmp_path)
    tiny.ply(tmp_path / "base.ply")
    (tmp_path / "gone.ply").symlink_to(tmp_path / "nowhere")
    assert told in refused(run(*words.split()))


def test_a_current_folder_that_was_deleted_is_told_of(run, tmp_path, monkeypatch):
    """The system says of no path that it does not exist, and MKL that it cannot be loaded."""
    monkeypatch.chdir(tmp_path)  # which pytest leaves before it goes on
    gone = tmp_path / "gone"
    gone.mkdir()
    os.chdir(gone)
    gone.rmdir()
    for words in (["inspect", tiny.ply(tmp_path / "a.ply")], ["adapt", "a.ply", "--scale", "1/4"]):
        refused(run(*words), "the folder that this command was started in is gone; change to another")


@pytest.mark.parametrize("words", ["levels base.ply --viewer spark --output new.ply", "tradeoff base.ply --scale 1/2 --output new.json --no-picture"])
def test_the_folder_of_several_files_is_not_called_as_one_of_them(run, words):
    refused(run(*words.split()), "several files are written there; give the path of a folder")


@pytest.mark.parametrize("words", [["inspect", ""], ["adapt", "a.ply", "--scale", "1/4", "--output="], ["adapt", "a.ply", "--output", ""]])
def test_an_empty_word_is_not_this_folder(run, words):
    """As of a variable that is not set, in quotes: `Path("")` is the current folder."""
    refused(run(*words), "a word of this command is empty")


@pytest.mark.parametrize("words", [["adapt", "a\0b", "--scale", "1/4"], ["demo", "--output", "a\0b/c"], ["list", "viewers", "--log", "~a\0b"]])
def test_a_word_with_a_zero_byte_is_refused(run, words):
    """It ended in a traceback, where the system was asked for a path below it."""
    assert refused(run(*words), "holds a zero byte").startswith("mipmap-plugin: '")


@pytest.mark.parametrize("words", ["adapt --scale 25%", "adapt --viewers spark", "adapt --up up", "levels a b"])
def test_a_mistake_points_to_the_help_of_its_command(run, words):
    command = words.split()[0]
    code, _, said = run(*words.split())
    assert code == 2 and f"mipmap-plugin {command} --help" in said
    assert [other for other in COMMANDS if other != command and f"mipmap-plugin {other}" in said] == []


def test_names_to_choose_from_are_told_in_the_order_of_the_help(run):
    """They were in another order in each process, and None, which nobody types, was among them."""
    said = run("adapt", "a.ply", "--scale", "1/2", "--resize", "fine")[2]
    assert re.findall(r"'([\w-]+)'", said.partition("one of")[2]) == [*get_args(ResizeFilter)]


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_has_an_example(run, name):
    assert f"Example: mipmap-plugin {name} {EXAMPLES[name]}\n" in run(name, "--help")[1]


@pytest.mark.parametrize("columns", [1, 6, 39])
def test_help_on_a_very_narrow_terminal_is_that_of_a_narrow_one(run, monkeypatch, columns):
    """tyro takes all memory for a column, and gives each word a line of its own for 39."""
    helps = []
    for each in (columns, 40):
        monkeypatch.setenv("COLUMNS", str(each))
        helps.append(run("adapt", "--help")[1])
    assert helps[0] == helps[1] and "--time-budget-s" in helps[0]


@pytest.mark.parametrize(("text", "name"), [("SuperSplat", "supersplat"), ("Luma", "luma"), ("spark", "spark"), ("Sparky", "Sparky")])
def test_viewers_are_named_as_their_makers_write_them_too(text, name):
    assert read_viewer(text) == name


@pytest.mark.parametrize(("text", "scale"), [("1/4", 0.25), ("4", 4.0), ("1e-3", 0.001), ("1 / 4", 0.25), ("×1/4", 0.25), ("0.25x", 0.25)])
def test_scales_are_fractions_or_numbers(text, scale):
    assert read_scale(text) == scale


@pytest.mark.parametrize(
    "words", ["a.ply --scale 1/2 1/8", "--scale 1/2 1/8 a.ply", "a.ply --scale=.5 1/8", "a.ply 1/8", "--steps 1 1/8 a.ply"]
)
def test_a_scale_without_an_option_of_its_own_is_no_checkpoint(run, words):
    refused(run("adapt", *words.split()), "1/8: each scale is given by an option of its own, as in --scale 1/2 --scale 1/4")


def test_a_command_that_takes_one_scale_does_not_ask_for_two(run):
    for words in ("a.ply --scale 1/2 1/4", "a.ply 1/4"):
        refused(run("render", *words.split()), "1/4: give one scale, as in --scale 1/4")


def test_further_decimal_scales_are_told_from_other_numbers(run, tmp_path, monkeypatch):
    refused(run("tradeoff", "a.ply", "--scale", "0.5", "0.25", "--output", "o"), "0.25: each scale is given by")
    monkeypatch.chdir(tmp_path)
    refused(run("inspect", "1/8"), "1/8 does not exist")
    assert "each scale" not in run("tradeoff", "a.ply", "--scale", "0.5", "--steps", "5", "8", "--output", "o")[2]
    Path("1").mkdir()
    tiny.ply(Path("1/8"))
    assert "each scale" not in run("adapt", "1/8", "--shard", "3/2", "--scale", "1/2")[2]


@pytest.mark.parametrize(("name", "told"), [("Blender", "take kiri"), ("unreal", "take portable"), ("luma", "take portable")])
def test_programs_without_a_record_are_told_of_with_what_to_take(run, name, told):
    refused(run("adapt", "a.ply", "--scale", "1/4", "--viewer", name), f"viewer {name.lower()}: ", told)


@pytest.mark.parametrize("text", ["", "x", "0", "-1/4", "1/0", "inf", "nan", "1e999", "1e308", "1e5", "1e-50", "25%", "1:4", "0,25", "1 4", "×"])
def test_scales_that_are_no_zoom(text):
    with pytest.raises(ValueError, match=r"scale must be a number or a fraction from 1e-09 to 10000, such as 1/4, 0\.25 or 4, got "):
        read_scale(text)


@pytest.mark.parametrize("output", [[], ["--output", "~/half.ply"], ["--output=~/half.ply"]])
def test_a_tilde_is_the_home_folder_where_no_shell_says_so(run, tmp_path, monkeypatch, output):
    monkeypatch.setenv("HOME", str(tmp_path))
    tiny.ply(tmp_path / "base.ply")
    code, out, _ = run("adapt", "~/base.ply", "--scale", "1/2", "--recipe", "instant", *output)
    assert code == 0 and str(tmp_path / ("half.ply" if output else "base_x0.5.ply")) in out and "~" not in out
