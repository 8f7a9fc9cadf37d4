"""The GPU benchmark where there is no GPU: its parts on a processor, and the one sentence that it ends with."""

import runpy
import sys
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import gpu
import gpu_adaptation
import gpu_conformance
import gpu_first_use
import gpu_profile
import gpu_speed
import pretended
import pytest
import tiny
import torch
from gpu_adaptation import Base, Place
from gpu_conformance import check
from gpu_gsplat import Itself
from gpu_profile import of_trace
from gpu_records import Adaptation, Checked, Failure, Kernel, Profile, Speed, Views
from gpu_results import Results, report
from gpu_speed import Scene, denser
from gpu_tables import speed_table
from gpu_timing import Clock
from gpu_views import Shots, measure
from gsplat_stand_in import StandIn

from mipmap_plugin import load_model
from mipmap_plugin.backends.conformance import Outcome
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.backends.triton import interpreted
from mipmap_plugin.effects import Effects

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"

OURS = Speed("triton", "classic", 1_000_000, 1920, 1080, 1.0, 4.0, 100.0, 10**9, 2 * 10**9)
THEIRS = Speed("gsplat itself", "classic", 1_000_000, 1920, 1080, 2.0, 5.0, 200.0, 10**9, 2 * 10**9)
ADAPTED = Adaptation("lego_200", 0.25, "triton", 2.94, 2.5, 3.0, 400, "400 steps", 612.0, 33.87, 33.9, {"total": 2.94, "optimization": 2.5})
MACHINE = {"device": "NVIDIA H200 (SXM)", "memory_gib": 139}


def cells(table: str, row: int) -> list[str]:
    return [cell.strip() for cell in table.splitlines()[2 + row].strip("|").split("|")]


def test_without_a_gpu_it_says_so(monkeypatch, capsys):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(sys, "argv", ["gpu.py"])
    with pytest.raises(SystemExit, match="2"):
        runpy.run_path(str(BENCHMARKS / "gpu.py"), run_name="__main__")
    said = capsys.readouterr()
    assert (said.out, said.err.strip()) == ("", gpu.NO_GPU)


def measured(names, modes, case=(300, 64, 48)):
    return [record for work in gpu_speed.works(names, [case], "cpu", 1, modes) for record in work.function(*work.arguments)]


def test_every_backend_is_measured_on_every_scene():
    records = measured(["reference", "gsplat"], ("classic", "playcanvas"))
    rows = [record for record in records if isinstance(record, Speed)]
    assert [(row.backend, row.mode, row.splats, row.width, row.height) for row in rows] == [
        ("reference", mode, 300, 64, 48) for mode in ("classic", "playcanvas")
    ]
    assert all(row.forward_ms > 0 and row.both_ms > 0 for row in rows)
    failures = [record for record in records if isinstance(record, Failure)]
    assert [(failure.backend, failure.what) for failure in failures] == [
        (name, f"as {mode}") for mode in ("classic", "playcanvas") for name in ("gsplat", "gsplat itself")
    ]
    assert "it runs on cuda, not on cpu" in failures[0].reason and "splats that fade to 0" in failures[2].reason


def test_the_least_that_moves_is_counted():
    scene = Scene.of(300, 64, 48, "cpu")
    assert scene.parameter_bytes == 300 * (3 + 3 + 4 + 1 + 48) * 4
    (row,) = measured(["reference"], ("classic",))
    pixels = 64 * 48 * 4 * 4  # bytes of an image and its alpha
    assert (row.forward_bytes, row.both_bytes) == (scene.parameter_bytes + pixels, 3 * scene.parameter_bytes + 2 * pixels)


def test_millions_of_splats_are_made_from_fewer_on_the_same_surfaces(monkeypatch):
    few = Scene.of(3000, 64, 48, "cpu").raw
    many = denser({name: tensor.detach() for name, tensor in few.items()}, 4)
    assert len(many["means"]) == 12_000
    moved = (many["means"].unflatten(0, (4, 3000)) - few["means"]).norm(dim=-1)
    assert (moved <= 3**0.5 * few["log_scales"].exp().amax(1)).all() and moved.max() > 0
    torch.testing.assert_close(many["log_scales"].exp()[:3000], few["log_scales"].exp() / 2)
    monkeypatch.setattr("gpu_speed.MOST_GENERATED", 1000)
    assert len(Scene.of(2500, 64, 48, "cpu").raw["means"]) == 2500


def test_small_views_are_timed_alone_and_together():
    shots = Shots.of(tiny.gaussians(), tiny.cameras(2))
    alone, both = measure("reference", shots, "cpu", 1), measure("cpu", shots, "cpu", 1)
    assert (alone.width, alone.views, alone.together_ms) == (32, 2, None) and alone.alone_ms > 0
    assert both.together_ms > 0 and alone.step_ms > 0 and both.step_ms > 0


@pytest.mark.interpreter
@pytest.mark.skipif(not (interpreted() and find_spec("triton")), reason="triton is not installed, or TRITON_INTERPRET is not 1")
def test_the_least_that_each_kernel_moves_is_counted():
    least = gpu_profile.least_bytes(Scene.of(40, 16, 12, "cpu"))
    assert least["project_kernel"] == 40 * 4 * (11 + 48 + 9 + 5) and least["composite_kernel"] > 16 * 12 * 16
    assert (least["composite_kernel"] - 16 * 12 * 16) % 36 == 0


def test_kernels_are_read_from_a_trace_with_what_they_leave_idle():
    args = {"est. achieved occupancy %": 40, "registers per thread": 64}
    launch = dict(cat="kernel", name="composite_kernel", dur=30.0, args=args)
    others = [dict(cat="gpu_memset", name="Memset", dur=4.0), dict(cat="cpu_op", name="add", dur=9.0), {"ph": "M"}]
    events = [launch, {**launch, "dur": 50.0}, *others]
    assert of_trace(events, 2, {"composite_kernel": 1000}) == [
        Kernel("composite_kernel", 40.0, 1.0, 40.0, 64, 1000), Kernel("Memset", 2.0, 0.5, None, None, None)
    ]  # fmt: skip


def test_speeds_are_compared_with_gsplat_in_the_same_run():
    table = speed_table([THEIRS, OURS], bandwidth=1e12).split("\n\n")[-1]
    assert cells(table, 1) == ["1,000,000", "1920 x 1080", "classic", "triton", "1.00", "4.00", "2.00 / 1.25", "500", "50.0%", "100"]
    assert cells(speed_table([OURS], bandwidth=1e12).split("\n\n")[-1], 0)[6] == "-"
    assert speed_table([], 1e12) == ""


def test_wrong_cases_are_named():
    outcomes = [Outcome("fine", 0.0, True, True, ""), Outcome("odd", 0.5, True, False, "differs"), Outcome("left", 0.0, True, True, "", skipped=True)]
    page = report(Results(MACHINE, conformance=[Checked.of("triton", outcomes)]))
    assert "| triton  | 1 of 2           | 1          | 0           |" in page and "- triton, odd: differs" in page


def test_what_is_missing_is_short_and_what_had_no_time_is_one_line():
    late = [Failure("inria", what, "no time was left", late=True) for what in ("x2", "x4")]
    page = report(Results(MACHINE, failures=[Failure("gsplat", "x2", "it does not support " + 99 * "this, "), *late]))
    assert page.endswith("- No time was left for inria x2; inria x4.") and max(map(len, page.splitlines())) < 300


def test_hard_cases_are_shared_among_processes():
    *_, checked = check("reference", "cpu", 2, ("one-splat", "sh-degree-0", "views"))
    assert checked == Checked("reference", 3, 1, {})


def test_views_and_steps_are_checked_where_there_are_any():
    views, steps = gpu_conformance._outcomes("cpu", "cpu", ["views", "steps"])
    assert views.passed and steps.passed and not (views.skipped or steps.skipped)


def test_a_case_that_breaks_its_process_fails_alone(monkeypatch):
    wrong = Outcome("b", 0.0, True, False, "AcceleratorError: CUDA error: an illegal memory access was encountered")
    monkeypatch.setattr(gpu_conformance, "check_backend", lambda backend, cases, device: [replace(wrong, case=case) for case in cases])
    monkeypatch.setattr(gpu_conformance, "_broken", False)
    assert [outcome.case for outcome in gpu_conformance._outcomes("reference", "cpu", ["one-splat", "sh-degree-0"])] == ["one-splat"]
    assert gpu_conformance._outcomes("reference", "cpu", ["sh-degree-0"]) == []


def test_the_report_and_its_files_are_named_after_the_device(tmp_path):
    results = Results(MACHINE, 4e12)
    for record in (OURS, Failure("inria", "", "it is not there"), ADAPTED, Views("triton", 50, 4, 0.5, None, 0.6), Checked("triton", 2, 1, {})):
        results.add(record)
    results.add(Profile("triton", 300, 64, 48, 200.0, [Kernel("kernel", 100.0, 2.0, 31.5, 64, 10**8)]))
    results.add(replace(OURS, both_ms=4.5))
    results.save(tmp_path)
    text = (tmp_path / "nvidia_h200_sxm.md").read_text()
    assert text.startswith("# NVIDIA H200 (SXM)\n\nMade by `python benchmarks/gpu.py --data DATA`; memory_gib 139. A copy moves 4000 GB/s")
    assert "## Not measured\n\n- inria: it is not there" in text
    assert "| `kernel` | 100 | 50%             | 2        | 1000 | 25%         | 31.5%     | 64 " in text
    again = Results.of(MACHINE, tmp_path)
    assert again == results and again.speed == [replace(OURS, both_ms=4.5)]


def test_bases_are_adapted_and_judged(tmp_path):
    tiny.folder(tmp_path / "checkpoints" / "bases" / "ball_32", tiny.cameras(2), count=20)
    tiny.scene(tmp_path / "images" / "ball", count=20)
    place = Place(tmp_path, "reference", "cpu", settings=(("steps", 4), ("extra_views", 1), ("validation_views", 2), ("merge_to", 1.0)))
    ball, absent, split = Base("ball_32", 1), Base("absent_100", 1), Base("ball_32", 1, 90)
    works = gpu_adaptation.works(place, [(ball, 1 / 2), (absent, 2), (split, 1 / 2)])
    assert [work.title for work in works] == ["adaptation: reference: ball_32 x0.5", "adaptation: reference: ball_32 in 90 x0.5"]
    row, larger = (record for work in works for record in work.function(*work.arguments))
    assert (row.base, row.scale, row.backend, row.ended_by, row.processor_db) == ("ball_32", 0.5, "reference", "4 steps", None)
    assert row.psnr_db > 15 and row.seconds > 0 and row.again_seconds > 0 and row.phases["total"] == row.seconds
    assert larger.base == "ball_32 in 90"
    [late] = gpu_adaptation.adapt_one(ball, 1 / 2, "playcanvas", replace(place, until=time.monotonic()))
    assert (late.viewer, late.steps, late.ended_by) == ("playcanvas", 0, "the end of the time")


def test_what_a_first_command_waits_for_is_measured(tmp_path, monkeypatch):
    tiny.folder(tmp_path / "checkpoints" / "bases" / gpu_first_use.BASE, tiny.cameras(2, width=16, height=12), count=5)
    usual, viewer = gpu_first_use.works("reference", tmp_path)
    assert (usual.what, viewer.what) == ("first use", "first use playcanvas")
    monkeypatch.setattr(gpu_first_use, "STEPS", 1)
    few = "from mipmap_plugin.recipes import DEFAULT_OUT; DEFAULT_OUT |= dict(extra_views=2, validation_views=2)"
    monkeypatch.setattr(gpu_first_use, "COMMAND", f"{few}; {gpu_first_use.COMMAND}")
    [row] = usual.function(*usual.arguments)
    assert row.first_s > row.compilation_s > 0 and row.again_s > 0
    page = report(Results(MACHINE, first_uses=[gpu_first_use.FirstUse("triton", "", 21.04, 9.5, 8.0, 0.4)]))
    assert cells(page.split("\n\n")[-1], 0) == ["triton", "-", "21.0", "9.5", "8.0", "0.4"]
    monkeypatch.setattr(gpu_first_use, "COMMAND", "raise SystemExit('there is no such backend')")
    with pytest.raises(RuntimeError, match="there is no such backend"):
        list(gpu_first_use.measure("nobody", "", tmp_path))


def test_adaptations_stand_beside_the_processors_and_the_papers():
    page = report(Results(MACHINE, adaptation=[ADAPTED]))
    table = next(part for part in page.split("\n\n") if part.startswith("| base"))
    expected = ["lego_200", "x0.25", "-", "triton", "2.94", "2.50", "400", "33.87", "33.90", "612", "optimization 2.50", "400 steps"]
    assert cells(table, 0) == expected and "40 s for a zoom-out and 75 s for a zoom-in" in page


def test_the_processors_own_results_are_read():
    assert gpu_adaptation.on_processor("lego_200", 1 / 4) > 30
    assert gpu_adaptation.on_processor("flowers_r8", 1 / 4) > 30
    assert gpu_adaptation.on_processor("no_such_base", 1 / 4) is None


def test_slow_calls_are_repeated_less(monkeypatch):
    monkeypatch.setattr("gpu_timing.BUDGET_S", 0.0)
    calls = []
    Clock("cpu").milliseconds(lambda: calls.append(1), 100)
    assert len(calls) == 3


@pytest.mark.parametrize("name", ["no-such-backend", "reference"])
def test_what_cannot_be_measured_is_said(name):
    able, reasons = gpu.served([name], "cpu")
    assert (able, reasons) == (([name], {}) if name == "reference" else ([], {name: "there is no such backend"}))


def test_the_slow_reference_is_measured_only_where_it_is_wanted():
    able = set(gpu.served([], "cpu")[0])
    assert "cpu" in able and "reference" not in able  # other tests may have registered more


def test_a_stand_in_for_a_larger_capture_is_made_on_the_device(tmp_path):
    model = load_model(tiny.folder(tmp_path / "base", tiny.cameras()))
    with pretended.pretending():
        larger = gpu_adaptation.denser(model.to(pretended.DEVICE), 150)
        assert len(larger) == 150 and larger.parameters()["means"].device.type == pretended.DEVICE


def test_gsplat_itself_draws_what_our_backend_asks_it_for(monkeypatch):
    gsplat = pytest.importorskip("gsplat", reason="gsplat is in the test extra")
    twin = StandIn()
    monkeypatch.setattr(gsplat, "rasterization", lambda *args, **named: twin(*args, **named, backgrounds=torch.zeros(1, 3)))
    splats, view = tiny.gaussians(20), tiny.cameras()[0]
    for effects in (Effects(1), Effects(1, "antialiased")):
        drawn, right = (backend.render(splats, view, effects) for backend in (Itself(), ReferenceBackend()))
        torch.testing.assert_close(drawn.image, right.image, atol=2e-3, rtol=0)
        torch.testing.assert_close(drawn.alpha, right.alpha, atol=2e-3, rtol=0)
