"""Memory that commands keep."""

from __future__ import annotations

import ctypes
import platform
import subprocess
import sys

import pytest

from mipmap_plugin.process.freed_memory import keep_freed_memory, return_freed_memory

# Fills and frees 120 MiB again and again, in blocks of 24 MiB as tensors have them, and prints the page faults of that.
FAULTS_OF_BLOCKS = """
import ctypes, resource, sys
from mipmap_plugin.process.freed_memory import keep_freed_memory, return_freed_memory
if sys.argv[1:]:
    assert keep_freed_memory()
libc, size = ctypes.CDLL(None), 24 << 20
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
libc.memset.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t]
def fill_and_free():
    blocks = [libc.malloc(size) for _ in range(5)]
    for block in blocks:
        libc.memset(block, 1, size)
    for block in blocks:
        libc.free(block)
for _ in range(5):
    fill_and_free()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(10):
    fill_and_free()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="this C library has no mallopt")
def test_freed_memory_is_kept():
    commands = [[sys.executable, "-c", FAULTS_OF_BLOCKS, *words] for words in ([], ["keep"])]
    without, kept = (int(subprocess.run(command, capture_output=True, check=True).stdout) for command in commands)
    assert kept < without / 4


def test_without_glibc_nothing_is_set(monkeypatch):
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    assert not keep_freed_memory()


# Frees 90 MiB below a block that stays, as the arrays of a phase, and prints what the process holds before and after giving it back, in MiB.
RETURNED = """
import ctypes, re
from mipmap_plugin.process.freed_memory import keep_freed_memory, return_freed_memory
assert keep_freed_memory()
libc, size = ctypes.CDLL(None), 30 << 20
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
libc.memset.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t]
blocks = [libc.malloc(size) for _ in range(4)]
for block in blocks:
    libc.memset(block, 1, size)
for block in blocks[:3]:
    libc.free(block)
held = lambda: int(re.search(r"VmRSS:\\s+(\\d+)", open("/proc/self/status").read())[1]) // 1024
before = held()
return_freed_memory()
print(before - held())
"""


@pytest.mark.skipif(platform.system() != "Linux" or platform.libc_ver()[0] != "glibc", reason="this C library has no malloc_trim, or no /proc")
def test_freed_memory_is_given_back_when_asked():
    assert int(subprocess.run([sys.executable, "-c", RETURNED], capture_output=True, check=True).stdout) > 80


def test_without_glibc_nothing_is_asked_of_the_c_library(monkeypatch):
    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    monkeypatch.setattr(ctypes, "CDLL", None)
    return_freed_memory()
    assert not keep_freed_memory()
