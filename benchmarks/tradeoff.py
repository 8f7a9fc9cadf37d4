"""The README's picture of what accuracy costs, and its tables: lego zoomed out and zoomed in, by `mipmap-plugin tradeoff`.

    python benchmarks/tradeoff.py DATA

DATA holds `checkpoints/bases/<scene>_<px>` (3DGS model folders) and `images/<scene>` (NeRF-Synthetic folders). Writes
results/tradeoff_<name>.md with the command and what it printed, .json with every point, and .png.
"""

from __future__ import annotations

import contextlib
import io
import shutil
import tempfile
from pathlib import Path

import torch
import tyro

from mipmap_plugin.cli import main as mipmap_plugin

EVERY_RECIPE = "--recipe default --recipe instant --recipe paper"

# By name: the command's words. At x4 an image of the reference backend takes seconds, so that none is drawn by it.
RUNS = {
    "x0.125": f"DATA/checkpoints/bases/lego_200 --images DATA/images/lego --scale 1/8 {EVERY_RECIPE} --views 5",
    "x4": f"DATA/checkpoints/bases/lego_100 --images DATA/images/lego --scale 4 {EVERY_RECIPE} --views 3 --no-renderers",
}


def main(data: tyro.conf.Positional[Path], output: Path = Path("benchmarks/results"), only: tyro.conf.UseAppendAction[tuple[str, ...]] = ()) -> None:
    """Run both commands and keep what they say.

    Args:
        data: The folder with checkpoints/ and images/.
        output: Where the results go; those that are there are replaced.
        only: x0.125 or x4; both by default.
    """
    torch.set_num_threads(1)
    for name in only or RUNS:
        with tempfile.TemporaryDirectory() as folder:
            said = run(RUNS[name].replace("DATA", str(data)), folder)
            for suffix in ("json", "png"):
                shutil.copyfile(f"{folder}/tradeoff.{suffix}", output / f"tradeoff_{name}.{suffix}")
        (output / f"tradeoff_{name}.md").write_text(page(name, said), encoding="utf-8")


def run(words: str, folder: str) -> str:
    """What the command prints; its files are left in `folder`."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        code = mipmap_plugin(["tradeoff", *words.split(), "--output", folder])
    if code:
        raise SystemExit(code)
    return printed.getvalue()


def page(name: str, said: str) -> str:
    lines = said.rstrip().splitlines()
    end = max(number for number, line in enumerate(lines) if line.startswith("|"))
    sentences = "\n".join(f"- {line}" for line in lines[end + 1 :] if not line.startswith("written: "))  # to a folder that is gone
    return f"""# What accuracy costs in time: lego at {name}

Made by

    mipmap-plugin tradeoff {RUNS[name]} --output DIR

which `python benchmarks/tradeoff.py DATA` runs. Medians (and the whole range) of three runs with seeds of their own, on one thread of a busy
machine. What has 0 s needs a renderer that has it; the adapted file needs one that draws as 3DGS does. `s` and `ms`: on the Pareto front of seconds
to adapt, of milliseconds a frame. Every point, also those on the way: [tradeoff_{name}.json](tradeoff_{name}.json).

{lines[0]}

{chr(10).join(lines[1 : end + 1])}

{sentences}

![dB against seconds to adapt and against milliseconds a frame](tradeoff_{name}.png)
"""


if __name__ == "__main__":
    tyro.cli(main)
