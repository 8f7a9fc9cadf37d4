"""What each part of adaptation is worth: one setting varied at a time, against real test images (protocol P3).

    python benchmarks/ablations.py DATA --base lego_200 --scale 1/4 --only views

The paper's ablations (steps, loss, views, pruning by opacity) vary its own recipe; `merging`, `rates` and `batch` vary ours, and
are what its defaults were chosen from. Writes <output>/<base>_x<scale>_<ablation>.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import tyro
from bases import judge_of

from mipmap_plugin import wrap_model
from mipmap_plugin.commands.types import Scale
from mipmap_plugin.evaluation.evaluate import adapted_row
from mipmap_plugin.evaluation.measure import adapt_alone, warm_up
from mipmap_plugin.evaluation.report import table
from mipmap_plugin.formats.atomic import new_file
from mipmap_plugin.recipes import recipe as make_config

OURS = make_config("default", 1 / 4).rates


def rates(**changed: float) -> dict[str, Any]:
    return {"rates": OURS.model_copy(update=changed)}


# For each ablation the recipe that it varies, and its variants by name. SCORED adapts on the views that are judged, as the paper does.
SCORED = "scored views"
ABLATIONS: dict[str, tuple[str, dict[str, dict[str, Any]]]] = {
    "steps": ("paper", {f"{steps} steps": dict(steps=steps, views="train") for steps in (100, 300, 500, 1000)}),
    "loss": ("paper", {loss: dict(loss=loss, steps=500, views="train") for loss in ("l2", "l1")}),
    "views": ("paper", {SCORED: {}, "training views": dict(views="train"), "50 of an orbit": dict(views="orbit", extra_views=50),
                        "training views and 200 between": dict(views="jittered", extra_views=200)}),
    "opacity": ("paper", {f"pruned below {least:g}": dict(min_opacity=least, steps=500, views="train") for least in (0, 0.005, 0.05, 0.2)}),
    "merging": ("default", {f"{share:.0%} of the splats": dict(merge_to=share) for share in (1.0, 0.4, 0.2, 0.1)}),
    "rates": ("default", {"as it is": {}, "view-dependent color 0.001": rates(shN=0.001), "view-dependent color 0.01": rates(shN=0.01),
                          "centers stay": rates(means=0.0), "only colors": rates(means=0.0, scales=0.0, quats=0.0, opacities=0.0),
                          "Adam's usual betas": dict(betas=(0.9, 0.999)), "fall to a tenth": dict(decay=0.1)}),
    "batch": ("default", {f"{views} views a step": dict(views_per_step=views, steps=1600 // views, check_every=200 // views)
                          for views in (1, 2, 4, 8)}),
}  # fmt: skip


def main(
    data: tyro.conf.Positional[Path],
    base: str = "lego_200",
    scale: Scale = 0.25,
    only: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    output: Path = Path("benchmarks/results/ablations"),
    backend: str = "auto",
) -> None:
    """Measure, print and write the tables.

    Args:
        data: The folder with checkpoints/bases/ and images/.
        base: Which base.
        scale: Which zoom.
        only: Which ablations; all by default.
        output: Where the tables go.
        backend: A backend's name.
    """
    wrapped = wrap_model(data / "checkpoints" / "bases" / base, backend=backend)
    evaluator = judge_of(wrapped, data, base)
    scored = dict(views="given", cameras=[view.camera for view in evaluator.views])
    warm_up(wrapped, scale, wrapped.cameras)
    for name in only or ABLATIONS:
        recipe, variants = ABLATIONS[name]
        rows = []
        for variant, settings in variants.items():
            adapted = adapt_alone(wrapped, scale, recipe=recipe, **{"patience": None, **settings, **(scored if variant == SCORED else {})})
            rows.append(adapted_row(variant, adapted, evaluator))
        text = f"## {name}: the `{recipe}` recipe on {base} at x{scale:g}\n\n{table(rows)}\n"
        print(text, flush=True)
        with new_file(output / f"{base}_x{scale:g}_{name}.md", overwrite=True) as file:
            file.write_text(text)


if __name__ == "__main__":
    tyro.cli(main)
