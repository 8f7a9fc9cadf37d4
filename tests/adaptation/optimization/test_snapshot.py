"""Snapshots: what a model held, put back into it or into a copy."""

import numpy as np
import pytest
import tiny
import torch

from mipmap_plugin.adaptation.optimization.snapshot import Snapshot


class Shared:
    """A model of one row parameter and one that all rows share."""

    def __init__(self, rows: int, number: float) -> None:
        self.rows = {"means": torch.full((rows, 3), number, requires_grad=True)}
        self.network = {"weight": torch.full((2,), number, requires_grad=True)}

    def parameters(self):
        return self.rows

    def shared_parameters(self):
        return self.network

    def replace_parameters(self, parameters):
        self.rows = parameters


def change(model) -> None:
    with torch.no_grad():
        for tensor in model.parameters().values():
            tensor += 1


def test_a_snapshot_does_not_follow_the_model():
    model = tiny.model(5)
    before = model.parameters()["means"].detach().clone()
    taken = Snapshot.of(model)
    change(model)
    assert torch.equal(taken.rows["means"], before) and not taken.rows["means"].requires_grad


def test_a_renewed_snapshot_takes_no_further_memory():
    model = tiny.model(5).copy()
    first = Snapshot.of(model)
    change(model)
    second = first.renewed(model, rows_changed=True)
    assert second.rows_changed and all(second.rows[name].data_ptr() == held.data_ptr() for name, held in first.rows.items())
    assert all(torch.equal(second.rows[name], tensor) for name, tensor in model.parameters().items())
    network = Snapshot.of(Shared(4, 0.0)).renewed(Shared(4, 2.0)).shared["weight"]
    assert network.tolist() == [2.0, 2.0]


@pytest.mark.parametrize("count", [3, 7])
def test_a_renewed_snapshot_takes_memory_for_more_rows_only(count):
    first, other = Snapshot.of(tiny.model(5)), tiny.model(count, seed=1)
    second = first.renewed(other)
    assert all((second.rows[name].data_ptr() == held.data_ptr()) is (count < 5) for name, held in first.rows.items())
    assert all(torch.equal(second.rows[name], tensor) for name, tensor in other.parameters().items())


def test_as_many_rows_keep_their_leaves():
    model = tiny.model(5).copy()
    before, taken = dict(model.parameters()), Snapshot.of(model)
    change(model)
    taken.put_into(model)
    for name, tensor in model.parameters().items():
        assert tensor is before[name] and torch.equal(tensor, taken.rows[name])


def test_other_rows_replace_the_leaves():
    model, taken = tiny.model(5).copy(), Snapshot.of(tiny.model(3, seed=1))
    before = dict(model.parameters())
    taken.put_into(model)
    for name, tensor in model.parameters().items():
        assert tensor is not before[name] and tensor.requires_grad and torch.equal(tensor, taken.rows[name])
    change(model)
    assert not torch.equal(model.parameters()["means"], taken.rows["means"])  # it can be put back again


def test_shared_parameters_keep_their_leaves_whatever_the_rows():
    for rows in (4, 7):
        model, taken = Shared(rows, 0.0), Snapshot.of(Shared(4, 2.0))
        weight = model.network["weight"]
        taken.put_into(model)
        assert model.network["weight"] is weight and weight.tolist() == [2.0, 2.0]
        assert torch.equal(model.rows["means"], taken.rows["means"])


@pytest.mark.parametrize("rows_changed", [True, False])
def test_columns_of_a_file_stay_with_the_rows_that_they_belong_to(rows_changed):
    began = tiny.model(5).with_extras({"confidence": np.arange(5, dtype=np.float32)})
    taken = Snapshot.of(tiny.model(5, seed=1), rows_changed)
    held = taken.over(began)
    assert all(torch.equal(tensor, taken.rows[name]) for name, tensor in held.parameters().items())
    assert ("confidence" in held.extras) != rows_changed
    assert "confidence" in began.extras and not torch.equal(began.parameters()["means"], taken.rows["means"])


@pytest.mark.parametrize("degree", [0, 2])
def test_a_snapshot_of_other_bands_is_put_into_as_many_splats(degree):
    model, taken = tiny.model(5, degree=1).copy(), Snapshot.of(tiny.model(5, degree=degree, seed=1))
    taken.put_into(model)
    assert model.sh_degree == degree and all(torch.equal(taken.rows[name], tensor) for name, tensor in model.parameters().items())
