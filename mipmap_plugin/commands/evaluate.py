"""`mipmap-plugin evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from mipmap_plugin.commands.common import print_json, scene, starting, without_none, wrap
from mipmap_plugin.commands.pages import evaluation_page_path, look_at, write_evaluation_page
from mipmap_plugin.commands.resuming import resumable
from mipmap_plugin.commands.types import BackendName, Background, Scales, ScreenFilter, Seed, Threads, Viewer, unique_scales
from mipmap_plugin.commands.voice import say
from mipmap_plugin.config import ResizeFilter
from mipmap_plugin.errors import SettingsError, plural
from mipmap_plugin.formats.atomic import refuse_output, refuse_unwritable, together, write_json
from mipmap_plugin.jobs.base import Base

if TYPE_CHECKING:
    from mipmap_plugin.evaluation.perceptual import Perceptual
    from mipmap_plugin.scenes import Scene
    from mipmap_plugin.wrap import Wrapped


def evaluate(
    checkpoint: tyro.conf.Positional[tuple[Path, ...]],
    images: tuple[Path, ...],
    scale: Scales,
    recipe: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    viewer: Viewer | None = None,
    protocol: Literal["P1", "P3", "P4"] = "P3",
    lpips: Literal["alex", "vgg", "vgg-01"] | None = None,
    lpips_weights: Path | None = None,
    published: Literal["nerf-synthetic", "mip-nerf-360"] | None = None,
    steps: int | None = None,
    upsampler: str | None = None,
    resize: ResizeFilter | None = None,
    appearance: Literal["mean", "upstream"] = "mean",
    cameras: tuple[Path, ...] = (),
    background: Background = None,
    screen_filter: ScreenFilter = None,
    backend: BackendName = "auto",
    threads: Threads = None,
    seed: Seed = 0,
    output: Path | None = None,
    report: bool = True,
    overwrite: bool = False,
    json: bool = False,
) -> None:
    """Evaluate checkpoints against real images: as they are, with training-free filters, resized, and adapted.

    Args:
        checkpoint: A PLY or a model folder; its cameras, or those given, define the base scale. Required; several scenes are also averaged.
        images: Folder of the scene (transforms_*.json or COLMAP's sparse/0, and the images), one for each checkpoint.
        scale: Target focal length over base focal length, such as 1/4 or 4; 1 is the base itself. Required; may be given several times.
        recipe: Also adapt: default, thorough (more steps and views), instant (closed form only), paper (published method), or a registered one.
        viewer: Viewer to adapt files for, and to render them and the base as: spark, supersplat, ...; portable: the worst of all viewers.
        protocol: How photographs are resized: P1 box filter, truncated to 8 bits; P3 Pillow's bicubic on 8 bits; P4 COLMAP's folders images_2, ...
        lpips: Also measure LPIPS, with AlexNet or VGG; vgg-01 takes images in 0..1, as papers of this field do, though LPIPS is defined on -1..1.
        lpips_weights: File of the backbone's weights, as torchvision saves them; by default they are downloaded once.
        published: Also print the results that papers published for this data set.
        steps: Maximum number of optimizer steps, instead of the recipe's; a recipe without steps takes none.
        upsampler: What makes base images larger: a registered name, or the file of a network.
        resize: Filter that makes base images smaller, instead of the recipe's: area aims at P1, pil-bicubic at P3.
        appearance: Appearance of test views, if training views have their own: mean of these, or upstream (of the view with the same number).
        cameras: For each checkpoint that has none: a cameras.json or a scene, such as the images' if it was trained on these at their size.
        output: Also write the rows, and notes on missing ones, as JSON to this file.
        report: Write a page that shows it all: beside --output, or else NAME.evaluation.html in this folder, numbered if there is one already.
        overwrite: Replace files that exist.
        json: Print JSON instead of a table.
    """
    page = evaluation_page_path(checkpoint[0], output) if report and checkpoint else None
    _refuse(checkpoint, images, cameras, [path for path in (output, page) if path], overwrite)
    settings = without_none(seed=seed, upsampler=upsampler, viewer=viewer) | _of_adapted(recipe, steps=steps, resize=resize)
    results = _Results(protocol, _perceptual(lpips, lpips_weights), unique_scales(scale), page, output)
    with resumable(results.kept, "row"):
        for name, path, folder, own in zip(_names(checkpoint, images), checkpoint, images, cameras or [None] * len(checkpoint), strict=True):
            base = Base(path, own, background, backend, screen_filter)
            wrapped, photographs = wrap(base, threads), scene(base, folder)
            photographs = photographs.numbered_as_upstream() if appearance == "upstream" else photographs
            results.refuse_output([*photographs.images.values()], overwrite)
            results.measure(name, wrapped, photographs, appearance, recipe, settings)
    facts = results.write(checkpoint, overwrite)
    print_json(facts) if json else results.print_tables(_title(checkpoint, images, protocol, results.judged), published)


class _Results:
    """What was measured of all checkpoints."""

    def __init__(self, protocol: str, perceptual: Perceptual | None, scales: list[float], page: Path | None, output: Path | None) -> None:
        self._protocol, self._perceptual, self._scales, self._page, self._output = protocol, perceptual, scales, page, output
        from mipmap_plugin.models.places import state_path

        written = output or page
        self.kept = state_path(written) if written else None  # the folder of finished rows
        self._rows, self._notes, self._galleries = list[Any](), dict[str, None](), list[Any]()  # notes each once, in their order
        self.judged = list[int]()  # the number of judged views of each checkpoint
        self._scenes = list[Path]()

    def refuse_output(self, read: Sequence[Path], overwrite: bool) -> None:
        """Raise OutputExists if what is to be written is one of the files that are `read`."""
        for output in filter(None, (self._output, self._page)):
            refuse_output(output, overwrite, read, is_file=True)

    def measure(self, name: str, wrapped: Wrapped, scene: Scene, appearance: str, recipes: Sequence[str], settings: dict[str, Any]) -> None:
        """Add the rows and notes of one checkpoint, whose rows are called by a name."""
        from mipmap_plugin.evaluation import evaluate as evaluation
        from mipmap_plugin.evaluation.cells import Cells
        from mipmap_plugin.evaluation.notes import notes
        from mipmap_plugin.pages.gallery import Gallery

        lpips = self._perceptual and self._perceptual.label
        asked = {"name": name, "protocol": self._protocol, "lpips": lpips, "appearance": appearance, "settings": settings}
        made_from = {"base": wrapped.model.digest, "asked": wrapped.asked, "trained": str(wrapped.trained), "scene": scene.digest()}
        machinery = {"page": self._page is not None, "backend": wrapped.backend()[0].name, "threads": wrapped.threads}
        cells = Cells(self.kept, asked | made_from | machinery)
        judge = evaluation.evaluator_of(wrapped, scene, self._protocol, self._perceptual, cells=cells)
        truth = f"photographs, protocol {self._protocol}, {plural(len(judge.views), 'view')}"
        gallery = Gallery(wrapped, truth, recipes) if self._page else None
        judge = replace(judge, watcher=gallery, scene=name)
        self._rows += evaluation.all_rows(wrapped, judge, self._scales, recipes, **settings)
        self._notes |= dict.fromkeys(notes(wrapped, judge, self._scales, recipes, settings, appearance))
        self.judged.append(len(judge.views))
        self._scenes.append(scene.source.resolve())
        self._galleries.append(gallery)

    def write(self, checkpoints: Sequence[Path], overwrite: bool) -> dict[str, Any]:
        """Add the means over several scenes, write the page and the JSON as far as requested, and return what the JSON holds."""
        from mipmap_plugin.evaluation.evaluate import means
        from mipmap_plugin.evaluation.report import records
        from mipmap_plugin.models.places import page_at

        self._rows += means(self._rows) if 1 < len(checkpoints) == len(set(self._scenes)) else []  # several of one scene are compared
        facts = {"rows": records(self._rows), "judged_views": self.judged, "notes": [*self._notes], "report": self._page and str(self._page)}
        written = self._output or self._page
        older = page_at(self._output.with_suffix(".html")) if self._output and self._output.exists() else []  # it shows the rows that are replaced
        spent = [*([self.kept] if self.kept else []), *older]
        with together(written, spent) if written else nullcontext():  # or else, after a kill between the two, one would be in the way
            if self._page:
                write_evaluation_page(self._page, checkpoints, self._galleries, self._rows, [*self._notes], overwrite)
            if self._output:
                write_json(self._output, facts, overwrite)
        return facts

    def print_tables(self, title: str, dataset: Any) -> None:
        """Print the rows, the published ones of a data set if one is given, the notes, and where the JSON and the page are."""
        from mipmap_plugin.evaluation.published import TITLE, published
        from mipmap_plugin.evaluation.report import published_table, table

        say("\n".join([title, table(self._rows), *self._notes]))
        if dataset:
            say(f"\npublished, {TITLE[dataset]}; rows of other protocols, and of bases trained at another size, are not comparable")
            rows = published(dataset, self._scales)
            say(published_table(rows) if rows else "there are none at these scales; they are at x1/2, x1/4, x1/8, x2, x4 and x8")
        if self._output:
            say(f"written: {self._output}")
        if self._page:
            say(look_at(self._page))


def _perceptual(network: Literal["alex", "vgg", "vgg-01"] | None, weights: Path | None) -> Perceptual | None:
    from mipmap_plugin.evaluation.perceptual import Perceptual

    if weights and not network:
        raise SettingsError(f"--lpips-weights {weights}: say which LPIPS this is for; add --lpips alex, vgg or vgg-01")
    return Perceptual(network, weights) if network else None


def _names(checkpoints: Sequence[Path], images: Sequence[Path]) -> list[str]:
    """What the rows of each checkpoint are called by: its scene, and its path where several have a scene of that name."""
    scenes = [folder.absolute().name for folder in images]
    return [scene if scenes.count(scene) == 1 else f"{scene}, {path}" for scene, path in zip(scenes, checkpoints, strict=True)]


def _refuse(checkpoint: Sequence[Path], images: Sequence[Path], cameras: Sequence[Path], outputs: Sequence[Path], overwrite: bool) -> None:
    if not checkpoint:
        raise SettingsError("there is no checkpoint to evaluate; give a PLY or a model folder, or several of them, and --images for each")
    for option, given in {"--images": images, "--cameras": cameras or checkpoint}.items():
        if len(checkpoint) != len(given):
            how = f"one for each checkpoint, all behind one {option}"
            raise SettingsError(f"{option}: give {how}; got {len(given)}, for {len(checkpoint)} of these")
    if len(set(outputs)) < len(outputs):
        raise SettingsError(f"{outputs[0]}: the page is written there; give the rows another name, such as {outputs[0].with_suffix('.json')}")
    with starting():
        from mipmap_plugin.models.outputs import parts_of

    read = [part for path in checkpoint for part in (parts_of(None, path) if path.is_dir() else [path])]
    read += [*(file for folder in images for file in folder.glob("transforms*.json")), *cameras]
    for output in outputs:
        refuse_output(output, overwrite, read, is_file=True)
        refuse_unwritable(output)


def _of_adapted(recipes: Sequence[str], **settings: Any) -> dict[str, Any]:
    """Those of the settings of adapted models that are given. Raises SettingsError if nothing is adapted."""
    given = without_none(**settings)
    for name, value in given.items():
        if not recipes:
            raise SettingsError(f"--{name} {value}: it is of adapted models, and none is evaluated; add --recipe default, or take --{name} away")
    return given


def _title(checkpoint: Sequence[Path], images: Sequence[Path], protocol: str, judged: Sequence[int]) -> str:
    """`judged`: the number of judged views of each checkpoint."""
    checkpoints, scenes, views = (", ".join(map(str, values)) for values in (checkpoint, images, judged))
    return f"{checkpoints}; truth: {protocol} from {scenes}, real dB over {views} view{'' if views == '1' else 's'}"
