"""The tables and the plot of benchmarks/levels.py."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from PIL import Image, ImageDraw
from torch import Tensor

from mipmap_plugin.adaptation.plot import figure_class
from mipmap_plugin.evaluation.report import markdown
from mipmap_plugin.formats.atomic import new_file
from mipmap_plugin.formats.images import in_8_bits

INTRO = """# A dolly over a ladder of levels

Made by `python benchmarks/levels.py DATA --ladders DIR`: a camera that zooms out continuously from x1 to x1/16, drawn by our renderer as the viewer
draws; two views that nothing was adapted to, of the test set or else random, 49 frames each; dB against the supersampled base of each frame.
Where there are test photographs, frames are also compared with those, shrunk by Pillow's bicubic; *supersampled base* is then what can be reached.
*levels*: ours. *base*: alone. *one file*: the default recipe at x1/4. *splat-transform*: its `--decimate` to the splats of each of our levels,
in the same format, at the same zooms. *Flicker*: RMS of the change between neighboring frames that the truth does not have, in 8-bit levels; *worst*
is of one pair of frames.

![dB over zoom](levels.png)
"""

# px: how high each picture of a strip is shown, with the line of words above it.
HEIGHT, WORDS = 150, 16

COLORS = {"levels": "tab:blue", "base": "tab:gray", "splat-transform": "tab:orange"}


def page(results: Sequence[dict[str, Any]]) -> str:
    """A section for each base and viewer."""
    return "\n".join([INTRO, *(section(each) for each in results)])


def section(result: dict[str, Any]) -> str:
    films, seconds, ceiling = result["films"], result["seconds"], _ceiling(result)
    head = ["", "worst frame, dB", "mean, dB", "least lead of ours, dB", "flicker, mean", "flicker, worst", "MB", "splats, thousands"]
    rows = [row(film, films[0]) for film in films]
    if ceiling:
        head += ["photographs: worst, dB", "mean, dB"]
        rows = [cells + extremes(photo_dbs(film)) for cells, film in zip(rows, films, strict=True)]
        rows.append(["supersampled base", *["–"] * (len(head) - 3), *extremes(ceiling)])
    switches = [
        [f"x{each['zoom']:.3f}", f"{each['step_db']:+.2f}", *(f"{each[key]:.1f}" for key in ("likeness_db", "one_percent_db"))]
        for each in result["changes"]
    ]
    table = markdown(["switch at", "dB, finer - coarser", "PSNR of both levels, dB", "PSNR of a 1 % zoom, dB"], switches)
    spent = f"{sum(seconds):.0f} s for all levels ({', '.join(f'{each:.0f}' for each in seconds)}), one thread of a busy machine"
    return f"## {result['base']} in {result['viewer']}\n\n{markdown(head, rows)}\n\n{spent}\n\n{table}\n"


def row(film: dict[str, Any], ours: dict[str, Any]) -> list[str]:
    """`least lead`: at any zoom below x1/2."""
    quality, flicker = ([frame[key] for frame in film["frames"] if frame[key] is not None] for key in ("psnr_db", "flicker"))
    leads = [our["psnr_db"] - its["psnr_db"] for our, its in zip(ours["frames"], film["frames"], strict=True) if our["zoom"] < 0.5]
    lead = "–" if film is ours else f"{min(leads):.1f}"
    splats = ", ".join(f"{count / 1000:.1f}" for count in film["splats"])
    return [film["name"], *extremes(quality), lead, f"{fmean(flicker):.2f}", f"{max(flicker):.2f}", f"{film['megabytes']:.1f}", splats]


def extremes(dbs: Sequence[float]) -> list[str]:
    """The worst and the mean."""
    return [f"{min(dbs):.1f}", f"{fmean(dbs):.1f}"]


def photo_dbs(film: dict[str, Any]) -> list[float]:
    """dB of each frame against the photographs."""
    return [frame["photo_db"] for frame in film["frames"]]


def _ceiling(result: dict[str, Any]) -> list[float]:
    """dB of the supersampled base against the photographs of each frame; none where none are known."""
    return [each for each in result.get("supersampled_photo_db", []) if each is not None]


def strip(path: Path, rows: Mapping[str, Sequence[Tensor]], zooms: Sequence[float]) -> None:
    """A row of pictures for each way to show the scene, by zoom; pixels are enlarged whole."""
    sheet = Image.new("RGB", ((HEIGHT + 4) * len(zooms), (HEIGHT + WORDS) * len(rows)), "white")
    pen = ImageDraw.Draw(sheet)
    for row, (name, pictures) in enumerate(rows.items()):
        for column, (zoom, picture) in enumerate(zip(zooms, pictures, strict=True)):
            corner = column * (HEIGHT + 4), row * (HEIGHT + WORDS)
            pen.text((corner[0] + 2, corner[1] + 2), f"{name}, x1/{1 / zoom:g}" if zoom < 1 else f"{name}, x1", fill="black")
            pixels = Image.fromarray(in_8_bits(picture))
            sheet.paste(pixels.resize((HEIGHT, HEIGHT), Image.Resampling.NEAREST), (corner[0], corner[1] + WORDS))
    with new_file(path, overwrite=True) as temporary:
        sheet.save(temporary, format="PNG")


def draw(path: Path, results: Sequence[dict[str, Any]]) -> None:
    """A plot of dB over zoom for each base and viewer, with our switches."""
    figure = figure_class()(figsize=(12, 2.3 * ((len(results) + 1) // 2)), layout="constrained")
    plots = list(figure.subplots((len(results) + 1) // 2, 2, squeeze=False, sharey=True).flat)
    for axes in plots[len(results) :]:
        axes.set_axis_off()
    for axes, result in zip(plots, results, strict=False):
        _lines(axes, result)
        for change in result["changes"]:
            axes.axvline(change["zoom"], color="tab:blue", linewidth=0.6, linestyle=":")
        axes.set_xscale("log", base=2)
        axes.invert_xaxis()
        axes.set(title=f"{result['base']} in {result['viewer']}", ylabel="dB")
        axes.grid(alpha=0.25)
    figure.supxlabel("zoom (dotted: switches); dB against the supersampled base", fontsize=9)
    lines = {line.get_label(): line for axes in plots for line in axes.get_lines() if not line.get_label().startswith("_")}
    figure.legend(lines.values(), lines.keys(), loc="outside upper center", ncols=len(lines), fontsize=8, frameon=False)
    with new_file(path, overwrite=True) as temporary:
        figure.savefig(temporary, format="png", dpi=90)


def _lines(axes: Any, result: dict[str, Any]) -> None:
    """dB over zoom of all films, and, dashed, of ours and of what can be reached against photographs."""
    for film in result["films"]:
        zooms, quality = ([frame[key] for frame in film["frames"]] for key in ("zoom", "psnr_db"))
        width = 2.4 if film["name"] == "levels" else 1.3
        axes.plot(zooms, quality, label=film["name"], color=COLORS.get(film["name"], "tab:green"), linewidth=width)
    if ceiling := _ceiling(result):
        zooms = [frame["zoom"] for frame in result["films"][0]["frames"]]
        axes.plot(zooms, photo_dbs(result["films"][0]), "--", label="levels against photographs", color=COLORS["levels"], linewidth=1.3)
        axes.plot(zooms, ceiling, "--", label="supersampled base against photographs", color="black", linewidth=1)
