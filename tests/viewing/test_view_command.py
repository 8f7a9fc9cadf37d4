"""`view`: what it tells, refuses and serves."""

import socket
import sys
import warnings
from itertools import pairwise
from unittest.mock import MagicMock

import pytest
import tiny
from live_screen import wish

from mipmap_plugin.cli import main
from mipmap_plugin.commands import view
from mipmap_plugin.commands.view import _choices, _free, has_display
from mipmap_plugin.errors import MipmapPluginWarning, SettingsError
from mipmap_plugin.splatting.viewers import find_viewer
from mipmap_plugin.viewing.adapting import Progress
from mipmap_plugin.viewing.controls import MARKS, STOPS, figures, words
from mipmap_plugin.viewing.server import NO_VISER, check_address, foreign_page, served
from mipmap_plugin.viewing.sources import File
from mipmap_plugin.viewing.stage import Look

# Words


def test_the_figures_are_told(stage, screen):
    text = figures(stage.draw(Look("base", against="supersampled"), screen))
    assert "64 × 48 px" in text and "of 60 splats" in text and "dB apart" in text and "· base" in text


def test_names_are_told_as_they_are(stage, screen, base):
    """The panel takes Markdown, with HTML and scripts in it."""
    odd, shown = "<b>a_*b*_&amp;.ply", r"\<b\>a\_\*b\*\_\&amp;.ply"
    name = stage.add(File(odd, base))
    assert f"· {shown}\n" in figures(stage.draw(Look(name), screen))
    assert words(Progress(wish(base), trouble=f"{odd} is gone")) == f"×0.5 for renderers that draw as its training did: {shown} is gone"


def test_a_run_is_told_from_its_beginning_to_its_end(base):
    request = wish(base, viewer="spark")
    assert words(Progress()) == "" and words(Progress(request)) == "×0.5 for spark: preparing ..."
    assert words(Progress(request, step=7, curve=((0.0, 20.0),))) == "×0.5 for spark: step 7"
    done = words(Progress(request, adapted=base.adapt(1 / 2, recipe="instant", viewer="spark")))
    assert "dB on views that nothing was adapted to" in done and "60 → 60 splats" in done


# The command


def test_without_viser_the_command_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", str(tiny.ply(tmp_path / "base.ply")), "--no-browser"]) == 2
    assert capsys.readouterr().err.strip() == f"mipmap-plugin: {NO_VISER}"
    assert 'pip install "mipmap-plugin[view]"' in NO_VISER and 'pip install ".[view]"' in NO_VISER


def test_a_viewer_is_listed_once_under_the_name_that_was_asked_for(base):
    viewers, _ = _choices(base, "supersplat")
    assert viewers[:2] == ["supersplat", None] and "playcanvas" not in viewers
    assert {"classic", "spark", "aframe"} < {*viewers} and not {"inria", "drei", "threejs"} & {*viewers}
    assert find_viewer("drei") is find_viewer("aframe")  # whose shader it has


@pytest.mark.parametrize(("options", "message"), [
    (["--port", "70000"], "port: must be from 0 to 65535"),
    (["--output", __file__], "give --output a folder"),
    (["--viewer", "portable"], "portable"),
    (["--viewer", "nonsense"], "there is no viewer 'nonsense'"),
    (["--threads", "0"], "threads must be at least 1"),
])  # fmt: skip
def test_wrong_options_are_told(tmp_path, capsys, options, message):
    words = ["view", str(tiny.ply(tmp_path / "base.ply")), "--no-browser"]
    assert main([*words, *options]) == 2 and message in capsys.readouterr().err


@pytest.mark.parametrize(("asked", "served", "told"), [(8080, 8080, ""), (8080, 8081, " (port 8080 is taken)"), (0, 40123, "")])
def test_a_port_that_is_taken_is_told(tmp_path, monkeypatch, capsys, asked, served, told):
    page = MagicMock(address=f"http://127.0.0.1:{served}", **{"run.side_effect": KeyboardInterrupt})
    monkeypatch.setattr(view, "_page", lambda *_: page)
    assert main(["view", str(tiny.ply(tmp_path / "base.ply")), "--no-browser", "--port", str(asked)]) == 0
    assert f":{served} shows base.ply{told}; Ctrl-C ends it\n" in capsys.readouterr().out


def test_an_address_that_cannot_be_served_is_told():
    with pytest.raises(SettingsError, match="nothing can be served at"):
        check_address("192.0.2.1", 8080)  # an address for documentation, which no machine has
    check_address("127.0.0.1", 0)


@pytest.mark.parametrize(("page", "host", "taken"), [
    (None, "", True),  # no browser
    ("http://127.0.0.1:{port}", "", True),
    ("http://localhost:{port}", "localhost:{port}", True),  # through ssh -L
    ("https://scenes.example", "scenes.example", True),  # behind a proxy
    ("http://evil.example", "", False),
    ("http://127.0.0.1:1", "", False),
    ("null", "", False),  # a file
])  # fmt: skip
def test_only_its_own_page_sees_the_scene(server, page, host, taken):
    """A browser lets every page talk to this machine, and says which one does."""
    headers = ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="]
    headers += ["Host: " + (host or "127.0.0.1:{port}"), *([] if page is None else [f"Origin: {page}"])]
    port = server.get_port()
    with warnings.catch_warnings(record=True) as told, socket.create_connection(("127.0.0.1", port)) as connection:
        warnings.simplefilter("always")
        connection.sendall("\r\n".join(["GET / HTTP/1.1", *headers, "", ""]).format(port=port).encode())
        assert connection.recv(99).split()[1] == (b"101" if taken else b"403")
    ours = [str(each.message) for each in told if each.category is MipmapPluginWarning]
    assert len(ours) == (not taken) and all(f"a page of '{page}' asked".format(port=port) in each for each in ours)


@pytest.mark.parametrize(("page", "foreign"), [("https://scenes.example", False), ("https://inner", False), ("https://evil", True), ("null", True)])
def test_several_proxies_name_their_hosts_in_a_list(page, foreign):
    headers = {"Origin": page, "Host": "127.0.0.1:8080", "X-Forwarded-Host": "scenes.example, inner", "Upgrade": "websocket"}
    assert foreign_page(headers) == foreign and foreign_page(headers | {"X-Forwarded-Host": ""})


def test_a_browser_that_is_closed_while_its_picture_is_drawn_is_nothing_to_warn_of(monkeypatch):
    pytest.importorskip("websockets", reason="viser is not installed")
    monkeypatch.setitem(sys.modules, "viser", MagicMock())
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        served("127.0.0.1", 0)
        warnings.warn("Queued a BackgroundImageMessage on a closed connection (e.g. ...); it will never be delivered.", stacklevel=1)
    assert told == []


def test_what_is_saved_takes_a_free_name(tmp_path):
    (tmp_path / "bicycle").mkdir()
    free = _free(tmp_path / "bicycle", None)
    assert free(0.25, "spark") == tmp_path / "bicycle_x0.25_spark"
    (tmp_path / "bicycle_x0.25_spark").mkdir()
    assert free(0.25, "spark") == tmp_path / "bicycle_x0.25_spark_2"
    (tmp_path / "base.ply").touch()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "base_x0.5.ply").touch()
    assert _free(tmp_path / "base.ply", tmp_path / "out")(0.5, None) == tmp_path / "out" / "base_x0.5_2.ply"


def test_a_display_is_known_by_the_environment(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert not has_display()
    monkeypatch.setenv("DISPLAY", ":0")
    assert has_display()


def test_the_names_on_the_slider_have_room_on_a_phone():
    """On a screen of 360 px the slider of viser has 88 px, and a letter 4."""
    low, high, _ = STOPS
    ends = [(88 * (stop - low) / (high - low), 4 * len(name) / 2) for stop, name in MARKS]
    assert all(left[0] + left[1] < right[0] - right[1] for left, right in pairwise(ends))
