"""Garbage collection is off where it only costs time, and nowhere else."""

import gc
import subprocess
import sys

import pytest
import tiny

from mipmap_plugin.process.garbage import uncollected


def test_it_is_off_in_the_block_and_on_afterwards():
    with pytest.raises(ValueError), uncollected():
        assert not gc.isenabled()
        raise ValueError
    assert gc.isenabled()


def test_it_stays_off_where_it_was():
    gc.disable()
    try:
        with uncollected():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_a_command_leaves_its_objects_at_exit_to_the_system():
    code = """
import atexit, contextlib, gc
atexit.register(lambda: print(gc.get_freeze_count() > 0))  # the last to be called
from mipmap_plugin.cli import main
main(["--version"])
main(["list", "families"])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "True"


def test_what_a_command_imports_is_imported_without_collections_and_passed_over_later(tmp_path):
    code = f"""
import gc
collections = []
gc.callbacks.append(lambda phase, info: collections.append(info["generation"]))
from mipmap_plugin.commands.common import wrap
from mipmap_plugin.jobs.base import Base
from pathlib import Path
gc.collect()
collections.clear()
wrap(Base(Path({str(tiny.folder(tmp_path / 'base', tiny.cameras()))!r})), 1)
print(len(collections), gc.get_freeze_count() > 100_000)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["0", "True"]
