"""What `default` reaches in a twentieth, a tenth and a fifth of the time that `paper` takes, on real bases against real test images (protocol P3).

    python benchmarks/tenth.py DATA --only lego_200

DATA as of `real_bases.py`. At each scale `paper` runs to its end, then `default` with these parts of its seconds as time budget; the
test views are held out from all. Writes tenth/<base>.json for each base, and tenth.md from all of them.
"""

from __future__ import annotations

from pathlib import Path

import torch
import tyro
from bases import judge_of
from real_bases import SCALES, bases_of
from rows import write_page, write_rows

from mipmap_plugin import wrap_model
from mipmap_plugin.evaluation.evaluate import Evaluator, Row, adapted_row
from mipmap_plugin.evaluation.measure import adapt_alone
from mipmap_plugin.wrap import Wrapped

# Parts of `paper`'s seconds that `default` gets.
PARTS = {"a twentieth": 1 / 20, "a tenth": 1 / 10, "a fifth": 1 / 5}

INTRO = """# A tenth of the time

Made by `python benchmarks/tenth.py DATA`: `paper` to its end, and `default` with parts of the seconds that it took. Protocol P3, mean of
the test views, all held out; one thread of a shared machine, one after the other. The seconds are those of the whole, with merging, the
closed form and validation. A run ends with the step and the check in which its part is used up, and where the start alone takes longer,
that is judged.
"""


def rows_of(model: Wrapped, judge: Evaluator, scale: float) -> list[Row]:
    model.adapt(scale, steps=1)  # what is compiled and cached at first use is billed to neither
    paper = adapt_alone(model, scale, recipe="paper", views="train")
    rows = [adapted_row("paper", paper, judge)]
    for name, part in PARTS.items():
        default = adapt_alone(model, scale, time_budget_s=part * paper.report.seconds["total"])
        rows.append(adapted_row(f"default, {name}", default, judge))
    return rows


def main(
    data: tyro.conf.Positional[Path],
    output: Path = Path("benchmarks/results"),
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    views: int = 25,
) -> None:
    """Measure, and write the tables.

    Args:
        data: The folder with checkpoints/ and images/.
        output: Where the results go; rows of bases that were measured before are replaced.
        only: Which bases; all by default.
        views: How many of the test views are judged.
    """
    torch.set_num_threads(1)
    for base in bases_of(data, only):
        model = wrap_model(data / "checkpoints" / "bases" / base)
        judge = judge_of(model, data, base, views)
        rows = [row for scale in SCALES[base] if scale != 1 for row in rows_of(model, judge, scale)]
        write_rows(output / "tenth" / f"{base}.json", rows)
    write_page(output / "tenth.md", INTRO, output.glob("tenth/*.json"))


if __name__ == "__main__":
    tyro.cli(main)
