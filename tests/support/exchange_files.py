"""Files of exchange formats, and a stand-in for the tool that converts them."""

import json
import struct
import sys

import pytest

from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.models import load_model

# FORMATS §13, T5: a real record of a .splat file.
RECORD = bytes.fromhex("7a72abc1b6e792c1f011b5c1b6cbe23f9f59683f0c309c4075c9fffff779599a")
# Niantic's header: magic, version 3, one point, SH degree 0, 12 fractional bits, no flags.
SPZ = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 0, 0) + bytes(20)

# A stand-in for splat-transform: it returns the PLY beside it, and records its arguments. Its own choice is SPZ 4, which Spark does not read.
STAND_IN = """import json, pathlib, shutil
here = pathlib.Path(__file__).parent
if sys.argv[1:] == ["--version"]:
    sys.exit(print("splat-transform v3.7.0 (0a1b2c3)", file=sys.stderr))
*options, source, target = sys.argv[1:]
if ("--spz-version" in options) != target.endswith(".spz") or target.endswith(".spz") and options[options.index("--spz-version") + 1] != "3":
    sys.exit("Error: expected --spz-version 3 for SPZ, and for nothing else")
(here / "asked.json").write_text(json.dumps([options, source, target, pathlib.Path(source).read_bytes().hex()[:64]]))
if pathlib.Path(source).stat().st_size == 13:
    print("  ✗ Error: Invalid header\\n    at parseSpz (cli.mjs:37217:15)\\n✗ failed in 0.051s  [peak cpu=85.1MB]", file=sys.stderr)
    sys.exit(1)
shutil.copyfile(here / "answer.ply" if target.endswith("plain.ply") else source, target)
"""


def tool_request(tool):
    return json.loads((tool / "asked.json").read_text())


def answer_by(tool, script, name="splat-transform"):
    """Have a few lines of Python answer in place of the stand-in."""
    (tool / name).write_text(f"#!{sys.executable}\nimport os, sys\n{script}\n", encoding="utf-8")
    (tool / name).chmod(0o755)


def report_of(file):
    """What the report beside an adapted file says."""
    return json.loads(file.with_name(f"{file.name}.adaptation.json").read_text())


def sentence(path):
    with pytest.raises(CheckpointError) as caught:
        load_model(path)
    return str(caught.value)
