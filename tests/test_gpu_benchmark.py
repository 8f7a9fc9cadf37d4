"""The GPU benchmark where there is no GPU: its parts on a processor, and the one sentence that it ends with."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import tiny
import torch

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
sys.path.append(str(BENCHMARKS))  # its modules import one another by bare names, as scripts do

import gpu  # noqa: E402
import gpu_adaptation  # noqa: E402
from gpu_adaptation import Adaptation  # noqa: E402
from gpu_tables import Failure, Speed, adaptation_table, conformance_table, report, speed_table  # noqa: E402
from gpu_timing import Clock, copied_per_second  # noqa: E402

from mipmap_plugin.backends.conformance import Outcome  # noqa: E402

OURS = Speed("triton", 1_000_000, 1920, 1080, 1.0, 4.0, 100.0, 10**9, 2 * 10**9)
THEIRS = Speed("gsplat", 1_000_000, 1920, 1080, 2.0, 5.0, 200.0, 10**9, 2 * 10**9)


def cells(table: str, row: int) -> list[str]:
    return [cell.strip() for cell in table.splitlines()[2 + row].strip("|").split("|")]


def test_without_a_gpu_it_says_so():
    done = subprocess.run([sys.executable, BENCHMARKS / "gpu.py"], capture_output=True, text=True, check=False, env={"CUDA_VISIBLE_DEVICES": ""})
    assert (done.returncode, done.stdout, done.stderr.strip()) == (2, "", gpu.NO_GPU)


def test_every_backend_is_measured_on_every_scene():
    rows, failures = gpu.measure_all(["reference", "gsplat"], [(300, 64, 48), (200, 32, 32)], "cpu", 1)
    assert [(row.backend, row.splats, row.width, row.height) for row in rows] == [("reference", 300, 64, 48), ("reference", 200, 32, 32)]
    assert all(row.forward_ms > 0 and row.both_ms > 0 for row in rows)
    assert [failure.what for failure in failures] == ["300 splats at 64 x 48 px", "200 splats at 32 x 32 px"]
    assert failures[0].reason.startswith("BackendUnavailable: backend 'gsplat' cannot do this")


def test_the_least_that_moves_is_counted():
    scene = gpu.Scene.of(300, 64, 48, "cpu")
    assert scene.parameter_bytes == 300 * (3 + 3 + 4 + 1 + 48) * 4
    rows, _ = gpu.measure_all(["reference"], [(300, 64, 48)], "cpu", 1)
    pixels = 64 * 48 * 4 * 4  # bytes of an image and its alpha
    assert (rows[0].forward_bytes, rows[0].both_bytes) == (scene.parameter_bytes + pixels, 3 * scene.parameter_bytes + 2 * pixels)


def test_speeds_are_compared_with_gsplat_in_the_same_run():
    table = speed_table([THEIRS, OURS], bandwidth=1e12)
    assert cells(table, 1) == ["1,000,000", "1920 x 1080", "triton", "1.00", "4.00", "2.00 / 1.25", "500", "50.0%", "100"]
    assert cells(speed_table([OURS], bandwidth=1e12), 0)[5] == "-"


def test_wrong_cases_are_named():
    outcomes = [Outcome("fine", 0.0, True, True, ""), Outcome("odd", 0.5, True, False, "differs"), Outcome("left", 0.0, True, True, "", skipped=True)]
    assert cells(conformance_table({"triton": outcomes}), 0) == ["triton", "1 of 2", "1", "odd"]
    assert conformance_table({}) == ""


def test_the_report_and_its_files_are_named_after_the_device(tmp_path, capsys):
    known = {"device": "NVIDIA H200 (SXM)", "memory_gib": 139}
    gpu.save(tmp_path, known, 4e12, [OURS], [Failure("inria", "", "it is not there")], {}, [])
    text = (tmp_path / "nvidia_h200_sxm.md").read_text()
    assert text.startswith("# NVIDIA H200 (SXM)\n\nmemory_gib 139. A copy moves 4000 GB/s") and text in capsys.readouterr().out
    assert "Not measured: inria: it is not there" in text
    kept = json.loads((tmp_path / "nvidia_h200_sxm.json").read_text())
    assert kept["speed"][0]["both_ms"] == 4.0 and kept["copied_bytes_per_second"] == 4e12


def test_bases_are_adapted_and_judged(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu_adaptation, "SCALES", {"ball_32": (1, 1 / 2), "absent_100": (1, 2)})
    tiny.folder(tmp_path / "checkpoints" / "bases" / "ball_32", tiny.cameras())
    tiny.scene(tmp_path / "images" / "ball")
    (row,) = gpu_adaptation.adaptations(tmp_path, ["reference"], "cpu", steps=4, extra_views=4)
    assert (row.base, row.scale, row.backend, row.ended_by, row.processor_db) == ("ball_32", 0.5, "reference", "4 steps", None)
    assert row.psnr_db > 15 and row.seconds > 0


def test_adaptations_stand_beside_the_processors_and_the_papers():
    table = adaptation_table([Adaptation("lego_200", 0.25, "triton", 2.94, 400, "400 steps", 612.0, 33.87, 33.9)])
    assert cells(table, 0) == ["lego_200", "x0.25", "triton", "2.9", "400", "33.87", "33.90", "612", "400 steps"]
    assert "40 s for a zoom-out and 75 s for a zoom-in" in table and table in report({"device": "x"}, 1e12, [], [], [
        Adaptation("lego_200", 0.25, "triton", 2.94, 400, "400 steps", 612.0, 33.87, 33.9)], "")  # fmt: skip


def test_the_processors_own_results_are_read():
    assert gpu_adaptation.on_processor("lego_200", 1 / 4) > 30
    assert gpu_adaptation.on_processor("no_such_base", 1 / 4) is None


def test_time_and_bandwidth_are_positive_on_a_processor():
    assert Clock("cpu").milliseconds(lambda: torch.ones(1000).sum(), 3) > 0
    assert copied_per_second("cpu", 1 << 20) > 0


def test_slow_calls_are_repeated_less(monkeypatch):
    monkeypatch.setattr("gpu_timing.BUDGET_S", 0.0)
    calls = []
    Clock("cpu").milliseconds(lambda: calls.append(1), 100)
    assert len(calls) == 3


@pytest.mark.parametrize("name", ["no-such-backend", "reference"])
def test_what_cannot_be_measured_is_said(name):
    able, reasons = gpu.served([name], "cpu")
    assert (able, reasons) == (([name], {}) if name == "reference" else ([], {name: "there is no such backend"}))
