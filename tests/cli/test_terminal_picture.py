"""Pictures in terminals: what is written, read back as a terminal reads it, and which terminals it is written to."""

import base64
import io
import os
import re
import threading

import numpy as np
import pytest
import tiny
import torch
from PIL import Image

from mipmap_plugin import wrap_model
from mipmap_plugin.cli import main
from mipmap_plugin.commands import terminal_picture
from mipmap_plugin.commands.terminal_picture import GAP, before_and_after, protocol_here, shown_view
from mipmap_plugin.formats import terminal
from mipmap_plugin.formats.terminal import encoded, has_sixels, protocol_by_name

pytestmark = pytest.mark.usefixtures("few_views")

KITTY = re.compile(r"\x1b_G([^;]*);([^\x1b]*)\x1b\\")


def picture(height=13, width=40):
    """Four flat colors, so that a palette holds them all."""
    image = torch.zeros(height, width, 3)
    image[: height // 2, :, 0] = 1.0
    image[:, width // 3 :, 2] = 0.4
    return image


def of_kitty(text):
    """The picture that Kitty's protocol carries."""
    chunks = KITTY.findall(text)
    assert chunks[0][0].startswith("a=T,f=100,q=2,") and [keys.endswith("m=1") for keys, _ in chunks] == [True] * (len(chunks) - 1) + [False]
    assert all(len(data) <= terminal.CHUNK for _, data in chunks)
    return Image.open(io.BytesIO(base64.b64decode("".join(data for _, data in chunks))))


def of_sixels(text):
    """The picture of sixels, [H, W, 3]; columns of a band start where `$` returns to, and `-` goes to the next six rows."""
    head = re.match(r'\x1bP0;1q"1;1;(\d+);(\d+)', text)
    width, height = map(int, head.groups())
    palette, image, x, top, color = {}, torch.zeros(height, width, 3), 0, 0, None
    for define, r, g, b, select, count, symbol in re.findall(r"#(\d+);2;(\d+);(\d+);(\d+)|#(\d+)|(?:!(\d+))?([?-~$-])", text[head.end() : -2]):
        if define:
            palette[define] = torch.tensor([int(r), int(g), int(b)]) / 100
        elif select:
            color = palette[select]
        elif symbol == "$":
            x = 0
        elif symbol == "-":
            x, top = 0, top + 6
        else:
            for row in range(6):
                if (ord(symbol) - 63) >> row & 1:
                    image[top + row, x : x + int(count or 1)] = color
            x += int(count or 1)
    return image


def test_kitty_gets_a_png_in_chunks():
    noise = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0))
    text = encoded(noise, "kitty")
    assert len(KITTY.findall(text)) > 2 and KITTY.sub("", text) == ""
    shown = torch.from_numpy(np.array(of_kitty(text), dtype=np.float32)) / 255
    assert (shown - noise).abs().max() < 1 / 255


@pytest.mark.parametrize("height", [6, 13])
def test_sixels_show_the_picture(height):
    assert (of_sixels(encoded(picture(height), "sixel")) - picture(height)).abs().max() < 0.02


@pytest.mark.parametrize(("environment", "protocol"), [
    ({"TERM": "xterm-kitty"}, "kitty"),
    ({"TERM": "xterm-256color", "KITTY_WINDOW_ID": "1"}, "kitty"),
    ({"TERM": "xterm-256color", "TERM_PROGRAM": "WezTerm"}, "kitty"),
    ({"TERM": "xterm-256color", "TERM_PROGRAM": "Apple_Terminal"}, None),
    ({"TERM": "tmux-256color", "KITTY_WINDOW_ID": "1", "TMUX": "/tmp/tmux"}, None),
    ({}, None),
])  # fmt: skip
def test_terminals_with_kittys_protocol_are_known_by_their_names(environment, protocol):
    assert protocol_by_name(environment) == protocol


@pytest.fixture
def fake(monkeypatch):
    """A terminal that answers the question for its features."""
    pytest.importorskip("termios")
    monkeypatch.setattr(terminal, "PATIENCE_S", 5.0)
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp())  # it is nobody's terminal, so that nothing is in its foreground
    ours, theirs = os.openpty()
    heard = []

    def answering(answer):
        def listen():
            heard.append(os.read(ours, 64))
            os.write(ours, answer)

        threading.Thread(target=listen, daemon=True).start()
        return theirs

    yield answering, heard
    os.close(ours)
    os.close(theirs)


@pytest.mark.parametrize(("answer", "sixels"), [
    (b"\x1b[?62;4;22c", True), (b"\x1b[?64;1;2;22c", False), (b"\x1b[?4c", False), (b"\x1b[?62;14;24c", False),
])  # fmt: skip
def test_a_terminal_is_asked_for_sixels(fake, answer, sixels):
    import termios

    answering, heard = fake
    asked = answering(answer)
    before = termios.tcgetattr(asked)
    assert has_sixels(asked) is sixels
    assert heard == [b"\x1b[c"] and termios.tcgetattr(asked) == before


def test_a_terminal_that_does_not_answer_has_none(fake, monkeypatch):
    monkeypatch.setattr(terminal, "PATIENCE_S", 0.05)
    assert not has_sixels(fake[0](b"")) and not has_sixels(os.open(os.devnull, os.O_RDWR))


@pytest.fixture
def in_kitty(monkeypatch):
    """Standard output as a Kitty window."""
    monkeypatch.setenv("TERM", "xterm-kitty")
    for name in terminal.BETWEEN:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(terminal_picture, "is_terminal", lambda stream: True)


def test_nothing_is_shown_where_output_is_no_terminal(monkeypatch):
    monkeypatch.setenv("TERM", "xterm-kitty")
    assert protocol_here() is None


def test_a_terminal_without_abilities_is_not_asked(monkeypatch, in_kitty):
    monkeypatch.setenv("TERM", "dumb")
    assert protocol_here() is None


def test_adapt_ends_with_a_picture_of_before_and_after(tmp_path, capsys, in_kitty):
    folder = tiny.folder(tmp_path / "base", [*tiny.cameras(3), *tiny.cameras(1, seed=9, split="test")])
    words = ["adapt", str(folder), "--scale", "1/2", "--output", str(tmp_path / "out"), "--recipe", "instant", "--views", "given"]
    words += ["--backend", "reference"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert said.splitlines()[2].startswith("before and after, view view_0:")
    shown = of_kitty(said)
    assert shown.size == (2 * 20 * 16 + GAP, 20 * 12)  # 16 x 12 px, each enlarged to 20 x 20
    for silent in ("--quiet", "--json"):
        assert main([*words, "--overwrite", silent]) == 0
        assert not KITTY.search(capsys.readouterr().out)


def test_the_picture_is_what_the_viewer_draws():
    base = wrap_model(tiny.model(), cameras=tiny.cameras(3), backend="reference")
    adapted = base.adapt(1 / 2, recipe="instant", viewer="spark")
    view = shown_view(adapted)
    image = before_and_after(base, adapted, view)
    left, right = image[::20, : 20 * 16 : 20], image[::20, 20 * 16 + GAP :: 20]
    assert torch.equal(left, base.render(view, viewer="spark").image.clamp(0, 1)) and torch.equal(right, adapted.render(view).image.clamp(0, 1))
