"""Memory that commands keep."""

import ctypes
import platform
import subprocess
import sys

import pytest

from mipmap_plugin.process.freed_memory import keep_freed_memory, return_freed_memory

# Blocks of memory as tensors have them.
BLOCKS = """
import ctypes, re, resource, sys
from mipmap_plugin.process.freed_memory import keep_freed_memory, return_freed_memory
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
libc.memset.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t]
def filled(count, size):
    blocks = [libc.malloc(size) for _ in range(count)]
    for block in blocks:
        libc.memset(block, 1, size)
    return blocks
"""

# Fills and frees 120 MiB again and again, and prints the page faults of that.
FAULTS_OF_BLOCKS = BLOCKS + """
if sys.argv[1:]:
    assert keep_freed_memory()
def fill_and_free():
    for block in filled(5, 24 << 20):
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


# Frees 90 MiB below a block that stays, as the arrays of a phase, and prints what the process holds before and after giving it back, in MiB.
RETURNED = BLOCKS + """
assert keep_freed_memory()
blocks = filled(4, 30 << 20)
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
