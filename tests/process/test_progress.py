"""What takes long is announced on a terminal, and nowhere else."""

import io
import os
import sys
import time
from contextlib import suppress

import pytest
import tiny
from running import wait_until

from mipmap_plugin import progress
from mipmap_plugin.cli import _our_warnings_only
from mipmap_plugin.errors import warn
from mipmap_plugin.wrap import wrap_model

pytestmark = pytest.mark.usefixtures("few_views")


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("terminal, patience, line", [(True, 0.01, "merging x0.25: 00:0"), (True, 60, ""), (False, 0.01, "")])
def test_long_work_is_announced_on_a_terminal_alone(terminal, patience, line, monkeypatch):
    errors = Terminal() if terminal else io.StringIO()
    monkeypatch.setattr(sys, "stderr", errors)
    monkeypatch.setattr(progress, "PATIENCE", patience)
    monkeypatch.setattr(progress, "PERIOD", 0.01)
    with progress.announced("merging x0.25"):
        time.sleep(0.2 if patience < 1 else 0)
    assert line in errors.getvalue() and bool(errors.getvalue()) == bool(line)


def test_short_work_one_after_the_other_is_announced_when_together_it_takes_long(monkeypatch):
    """A run has a dozen phases, on a slow machine each of nearly a second."""
    monkeypatch.setattr(sys, "stderr", errors := Terminal())
    monkeypatch.setattr(progress, "PATIENCE", 3600)
    monkeypatch.setattr(progress, "PERIOD", 60)
    monkeypatch.setattr(progress, "_silent_since", time.monotonic() - 3600)
    monkeypatch.setattr(progress, "_ended_at", time.monotonic() - 1)
    with progress.announced("merging"):
        wait_until(lambda: "merging: " in errors.getvalue())
    shown = errors.getvalue()
    with progress.announced("writing"):
        pass
    assert errors.getvalue() == shown


def test_what_a_command_took_to_begin_counts_as_silence(monkeypatch):
    monkeypatch.setattr(sys, "stderr", errors := Terminal())
    monkeypatch.setattr(progress, "PATIENCE", 3600)
    monkeypatch.setattr(progress, "_silent_since", 0.0)
    monkeypatch.setattr(progress, "_ended_at", 0.0)
    progress.silent_since(time.monotonic() - 3600)
    with progress.announced("starting"):
        wait_until(lambda: "starting: " in errors.getvalue())


class Log:
    """What a program may put in the place of standard error, to have it in a file of its own."""

    written = ""

    def write(self, text):
        self.written += text


def closed():
    stream = io.StringIO()
    stream.close()
    return stream


@pytest.mark.parametrize("stream", [None, Log(), closed()])
def test_a_program_without_a_standard_error_adapts(stream, tmp_path, monkeypatch):
    """As one that runs in the background, or without a window."""
    monkeypatch.setattr(sys, "stderr", stream)
    wrapped = wrap_model(tiny.model(10), cameras=tiny.cameras(2), backend="cpu", threads=1)
    adapted = wrapped.adapt(1 / 2, steps=1, extra_views=2, validation_views=2)
    assert list(progress.counted([adapted.save(tmp_path / "new.ply")], 1, "saving", "file"))
    assert not getattr(stream, "written", "")


def test_what_takes_seconds_of_a_large_scene_is_announced(tmp_path, monkeypatch):
    told = []
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setattr(progress, "_show", lambda what, ended: told.append(what))
    wrapped = wrap_model(tiny.model(10), cameras=tiny.cameras(2), backend="cpu", threads=1)
    wrapped.adapt(1 / 2, recipe="instant").save(tmp_path / "new.ply")
    assert {"examining views", "writing new.ply"} <= set(told)


def test_the_clock_of_a_bar_goes_on_while_nothing_is_counted(monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.01)
    monkeypatch.setattr(sys, "stderr", errors := Terminal())
    with progress.Bar(total=2) as bar, progress.ticking(bar):
        shown = errors.getvalue()
        wait_until(lambda: errors.getvalue() != shown)
    monkeypatch.setattr(sys, "stderr", silent := io.StringIO())
    with progress.Bar(total=2) as bar, progress.ticking(bar):
        time.sleep(0.05)
    assert not silent.getvalue()


def test_a_warning_has_a_line_of_its_own_above_a_bar(monkeypatch):
    """It was appended to what the bar showed."""
    monkeypatch.setattr(sys, "stderr", errors := Terminal())
    with progress.Bar(total=2, desc="adapting"), _our_warnings_only():
        errors_before = errors.getvalue()
        warn("mind this")
    assert "adapting" in errors_before and "\rmipmap-plugin: mind this\n" in errors.getvalue()


def test_a_terminal_that_knows_no_size_shows_bars(monkeypatch):
    """As a serial line does: tqdm takes one of 0 lines for one without room."""
    pytest.importorskip("termios")
    ours, theirs = os.openpty()
    with open(theirs, "w") as terminal:
        monkeypatch.setattr(sys, "stderr", terminal)
        assert os.get_terminal_size(theirs) == (0, 0)
        assert list(progress.counted(range(3), 3, "counting", "thing")) == [0, 1, 2]
    with open(ours, "rb", buffering=0) as screen, suppress(OSError):  # the error at its end, as the terminal is closed
        shown = b""
        while part := screen.read(4096):
            shown += part
    assert b"counting: 100%" in shown
