"""One file of a chosen count: `adapt --splats` against splat-transform's --decimate and --decimate-adaptive, at a half and a quarter of the splats.

    python benchmarks/levels_counts.py DATA
    python benchmarks/levels_counts.py DATA --only flowers_r8 --recipe thorough --scale 1

Every file is drawn as the viewer draws, at cameras that nothing was adapted to, against the base itself: as it is at x1, supersampled below. What
decimation alone costs is shown too: the rival's splats, supersampled just as the base is. Needs what tests/browser/README.md installs with npm, or
splat-transform on the PATH. Writes levels_counts/<base>.json, row by row, and levels_counts.md from all in that folder. Rows that are there are not
measured again.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean

import torch
import tyro
from levels import Dolly, at, decimated
from rows import earlier

from mipmap_plugin import load_model, wrap_model
from mipmap_plugin.adaptation.adapted import render_model
from mipmap_plugin.camera import Camera
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.report import markdown
from mipmap_plugin.formats.atomic import write_json
from mipmap_plugin.formats.splat_transform import refuse_exchange
from mipmap_plugin.models.base import SplatModel
from mipmap_plugin.wrap import Wrapped

BASES = {"flowers_r8": "flowers_r8", "lego_200": "bases/lego_200"}
FRACTIONS, SCALES = (1 / 2, 1 / 4), (1.0, 1 / 2, 1 / 4)
RIVALS = {"splat-transform": "--decimate", "adaptive": "--decimate-adaptive"}

# Every so many-th camera of the base is held out.
EVERY = 35

# The viewer: what both bases were trained for.
VIEWER = "classic"

BROWSER = Path(__file__).parents[1] / "tests" / "browser" / "node_modules" / ".bin"

INTRO = """# Any chosen count

Made by `python benchmarks/levels_counts.py DATA`: dB against the base's own render, supersampled below x1, at cameras that nothing was adapted to,
drawn as classic renderers draw. *ours*: `adapt --splats COUNT --scale SCALE`. *base*: with all its splats. *splat-transform*, *adaptive*: the base,
decimated to as many splats by version 3.7.0, `--decimate` and `--decimate-adaptive`; in brackets, supersampled as the truth is, so that only
decimation is left. *lead*: of ours over the better of both in the viewer. *seconds*: of ours, one thread of a busy machine.
"""


@dataclass(frozen=True)
class Row:
    """One count at one scale; dB."""

    fraction: float  # of the base's splats
    splats: int
    scale: float
    ours: float
    seconds: float  # of ours
    base: float
    rivals: dict[str, float]
    supersampled: dict[str, float]  # the rivals
    recipe: str = "default"  # of ours


def measure(dolly: Dolly, file: Path, scales: Sequence[float], recipe: str) -> None:
    """Every count at every scale."""
    found = earlier(file, Row)
    source = dolly.base.model.source
    assert source is not None  # since the base was read from a file
    count = len(dolly.base.model.parameters()["means"])
    with tempfile.TemporaryDirectory() as folder:
        for fraction in FRACTIONS:
            rivals = dict[str, SplatModel]()
            for name, option in RIVALS.items():
                made = Path(folder) / f"{name}_{fraction}.ply"
                rivals[name] = load_model(decimated(refuse_exchange(made), source, round(count * fraction), made, option))
            for scale in scales:
                if (fraction, scale, recipe) not in {(each.fraction, each.scale, each.recipe) for each in found}:
                    found.append(row(dolly, rivals, fraction, scale, recipe))
                    write_json(file, [asdict(each) for each in found], overwrite=True)


def row(dolly: Dolly, rivals: dict[str, SplatModel], fraction: float, scale: float, recipe: str) -> Row:
    truths = {view: dolly.truth(view, scale) for view in dolly.views}

    def quality(draw: Callable[[Camera], torch.Tensor]) -> float:
        return fmean(psnr(draw(view).clamp(0, 1), truth) for view, truth in truths.items())

    def in_viewer(model: SplatModel) -> float:
        backend, _ = dolly.base.backend(viewer=VIEWER)
        return quality(lambda view: render_model(model, backend, at(view, scale), dolly.base.target(VIEWER)).image)

    def supersampled(model: SplatModel) -> float:
        its = Dolly(Wrapped(model, dolly.base.cameras, "auto", dolly.base.trained), dolly.views)
        return quality(lambda view: its.truth(view, scale))

    ours = dolly.base.adapt(scale, viewer=VIEWER, recipe=recipe, most_splats=round(len(dolly.base.model.parameters()["means"]) * fraction))
    return Row(
        fraction, len(ours.model.parameters()["means"]), scale, in_viewer(ours.model), ours.report.seconds["total"], in_viewer(dolly.base.model),
        {name: in_viewer(model) for name, model in rivals.items()}, {name: supersampled(model) for name, model in rivals.items()}, recipe,
    )  # fmt: skip


def page(results: Mapping[str, Sequence[Row]]) -> str:
    """A table for each base."""
    return "\n".join([INTRO, *(f"## {base}\n\n{table(found)}\n" for base, found in results.items())])


def table(found: Sequence[Row]) -> str:
    head = ["splats", "scale", "ours", "base", *RIVALS, "lead", "seconds", "recipe"]
    body = [
        [f"{each.splats:,}", f"x{each.scale:g}", f"{each.ours:.1f}", f"{each.base:.1f}",
         *(f"{each.rivals[name]:.1f} ({each.supersampled[name]:.1f})" for name in RIVALS),
         f"{each.ours - max(each.rivals.values()):+.1f}", f"{each.seconds:.0f}", each.recipe]
        for each in found
    ]  # fmt: skip
    return markdown(head, body)


def main(
    data: tyro.conf.Positional[Path],
    output: Path = Path("benchmarks/results"),
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    scale: tyro.conf.UseAppendAction[tuple[float, ...]] = (),
    recipe: str = "default",
) -> None:
    """Measure, and write the tables.

    Args:
        data: The folder with checkpoints/.
        output: Where the results go.
        only: Which bases; all by default.
        scale: 1, 0.5 and 0.25 by default.
        recipe: Of ours.
    """
    torch.set_num_threads(1)
    os.environ["PATH"] = f"{BROWSER}{os.pathsep}{os.environ['PATH']}"
    for name in only or BASES:
        whole = wrap_model(data / "checkpoints" / BASES[name], threads=1)
        held_out = whole.cameras[EVERY // 2 :: EVERY]
        kept = [camera for camera in whole.cameras if camera not in held_out]
        base = wrap_model(whole.model, cameras=kept, background=whole.background, threads=1)
        measure(Dolly(base, held_out), output / "levels_counts" / f"{name}.json", scale or SCALES, recipe)
    results = {file.stem: earlier(file, Row) for file in sorted((output / "levels_counts").glob("*.json"))}
    (output / "levels_counts.md").write_text(page(results), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
