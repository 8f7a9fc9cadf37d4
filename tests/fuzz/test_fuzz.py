"""Damaged files and odd commands: each ends well or in one sentence, in seconds, in a bounded memory, and nothing is run, lost or left."""

import importlib.util
import json
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import mutations
import pytest
import torch
from corpus import SAMPLES

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.models import load_model

COLMAP = importlib.util.find_spec("pycolmap") is not None
NAMES = [*(name for name in SAMPLES if COLMAP or not name.startswith("COLMAP")), "command line"]
BY_DEFAULT = 6  # inputs of each kind
ALL = 20_000  # inputs
WORKER = Path(__file__).with_name("worker.py")


def fuzzed(folder: Path, first: int, last: int) -> dict[str, list[dict]]:
    """How opening the damaged files `first` to `last` of each sample ended. A process that dies names the file that it died of."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PATH": ""}  # without splat-transform, for which the worker's limit of memory is too low
    command = [sys.executable, "-W", "ignore", str(WORKER), str(folder), str(first), str(last), *NAMES]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False, timeout=7200)
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, f"the process died ({done.returncode}) of {told[-1:]}: {done.stderr[-2000:]}"
    by_name = defaultdict(list)
    for each in told:
        if each["outcome"] is not None:
            by_name[each["name"]].append(each)
    return by_name


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    return fuzzed(tmp_path_factory.mktemp("fuzz"), 0, BY_DEFAULT)


def judge(told: list[dict], count: int) -> None:
    sound, *damaged = told
    assert sound["outcome"] == "loaded" or "which splat-transform reads, but splat-transform is not installed" in sound["outcome"]
    assert len(damaged) == count
    assert [each for each in damaged if each["outcome"].startswith("fault")] == []
    refused = [each["outcome"] for each in damaged if each["outcome"].startswith("refused")]
    assert all("\n" not in sentence and len(sentence) < 2000 for sentence in refused)


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_is_loaded_or_refused_in_one_sentence(outcomes, name):
    judge(outcomes[name], BY_DEFAULT)


@pytest.mark.fuzz
def test_thousands_of_damaged_files(tmp_path):
    each = -(-ALL // len(NAMES))
    for told in fuzzed(tmp_path, BY_DEFAULT, BY_DEFAULT + each).values():
        judge(told, each)


def test_the_corpus_is_damaged_enough_to_be_refused_and_not_so_much_that_all_is(outcomes):
    told = [each["outcome"].split(":")[0] for name in NAMES for each in outcomes[name][1:]]
    assert 0.2 < told.count("refused") / len(told) < 0.8


HUGE = {
    "vertices": "element vertex 1000000000000",
    "rows without columns before them": "element nothing 1000000000000\nelement vertex 12",
    "rows without columns behind them": "element vertex 12",  # the next line is put behind the properties
}


@pytest.mark.parametrize("name", ["ply", "ply, ascii", "ply, lists", "ply, ascii lists"])
@pytest.mark.parametrize("what", HUGE)
def test_counts_that_no_memory_holds_are_answered_at_once(tmp_path, name, what):
    path = SAMPLES[name].make(tmp_path / "m")
    content = path.read_bytes().replace(b"element vertex 12", HUGE[what].encode())
    if what.endswith("behind them"):
        content = content.replace(b"end_header", b"element nothing 1000000000000\nend_header")
    path.write_bytes(content)
    if what == "vertices":
        with pytest.raises(CheckpointError, match=r"its header declares 1,000,000,000,000 splats, but at least .* of them are missing"):
            load_model(path)
    else:
        assert len(load_model(path)) == 12


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("name", ["deform.pth", "checkpoints.pth", "ckpt of gsplat", "ckpt of splatfacto"])
def test_a_program_in_a_torch_file_is_not_run(tmp_path, name, zipped):
    path = SAMPLES[name].make(tmp_path / "m")
    file, canary = tmp_path / "m" / SAMPLES[name].damaged, tmp_path / "executed"
    torch.save({**torch.load(file, weights_only=False), "more": mutations.Bomb(canary)}, file, _use_new_zipfile_serialization=zipped)
    with pytest.raises(CheckpointError, match="holds more than plain tensors and is not executed"):
        load_model(path)
    assert not canary.exists()
    torch.load(file, weights_only=False)
    assert canary.exists()  # the file was one that could


@pytest.mark.parametrize(
    "tensor", [torch.ones(1).expand(10**12), torch.ones(2, device="meta"), torch.eye(2).to_sparse(), torch.ones(2, dtype=torch.complex64)], ids=str
)
def test_tensors_that_are_not_plain_numbers_in_the_file_are_refused(tmp_path, tensor):
    torch.save({"a": [{"b": tensor}]}, tmp_path / "a.pth")
    with pytest.raises(CheckpointError, match=r"a\.pth is damaged, or holds more than plain tensors .* tensor"):
        load_torch(tmp_path / "a.pth")
