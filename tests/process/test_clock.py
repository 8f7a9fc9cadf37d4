"""What is timed on a GPU is timed until the GPU has done it."""

import math
from types import SimpleNamespace

import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization.costs import Costs
from mipmap_plugin.adaptation.optimization.validation import Quality
from mipmap_plugin.adaptation.start import clock as clock_module
from mipmap_plugin.adaptation.start import search
from mipmap_plugin.adaptation.start.clock import Clock
from mipmap_plugin.adaptation.start.search import best_start
from mipmap_plugin.process.clock import now

GPU = torch.device("cuda")


@pytest.fixture
def waited(monkeypatch):
    """The devices that the host waited for."""
    devices = []
    monkeypatch.setattr(torch.cuda, "synchronize", devices.append)
    return devices


def test_nothing_is_waited_for_on_a_processor(waited):
    assert now(None) <= now(torch.device("cpu")) and not waited
    assert now(GPU) and waited == [GPU]


def test_truths_and_checks_cost_until_the_gpu_has_made_them(waited):
    costs, (first, second) = Costs(device=GPU), tiny.cameras(2)
    costs.truth(first, lambda view: torch.zeros(1))
    assert len(waited) == 2
    costs.truth(first, lambda view: torch.zeros(1))  # it is known by now, so that no step waits for it
    assert len(waited) == 2
    costs.prepare([second], lambda views: None)
    costs.check(lambda: None)
    assert waited == [GPU] * 6


def test_a_start_counts_the_work_of_a_gpu(waited):
    clock = Clock(100.0, GPU)
    with clock.timing("weights"):
        pass
    assert clock.allows("weights") and waited == [GPU] * 4


@pytest.mark.parametrize(("end", "size"), [(1e9, 1.0), (1.0 + 3 * 12 * 4.0, 0.25), (1.0, 0.125)])  # seconds
def test_large_views_are_weighed_at_a_size_that_a_start_has_time_for(monkeypatch, end, size):
    """Where one of 1000 px takes a second."""
    seconds, tried = iter([0.0, 0.0, 1.0, 1.0]), []
    monkeypatch.setattr(clock_module, "now", lambda device: next(seconds))
    assert Clock(end, torch.device("cpu")).size(tiny.cameras(1)[0].resized(8000, 8000), 12, tried.append) == pytest.approx(size)
    assert tried == [0.125]


@pytest.mark.parametrize(("seconds", "pixels"), [(math.inf, 8000), (0.1, 1000)])
def test_views_are_weighed_as_they_are_without_a_budget_and_where_they_are_small(seconds, pixels):
    assert Clock(seconds, torch.device("cpu")).size(tiny.cameras(1)[0].resized(pixels, pixels), 12, pytest.fail) == 1.0


def test_nothing_is_tried_where_views_are_weighed_at_half_their_size_anyway():
    view, tried = tiny.cameras(1)[0], list[float]()
    clock = Clock(1000.0, torch.device("cpu"))
    assert clock.size(view.resized(1600, 1600), 12, pytest.fail, 0.5) == 0.5
    assert clock.size(view.resized(8000, 8000), 12, tried.append, 0.5) == 0.5 and tried == [1 / 8]


def test_a_further_start_has_the_time_that_the_first_has_left(monkeypatch):
    """Both together take at most half of a budget."""
    seconds, allowed = [0.0], []

    class Search:
        notes = ()

        def __init__(self, _, clock):
            self.clock = clock

        def best(self):
            with self.clock.timing("candidate"):
                seconds[0] += 4.0
            allowed.append(self.clock.allows("candidate"))
            return None, "the start"

    monkeypatch.setattr(clock_module, "now", lambda device: seconds[0])
    monkeypatch.setattr(search, "StartSearch", Search)
    quality, config = Quality(0.0, 0.0), SimpleNamespace(time_budget_s=20.0)
    best_start([SimpleNamespace(base=tiny.model, config=config, coarse_base=None, quality=lambda _: quality)] * 2)
    assert allowed == [True, False]


def test_a_start_expects_a_candidate_of_fewer_splats_to_take_less_time(monkeypatch):
    seconds = iter([0.0, 0.0, 2.0, 2.0, 2.0])  # of a candidate of half of the splats, in a start of three
    monkeypatch.setattr(clock_module, "now", lambda device: next(seconds))
    clock = Clock(3.0, torch.device("cpu"))
    with clock.timing("candidate", 0.5):
        pass
    assert clock.allows("candidate", 0.25) and not clock.allows("candidate", 0.3)
