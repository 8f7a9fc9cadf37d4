"""TorchScript archives give their weights bit by bit, and neither run nor read anything they should not."""

import io
import os
import pickle
import zipfile

import pytest
import torch
from anchor_checkpoints import Embedding, trace
from torch import nn

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.torchscript import read_torchscript


def traced(path):
    network = nn.Sequential(nn.Linear(5, 4), nn.ReLU(True), nn.Linear(4, 2), nn.Tanh())
    trace(network, network.state_dict(), torch.rand(1, 5), path)
    return network.state_dict()


def rewritten(path, change):
    """The archive with `change(name, content)` in place of each member; None leaves it out."""
    with zipfile.ZipFile(path) as archive:
        members = {name: change(name, archive.read(name)) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            if content is not None:
                archive.writestr(name, content)
    return path


def refused(path) -> str:
    with pytest.raises(CheckpointError) as caught:
        read_torchscript(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_weights_are_those_of_the_network(tmp_path):
    state = traced(tmp_path / "a.pt")
    read = read_torchscript(tmp_path / "a.pt")
    assert read.keys() == state.keys()
    assert all(torch.equal(read[name], state[name]) for name in state)


def test_nested_modules_have_dotted_names(tmp_path):
    network = Embedding(7, 3)
    trace(network, network.state_dict(), torch.zeros(1, dtype=torch.long), tmp_path / "a.pt")
    read = read_torchscript(tmp_path / "a.pt")
    assert torch.equal(read["embedding.weight"], network.embedding.weight)


@pytest.mark.parametrize(("name", "rows"), [("opacity_mlp", 10), ("cov_mlp", 70), ("color_mlp", 30)])
def test_real_networks_are_read(shared_data, name, rows):
    read = read_torchscript(shared_data / "checkpoints" / "octree_mlps" / f"{name}.pt")
    assert {key: tuple(held.shape) for key, held in read.items()} == {
        **{"0.weight": (32, 35), "0.bias": (32,)},
        **{"2.weight": (rows, 32), "2.bias": (rows,)},
    }
    assert all(bool(held.isfinite().all()) and float(held.std()) > 0 for held in read.values())


def test_an_archive_that_asks_for_a_function_is_refused_and_nothing_runs(tmp_path):
    class Call:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "proof"),)

    traced(tmp_path / "a.pt")
    rewritten(tmp_path / "a.pt", lambda name, content: pickle.dumps(Call(), 2) if name.endswith("/data.pkl") else content)
    assert "mkdir" in refused(tmp_path / "a.pt")
    assert not (tmp_path / "proof").exists()


def test_the_archives_own_programs_are_not_needed(tmp_path):
    state = traced(tmp_path / "a.pt")
    rewritten(tmp_path / "a.pt", lambda name, content: b"raise SystemExit" if "/code/" in name else content)
    assert torch.equal(read_torchscript(tmp_path / "a.pt")["0.bias"], state["0.bias"])


class Tensor:
    """Pickles as torch's tensors do: 20 numbers of which a view is asked for."""

    def __init__(self, offset=0, shape=(4, 5), strides=(5, 1), count=20):
        self.view, self.count = (offset, shape, strides), count

    def __reduce__(self):
        return torch._utils._rebuild_tensor_v2, (Storage(self.count), *self.view, False, None)


class Storage:
    def __init__(self, count):
        self.count = count


class Pickler(pickle.Pickler):
    def persistent_id(self, value):
        return ("storage", torch.FloatStorage, "0", "cpu", value.count) if isinstance(value, Storage) else None


@pytest.mark.parametrize(
    ("tensor", "sentence"),
    [
        (Tensor(offset=1), "outside its storage"),
        (Tensor(strides=(6, 1)), "outside its storage"),
        (Tensor(offset=19, strides=(-5, 1)), "outside its storage"),
        (Tensor(count=40, strides=(9, 1)), "shorter than declared"),
        (Tensor(count=10, shape=(1,), strides=(1,)), "larger than"),
        (Tensor(shape=(2**20, 2**20), strides=(0, 0)), "claim more numbers than the file holds"),
        (Tensor(shape=(4,), strides=(5, 1)), "argument"),
    ],
)
def test_a_view_that_does_not_fit_its_storage_is_refused(tmp_path, tensor, sentence):
    program = io.BytesIO()
    Pickler(program, 2).dump(tensor)
    with zipfile.ZipFile(tmp_path / "a.pt", "w") as archive:
        archive.writestr("a/data.pkl", program.getvalue())
        archive.writestr("a/data/0", bytes(80))
    assert sentence in refused(tmp_path / "a.pt")


def test_damaged_archives_are_one_sentence(tmp_path):
    traced(tmp_path / "a.pt")
    content = (tmp_path / "a.pt").read_bytes()
    (tmp_path / "cut.pt").write_bytes(content[: len(content) // 2])
    (tmp_path / "text.pt").write_text("not a zip")
    for name in ("cut.pt", "text.pt"):
        assert "no TorchScript network" in refused(tmp_path / name)
    assert "big-endian" in refused(rewritten(tmp_path / "a.pt", lambda name, held: b"big" if name.endswith("byteorder") else held))
    traced(tmp_path / "a.pt")
    assert "There is no item" in refused(rewritten(tmp_path / "a.pt", lambda name, held: None if name.endswith("data/0") else held))
