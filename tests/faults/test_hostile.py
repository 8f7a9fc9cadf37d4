"""Files crafted to hang, exhaust memory or execute code: each is refused quickly, in one sentence, with memory in proportion to its size."""

import io
import json
import os
import pickle
import signal
import struct
import subprocess
import sys
import zipfile
from collections import OrderedDict
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from corpus import SAMPLES
from png_files import RGBA, write_png

from mipmap_plugin.errors import CheckpointError, MipmapPluginError, SettingsError
from mipmap_plugin.formats.images import read_image
from mipmap_plugin.formats.state_dict import read_state_dict
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.formats.torchscript import read_torchscript
from mipmap_plugin.models import load_model
from mipmap_plugin.scenes import load_scene

MIB = 2**20


@contextmanager
def within(seconds: int):
    """A hang is an error."""

    def ring(*_):
        raise AssertionError(f"it took more than {seconds} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


MEASURED = """
import json, resource, sys
from pathlib import Path
from mipmap_plugin.errors import MipmapPluginError
from mipmap_plugin.formats.torch_file import load_torch
from mipmap_plugin.formats.torchscript import read_torchscript
from mipmap_plugin.formats.images import read_image
readers = {"torch": load_torch, "script": read_torchscript, "image": lambda path: read_image(path, (0, 0, 0))}
most = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
for kind, path in json.loads(sys.argv[1]):
    before, said = most(), "read"
    try:
        readers[kind](Path(path))
    except MipmapPluginError as error:
        said = str(error)
    print(json.dumps([path, (most() - before) / 2**20, said]))
"""


def taken(files: list[tuple[str, Path]]) -> dict[Path, tuple[float, str]]:
    """By file: by how many MiB reading it raises the peak memory of one process for all, and the message of the error."""
    words = json.dumps([(kind, str(path)) for kind, path in files])
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", MEASURED, words], capture_output=True, text=True, check=False, timeout=100)
    assert done.returncode == 0, done.stderr
    lines = map(json.loads, done.stdout.splitlines())
    return {Path(path): (memory, message) for path, memory, message in lines}


def torch_file(path: Path, program: bytes, storages: dict[str, bytes] = {}) -> Path:  # noqa: B006
    """A file of torch.save whose pickle is `program`."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/data.pkl", program)
        archive.writestr("a/version", "3\n")
        archive.writestr("a/byteorder", "little")
        for name, content in storages.items():
            archive.writestr(f"a/data/{name}", content)
    return path


def called(name: str, *arguments: bytes) -> bytes:
    """A pickle of what a function returns; the arguments are pickled already."""
    module, _, function = name.rpartition(".")
    return b"\x80\x02c" + f"{module}\n{function}\n".encode() + b"(" + b"".join(arguments) + b"tR."


def number(value: int) -> bytes:
    return b"J" + struct.pack("<i", value)


def word(text: str) -> bytes:
    return b"X" + struct.pack("<I", len(text)) + text.encode()


VOID = called("numpy.dtype", word("V1500000000"))[2:-1]
BOMBS = {
    "bytearray": called("builtins.bytearray", number(2_000_000_000)),
    "a NumPy scalar": called("numpy.core.multiarray.scalar", VOID, b"C\x00"),
    "a NumPy type": called("numpy.dtype", word("V1500000000")),
    "a tensor of a size": called("torch.FloatTensor", number(500_000_000)),
    "a tensor of sizes": called("torch.Tensor", number(50_000), number(50_000)),
    "a wrapper": called("torch._utils._rebuild_wrapper_subclass", number(1)),
    "bytes that may be changed": b"\x80\x05\x96" + struct.pack("<Q", 2_000_000_000) + b"x.",
    "a place in the memo": b"\x80\x02K\x01r" + struct.pack("<I", 400_000_000) + b".",
}


def of_older_format(path: Path, program: bytes) -> Path:
    facts = (pickle.dumps(fact, 2) for fact in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True}))
    path.write_bytes(b"".join([*facts, program, pickle.dumps([], 2)]))
    return path


# Of the tensor below: the storage "0" of one number, and what comes before and after its sizes.
STORAGE = b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x01tQ"


def tensor(count: int, stride: int) -> bytes:
    """A pickled tensor of `count` numbers, `stride` apart, whose storage holds one."""
    sizes = b"(" + number(count) + b"t(" + number(stride) + b"t"
    return b"ctorch._utils\n_rebuild_tensor_v2\n(" + STORAGE + b"K\x00" + sizes + b"\x89ccollections\nOrderedDict\n)RtR"


def packed(path: Path) -> Path:
    """A sound file of 200 MB of zeros, made small."""
    content = io.BytesIO()
    torch.save({"a": torch.zeros(50_000_000)}, content)
    with zipfile.ZipFile(content) as plain, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in plain.namelist():
            archive.writestr(name, plain.read(name))
    return path


def test_no_small_file_takes_much_memory(tmp_path):
    executed = "holds more than plain tensors and is not executed"
    one = {"0": bytes(4)}
    grows = torch_file(tmp_path / "grows.pth", b"\x80\x02}" + word("a") + tensor(1_000_000_000, 1) + b"s.", one)
    script = torch_file(tmp_path / "a.pt", b"\x80\x02c__torch__\nM\n)\x81}" + word("a") + tensor(60_000_000, 0) + b"sb.", one)
    wanted = {
        **{("torch", torch_file(tmp_path / f"{what}.pth", program)): executed for what, program in BOMBS.items()},
        **{("torch", of_older_format(tmp_path / f"{what}, older.pth", program)): executed for what, program in BOMBS.items()},
        ("torch", grows): executed,
        ("torch", packed(tmp_path / "packed.pth")): "its numbers unpack to more than it is on disk",
        ("script", script): "its tensors claim more numbers than the file holds",
        ("image", write_png(tmp_path / "bomb.png", (5000, 5000), RGBA, bytes(5000 * 5000 * 4))): "no photograph",
        ("image", write_png(tmp_path / "sound.png", (2000, 2000), RGBA, bytes(2000 * 2000 * 4))): "read",
    }
    for (path, (memory, said)), sentence in zip(taken(list(wanted)).items(), wanted.values(), strict=True):
        assert sentence in said and memory < 2000 * 2000 * 40 / MIB, (path.name, memory, said)


class Overwritten(OrderedDict):
    """Pickled, an ordered dictionary in whose attributes `items` is something else."""

    def __reduce__(self):
        return OrderedDict, (), {"items": 5, "keys": 5, "values": None}, None, iter(dict.items(self))


@pytest.mark.parametrize("name", ["deform.pth", "deformation.pth", "checkpoints.pth", "ckpt of gsplat", "ckpt of splatfacto"])
def test_dictionaries_whose_methods_are_overwritten_are_refused(tmp_path, name):
    path, file = SAMPLES[name].make(tmp_path / "m"), tmp_path / "m" / SAMPLES[name].damaged

    def overwritten(content):
        return Overwritten({key: overwritten(value) for key, value in content.items()}) if isinstance(content, dict) else content

    torch.save(overwritten(torch.load(file, weights_only=False)), file)
    with pytest.raises(CheckpointError, match="its dictionaries have attributes"):
        load_model(path)


def test_attributes_of_torchs_own_dictionaries_are_read(tmp_path):
    torch.save(torch.nn.Linear(2, 2).state_dict(), tmp_path / "a.pth")
    assert hasattr(torch.load(tmp_path / "a.pth"), "_metadata")
    assert sorted(read_state_dict(tmp_path / "a.pth")) == ["bias", "weight"]


def test_numpy_scalars_of_schedulers_are_read(tmp_path):
    torch.save({"rates": [np.float64(0.5), np.float32(0.25), np.int64(7), np.bool_(True)], "é": 1}, tmp_path / "a.pth")
    assert load_torch(tmp_path / "a.pth")["rates"] == [0.5, 0.25, 7, True]


# TorchScript


def nested(names: list[str]) -> bytes:
    """The pickle of modules in one another by these names, the last of which holds a tensor."""
    module = b"c__torch__\nM\n)\x81"
    opened = b"".join(module + b"}" + word(name) for name in names)
    return b"\x80\x02" + opened + tensor(1, 1) + b"sb" * len(names) + b"."


def test_nested_names_take_a_time_that_grows_with_the_file(tmp_path):
    path = torch_file(tmp_path / "a.pt", nested(["a", "b"]), {"0": bytes(4)})
    assert list(read_torchscript(path)) == ["a.b"]
    path = torch_file(tmp_path / "a.pt", nested(["name"] * 30_000), {"0": bytes(4)})
    with within(10), pytest.raises(CheckpointError, match="its modules are nested too deep, or their names too long"):
        read_torchscript(path)


# What is no file


@pytest.mark.parametrize("node", ["pipe", "loop", "dangling", "/dev/zero"])
def test_pipes_loops_and_devices_end_in_one_sentence(tmp_path, node):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "dangling").symlink_to(tmp_path / "nothing")
    os.mkfifo(tmp_path / "pipe")
    for read in (load_model, load_scene, load_torch, read_torchscript, lambda path: read_image(path, (0, 0, 0))):
        with within(5), pytest.raises(MipmapPluginError) as told:
            read(tmp_path / node)
        assert node in str(told.value) and "\n" not in str(told.value)


def test_a_pipe_in_the_place_of_a_part_of_a_checkpoint_ends_in_one_sentence(tmp_path):
    for name in ("ply", "cfg_args", "cameras.json", "opacity_mlp.pt", "ckpt of gsplat", "config.yml", "deform.pth"):
        path, file = SAMPLES[name].make(tmp_path / name), tmp_path / name / SAMPLES[name].damaged
        file.unlink()
        os.mkfifo(file)
        with within(5):
            try:
                load_model(path)
            except (CheckpointError, SettingsError) as error:
                assert "\n" not in str(error)


def test_the_reason_is_not_cut_off_in_the_advice_of_another_library(tmp_path):
    """Torch says for a page how to execute the file all the same."""
    path = torch_file(tmp_path / "a.pth", b"(S'splats'\nI1\ntd.", {})
    with pytest.raises(CheckpointError, match=r"save it again \(Unsupported operand \d+\)$"):
        load_torch(path)


def test_long_texts_of_a_damaged_file_are_shortened_in_messages(tmp_path):
    (tmp_path / "a.ply").write_text(f"ply\nformat ascii 1.0\nelement {'a' * 5000} 1\nproperty float x\nend_header\n1\n")
    with pytest.raises(CheckpointError, match=r"has no vertex element.* \.\.\. .*a'\]$") as caught:
        load_model(tmp_path / "a.ply")
    assert len(str(caught.value)) < 2000
