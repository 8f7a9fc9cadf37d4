"""Commands in processes of their own, whose jobs save their states often."""

import os
import time
from pathlib import Path

# In the processes that do jobs, before they begin.
SAVE_OFTEN = """import sys
if "mipmap_plugin.jobs.serve" in sys.orig_argv:
    from mipmap_plugin.adaptation.optimization import resume
    resume.SAVE_EVERY_S = 0.2
"""


def saving_often(folder: Path) -> dict[str, str]:
    """The environment of a process whose jobs save their states five times a second."""
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(SAVE_OFTEN)
    return {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"}


def wait_until(condition, seconds=300):
    """Wait until `condition()` is true, and return what it says."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)
    return found
