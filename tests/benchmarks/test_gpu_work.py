"""The GPU benchmark's pieces of work: what breaks or takes too long is a line, and the rest goes on. On a processor."""

import multiprocessing
import os
import time

import gpu
import gpu_adaptation
import gpu_conformance
import gpu_views
import pytest
import tiny
from gpu_adaptation import Base
from gpu_records import Failure
from gpu_results import Results
from gpu_work import DONE, Work, carry_out, forget, kept

WHOLE = {"part": 1.0, "other": 1.0}


def numbers(*values):
    yield from values


def nothing_but_an_error():
    raise ZeroDivisionError("by zero")
    yield


def the_end_of_the_process():
    yield 1
    os._exit(3)


def broken_context():
    yield Failure("b", "w", "AcceleratorError: CUDA error: an illegal memory access was encountered")
    yield 2


def what_never_ends():
    yield 1
    time.sleep(600)


def piece(function, *arguments, part="part", seconds=0.0):
    return Work(part, "b", function.__name__, seconds, function, arguments)


def done(works, seconds=120.0, until=WHOLE):
    began = time.monotonic()
    return [record for _, record in carry_out(works, began, began + seconds, until)]


@pytest.fixture
def forked(monkeypatch):
    """Processes that import nothing anew."""
    if "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("needs fork")
    monkeypatch.setattr("gpu_work.get_context", lambda _: multiprocessing.get_context("fork"))


@pytest.mark.usefixtures("forked")
def test_what_breaks_a_piece_is_a_line_and_the_next_piece_begins():
    first, *records = done([piece(nothing_but_an_error), piece(the_end_of_the_process), piece(broken_context), piece(numbers, 5, 6)])
    assert first == Failure("b", "nothing_but_an_error", "ZeroDivisionError: by zero")
    assert records[:4] == [DONE, 1, Failure("b", "the_end_of_the_process", "its process ended"), DONE]
    assert records[4].reason.startswith("AcceleratorError") and records[5:] == [DONE, 5, 6, DONE]


@pytest.mark.usefixtures("forked")
def test_what_takes_too_long_is_cut_off_and_not_done(monkeypatch):
    monkeypatch.setattr("gpu_work.STARTING_S", 1.0)
    records = done([piece(numbers, 4, seconds=30.0), piece(what_never_ends), piece(numbers, 5, seconds=30.0)])
    assert records == [4, DONE, 1, Failure("b", "what_never_ends", "it was cut off, for its time was over", late=True), 5, DONE]


@pytest.mark.usefixtures("forked")
def test_parts_wait_for_others_where_their_share_of_the_time_is_over():
    works = [piece(numbers, 1), piece(numbers, 2, part="other"), piece(numbers, 3, part="other", seconds=1e6)]
    *records, last = done(works, until={"part": 0.0, "other": 1.0})
    assert records == [2, DONE, 1, DONE]
    assert last == Failure("b", "numbers", "no time was left, for it takes 1000000 s", late=True)


def test_what_a_part_keeps_is_freed_before_the_next():
    made = []
    make = kept(lambda number: made.append(number) or number)
    assert [make(1), make(1)] == [1, 1] and made == [1]
    forget()
    assert make(1) == 1 and made == [1, 1]


@pytest.fixture
def data(tmp_path):
    for name in ("ball_32", gpu_views.BASE):
        tiny.folder(tmp_path / "checkpoints" / "bases" / name, tiny.cameras(), count=20)
    tiny.scene(tmp_path / "images" / "ball")
    return tmp_path


def request(data, seconds=300.0, parts=tuple(gpu.UNTIL)):
    began = time.monotonic()
    return gpu.Request(["cpu"], [(300, 64, 48)], ["classic"], data, 1, 2, began + seconds, "cpu", parts, began)


@pytest.mark.usefixtures("forked")
def test_the_whole_flow_fills_every_part_and_goes_on_with_what_was_missing(data, tmp_path, monkeypatch):
    monkeypatch.setattr(gpu, "FIRST", ((300, 64, 48),))
    monkeypatch.setattr(gpu_views, "WIDTHS", (32,))
    ball, check = Base("ball_32", 1), gpu_conformance.check
    place = gpu_adaptation.Place(data, "cpu", "cpu", settings=(("steps", 2), ("extra_views", 1), ("validation_views", 2)))
    monkeypatch.setattr(gpu_adaptation, "VIEWERS", ("playcanvas",))
    adaptations = [*gpu_adaptation.works(place, [(ball, 1 / 2)]), *gpu_adaptation.works_for_viewers(place, [(ball, 1 / 2)])]
    monkeypatch.setattr(gpu, "_adaptations", lambda *_: adaptations)
    monkeypatch.setattr(gpu, "_hard_cases", lambda name, r: Work("conformance", name, "hard cases", 1, check, (name, "cpu", 1, ("one-splat",))))
    wanted, machine = request(data), {"device": "a processor"}
    results = Results(machine)
    gpu.carry_on(request(data, seconds=0.0), results, tmp_path)
    assert results.done == [] and all(failure.late for failure in results.failures) and results.failures
    again = Results.of(machine, tmp_path)
    again.begin(wanted.parts, further=True)
    gpu.carry_on(wanted, again, tmp_path)
    assert again.failures == []
    assert [len(part) for part in (again.conformance, again.speed, again.views, again.profiles, again.adaptation)] == [1, 1, 2, 1, 2]
    assert again.bandwidth > 0 and len(again.done) == 7
    gpu.carry_on(request(data, seconds=0.0), again, tmp_path)
    assert again.failures == []  # nothing is left to do
    page = (tmp_path / "a_processor.md").read_text()
    assert "| playcanvas |" in page and "Not measured" not in page
