"""What commands say: quiet or not, and in a log."""

import contextlib
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import tiny

from mipmap_plugin import progress
from mipmap_plugin.cli import main
from mipmap_plugin.commands.voice import options, say, speaking, wrapped
from mipmap_plugin.errors import SettingsError
from mipmap_plugin.models.families import API_VERSION, FAMILIES, Family

pytestmark = pytest.mark.usefixtures("few_views")

QUICK = ["--scale", "1/2", "--recipe", "instant"]

# A command that prints something and ends soon, for it does without torch.
LISTS = [sys.executable, "-m", "mipmap_plugin", "list", "families"]


@pytest.fixture
def base(tmp_path):
    return str(tiny.folder(tmp_path / "base", tiny.cameras(3)))


LEVELS = ["levels", "--viewer", "spark", "--coarsest", "1", "--recipe", "instant", "--by", "zoom"]


@pytest.mark.parametrize("words", [["adapt", *QUICK], LEVELS], ids=["adapt", "levels"])
def test_a_quiet_command_prints_nothing(base, tmp_path, capsys, words):
    assert main([*words, base, "--quiet", "--output", str(tmp_path / "made")]) == 0
    assert capsys.readouterr() == ("", "")


def test_a_file_does_not_command_the_terminal(base, tmp_path, capsys):
    """By escape sequences in its names, which it may have from anybody."""
    cameras = Path(base, "cameras.json")
    cameras.write_text(cameras.read_text().replace("view_0", "view\\u001b[2J\\u009b2J"))
    assert main(["render", base, "--view", "nothing", "--output", str(tmp_path / "out")]) == 2
    Path(tmp_path, "a.ply").write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float \x1b[2J\nend_header\n1\n")
    assert main(["inspect", str(tmp_path / "a.ply"), "--log", str(tmp_path / "log")]) == 2
    told = capsys.readouterr().err
    assert r"view\x1b[2J\x9b2J" in told and r"(columns \x1b[2J)" in told and not set("\x1b\x9b") & set(told + (tmp_path / "log").read_text())


def test_what_is_said_reaches_a_pipe_at_once(tmp_path):
    pipe = (tmp_path / "pipe").open("w")
    with pipe, contextlib.redirect_stdout(pipe):
        say("http://localhost:8080")
        assert (tmp_path / "pipe").read_text() == "http://localhost:8080\n"


def test_a_long_fact_is_wrapped_under_its_key_in_a_terminal(base, capsys, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["inspect", base, "--no-viewers", "--all"]) == 0
    lines = capsys.readouterr().out.splitlines()
    [command] = [line for line in lines if "mipmap-plugin adapt" in line]  # on one line, to be copied
    assert command.endswith("--scale 1/4")
    assert all(len(line) <= 80 for line in lines if line != command and not line.startswith("file:"))


def test_a_long_fact_is_one_line_in_a_pipe(base, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert main(["inspect", base, "--no-viewers", "--all"]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) > 100


@pytest.mark.parametrize("width", [1, 30, 80])
def test_wrapping_loses_no_word(width):
    text = "health:       one of many words, path/without-a-break; next: mipmap-plugin adapt 'a b' --scale 1/4"
    lines = wrapped(text, 14, width).split("\n")
    assert " ".join(line.strip() for line in lines) == text and lines[-1].endswith(["", "mipmap-plugin adapt 'a b' --scale 1/4"][1])
    assert len(lines) > 1 and all(line.startswith(" " * 14) for line in lines[1:])


def test_a_quiet_command_prints_json(base, capsys):
    assert main(["--quiet", "inspect", base, "--json"]) == 0
    assert capsys.readouterr().out.startswith("{")


def test_what_a_plug_in_prints_is_no_part_of_the_json(base, capsys):
    family = Family("chatty", "Prints", lambda files: print("is it mine?"), API_VERSION)
    FAMILIES.add("chatty", family)
    assert main(["inspect", base, "--no-viewers", "--json"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["family"] and "is it mine?" in said.err


def test_a_quiet_command_prints_what_is_wrong(base, capsys):
    assert main(["adapt", base, "--quiet", "--scale", "1/2", "--viewer", "nobody"]) == 2
    said = capsys.readouterr()
    assert said.out == "" and "there is no viewer 'nobody'" in said.err


def test_a_quiet_command_shows_no_progress(monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "_show", lambda *_: pytest.fail("progress was shown"))
    with speaking(True, None), progress.announced("work"):
        assert not sys.stderr.isatty()


def test_a_log_has_the_command_what_was_said_the_details_and_what_went_wrong(base, tmp_path, capsys):
    log = tmp_path / "log.txt"
    assert main(["adapt", base, *QUICK, "--quiet", f"--log={log}"]) == 0
    assert main(["adapt", base, *QUICK, "--log", str(log)]) == 2  # the file exists already
    text = log.read_text()
    assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d mipmap-plugin adapt ", text)
    for part in ("x0.5: ", "made for renderers that draw as 3DGS does", "seconds: ", "; backend cpu", "exists already; pass --overwrite"):
        assert part in text
    assert text.count("mipmap-plugin adapt ") == 2


def test_a_log_that_cannot_be_written_is_one_sentence(tmp_path, capsys):
    assert main(["backends", "--log", str(tmp_path / "nowhere" / "log")]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and "cannot be written" in said.err and "give --log another file" in said.err


def test_a_log_is_no_pipe_that_nobody_may_open(tmp_path, capsys):
    os.mkfifo(tmp_path / "log")
    assert main(["list", "recipes", "--log", str(tmp_path / "log")]) == 2
    assert "log cannot be written (a pipe with a name, whose other end nobody may open); give --log another file" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["backends", "--log"], ["backends", "--log", "--json"], ["backends", "--log="]])
def test_a_log_needs_a_file(words):
    with pytest.raises(SettingsError, match="--log needs a file"):
        options(words)


def test_the_two_options_are_taken_from_anywhere():
    assert options(["--log", "a", "adapt", "x", "--quiet", "--seed", "1"])[0] == ["adapt", "x", "--seed", "1"]


@pytest.mark.parametrize("content", [b"ply\nformat binary_little_endian 1.0\n", b"{}", b"2026-11-25 notes of mine\n"])
def test_a_log_is_not_appended_to_what_is_none(base, tmp_path, capsys, content):
    """As to a checkpoint, where the file after --log was forgotten."""
    (tmp_path / "mine").write_bytes(content)
    assert main(["inspect", base, "--no-viewers", "--log", str(tmp_path / "mine")]) == 2
    assert "holds something else than a log" in capsys.readouterr().err and (tmp_path / "mine").read_bytes() == content


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a device that is always full")
def test_a_log_that_can_be_written_no_more_does_not_end_the_command(base, capsys):
    assert main(["inspect", base, "--no-viewers", "--log", "/dev/full"]) == 0
    said = capsys.readouterr()
    assert "verdict:" in said.out and said.err.count("\n") == 1 and "the log ends here" in said.err


NOISY = """
import os, subprocess, sys
from mipmap_plugin.cli import main
from mipmap_plugin.commands import list

def facts(kind):
    subprocess.run([sys.executable, "-c", "print('of a child')"])
    os.write(1, b"of a library")
    return {"built in": []}

list._facts = facts
sys.exit(main(["list", "recipes", "--json"]) or os.write(1, b"after") - 5)
"""


def test_json_is_alone_on_the_standard_output_whatever_prints_past_python():
    done = subprocess.run([sys.executable, "-c", NOISY], capture_output=True, text=True)
    printed = done.stdout.removesuffix("after")
    assert done.returncode == 0 and printed != done.stdout and json.loads(printed) == {"recipes": {"built in": []}}
    assert "of a child" in done.stderr and "of a library" in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a device that is always full")
def test_what_cannot_be_printed_is_one_sentence():
    with open("/dev/full", "w") as full:
        done = subprocess.run(LISTS, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "standard output cannot be written (No space left" in done.stderr


def test_whoever_stops_reading_ends_the_command_in_silence():
    with subprocess.Popen(LISTS, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


@pytest.mark.parametrize("closed", ["", "2>&-", ">&- 2>&- <&-"])
def test_any_name_and_any_closed_stream_are_coped_with(tmp_path, closed):
    """In an encoding that lacks what a sentence has, and a name that is no text."""
    file = os.fsencode(tmp_path) + b"/\xff\xc3.ply"
    os.rename(tiny.ply(tmp_path / "a.ply"), file)
    line = b"exec " + shlex.quote(sys.executable).encode() + b" -m mipmap_plugin inspect " + file + b" --no-viewers --log log " + closed.encode()
    settings = {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0", "LC_ALL": "C"}
    done = subprocess.run(["sh", "-c", line], cwd=tmp_path, env={**os.environ, **settings}, capture_output=True, check=False)
    assert done.returncode == 0 and b"Traceback" not in done.stderr
    assert "verdict:" in (tmp_path / "log").read_text()
