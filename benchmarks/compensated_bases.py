"""What is made of bases that were trained with compensation: for their own renderer, and for a classic one.

    python benchmarks/compensated_bases.py DATA

DATA is that of real_bases.py. lego_200 is converted to such bases: an antialiased one of 3DGS, and one of Mip-Splatting with the 3D filter that
training on its views gives. Writes compensated_bases.md.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from statistics import fmean

import torch
import tyro
from torch import Tensor

from mipmap_plugin import wrap_model
from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.target.resize import resize
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.evaluation.report import markdown
from mipmap_plugin.models.base import TrainedScale
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.wrap import Wrapped

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))

import mip_checkpoints

SCALES = (1 / 2, 1 / 4, 1 / 8, 2.0)
VIEWS = slice(0, 200, 25)

INTRO = """# Bases that were trained with compensation

Made by `python benchmarks/compensated_bases.py DATA`: dB against the base's own image at x1, both shrunk to the smaller of the two by averaging;
the mean of 8 views of lego_200, converted to such bases.
"""


def main(data: tyro.conf.Positional[Path], output: Path = Path("benchmarks/results")) -> None:
    """Measure, and write the table.

    Args:
        data: The folder with checkpoints/.
        output: Where the table goes.
    """
    torch.set_num_threads(1)
    plain = wrap_model(data / "checkpoints" / "bases" / "lego_200", threads=1)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for title, base in (("antialiased", antialiased(plain)), ("Mip-Splatting, with its `filter_3D`", of_mip_splatting(plain, Path(folder)))):
            for scale in SCALES:
                rows.append([f"{title}, x{scale:g}", *(f"{db:.1f}" for db in qualities(base, scale))])
                print(rows[-1], flush=True)
    columns = ["", "base in its own renderer", "`instant` for it", "base in classic", "`instant` for classic"]
    (output / "compensated_bases.md").write_text(f"{INTRO}\n{markdown(columns, rows)}\n")


def antialiased(plain: Wrapped) -> Wrapped:
    """As INRIA's --antialiasing would have trained it."""
    splats = plain.adapt(1, viewer="antialiased").model.gaussians(plain.cameras[0])
    model = VanillaModel.from_gaussians(splats, trained=TrainedScale("antialiased", 0.3))
    return wrap_model(model, cameras=plain.cameras, background=plain.background, threads=1)


def of_mip_splatting(plain: Wrapped, folder: Path) -> Wrapped:
    """The 3D filter smooths the splats that were adapted without it: the base is a little softer than those."""
    splats = plain.adapt(1, viewer="mip").model.gaussians(plain.cameras[0])
    columns = mip_checkpoints.columns_of(VanillaModel.from_gaussians(splats), plain.cameras)
    return wrap_model(mip_checkpoints.folder(folder / "mip", columns=columns), cameras=plain.cameras, background=plain.background, threads=1)


def qualities(base: Wrapped, scale: float) -> list[float]:
    """dB of the base in its own renderer, of `instant` there, and the same in classic."""
    own, classic = base.adapt(scale, recipe="instant"), base.adapt(scale, recipe="instant", viewer="classic")
    truths = {view: base.render(view).image for view in base.cameras[VIEWS]}

    def quality(model: Wrapped | Adapted, **options: str) -> float:
        return fmean(against(truth, model.render(view.zoomed(scale), **options).image) for view, truth in truths.items())

    return [quality(base), quality(own), quality(base, viewer="classic"), quality(classic)]


def against(truth: Tensor, image: Tensor) -> float:
    """dB of an image against another, both shrunk to the smaller of the two."""
    size = min(image.shape[0], truth.shape[0]), min(image.shape[1], truth.shape[1])
    return psnr(*(resize(each.detach().clamp(0, 1), size, "area") for each in (image, truth)))


if __name__ == "__main__":
    tyro.cli(main)
