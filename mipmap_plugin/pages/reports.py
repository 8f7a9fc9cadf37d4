"""The page of each command: what `adapt`, `evaluate`, `tradeoff` and `demo` show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.errors import plural
from mipmap_plugin.evaluation.evaluate import Row, shown_as
from mipmap_plugin.evaluation.measure import BASE, RESIZED, baselines
from mipmap_plugin.evaluation.report import records
from mipmap_plugin.evaluation.tradeoff.truth import base_itself, unseen
from mipmap_plugin.pages.gallery import Gallery, effects_of_base, in_order, recipe_of
from mipmap_plugin.pages.in_viewers import viewer_pictures, why_not
from mipmap_plugin.pages.record import Page, Picture, Quality, Role, Zoom, zoom_name
from mipmap_plugin.process.versions import versions
from mipmap_plugin.wrap import Wrapped


def evaluation_page(title: str, galleries: Sequence[Gallery], rows: Sequence[Row], **further: Any) -> Page:
    """The page of rows and of the galleries that watched them; `further`: commands and notes."""
    adaptations = [each for gallery in galleries for each in gallery.adaptations]
    each_with_rows = [(zoom, gallery.own(rows)) for gallery in galleries for zoom in gallery.zooms(rows, named=len(galleries) > 1)]
    zooms = [zoom for zoom, _ in each_with_rows]
    effects = adaptations[0]["effects"] if adaptations else galleries[0].effects()
    lead = " ".join(filter(None, (_lead(zoom, own) for zoom, own in each_with_rows)))
    return Page(title, lead, zooms=zooms, rows=records(rows), adaptations=adaptations, effects=effects, provenance=versions(), **further)


def tradeoff_page(title: str, base: Wrapped, facts: dict[str, Any], commands: Sequence[str]) -> Page:
    """The page of a tradeoff.json."""
    scales = facts["scales"]
    lead = " ".join(f"{zoom_name(each['scale'])}: {each['sentences']['seconds']}." for each in scales)
    notes = list(dict.fromkeys(note for each in scales for note in each["notes"]))
    return Page(title, lead, commands, tradeoffs=scales, effects=effects_of_base(base), provenance=facts["machine"], notes=notes)


def adaptation_page(
    title: str, zooms: Sequence[Zoom], adaptations: Sequence[dict[str, Any]], commands: Sequence[str], before: Sequence[dict[str, Any]]
) -> Page:
    """The page of adapted files: their pictures (`adaptation_zoom`) and their reports, and those of files that were finished `before`."""
    lead = " ".join(_gain(zoom, report) for zoom, report in zip(zooms, adaptations, strict=True))
    earlier = [{"title": zoom_label(report["scale"], report["viewer"]), **report} for report in before]
    adaptations = [*earlier, *adaptations]
    notes = [f"{report['title']}: an earlier command made it, and its pictures are not drawn again" for report in earlier]
    notes += dict.fromkeys(f"{report['title']}: {note}" for report in adaptations for note in report["notes"])
    return Page(title, lead, commands, zooms, adaptations=adaptations, effects=adaptations[0]["effects"], provenance=versions(), notes=notes)


@torch.no_grad()
def adaptation_zoom(base: Wrapped, adapted: Adapted) -> Zoom:
    """Pictures of a view that nothing was adapted to: without photographs, so that the base itself is the truth."""
    report, viewer = adapted.report, next(iter(filter(None, adapted.viewers)), None)
    scale, view = report.scale, unseen(base, adapted.adapted_to)[0]
    truth = base_itself(base, scale, 1, [view])
    images = {each.name: each.render(view) for each in baselines(base, scale, truth.shrink_by, filters=())}
    base_name = f"base in {viewer}" if viewer else BASE
    images[base_name] = base.render(view.zoomed(scale), viewer=viewer).image
    name = f"adapted, {report.settings.recipe}"
    images[name] = adapted.render(view.zoomed(scale)).image
    roles: dict[str, Role] = {base_name: "base", name: "adapted", RESIZED: "truth" if scale < 1 else "other"}
    means = {base_name: _psnr(report.psnr_before()), name: _psnr(report.psnr_after())}
    pictures = [
        Picture(each, roles.get(each, "supersampled" if each.startswith("supersampling") else "other"), image,
                {"psnr_db": truth.psnr(view, image)} if each != RESIZED or scale > 1 else {}, means.get(each, {}))
        for each, image in images.items()
    ]  # fmt: skip
    reason = why_not(base)
    shown = () if reason else viewer_pictures(base, adapted, view.zoomed(scale), images.get(RESIZED) if scale < 1 else None)
    against = "the base's own image" + (", made smaller" if scale < 1 else ", with which the image is compared after shrinking" if scale > 1 else "")
    truths, judged_on = f"{against} (no photographs)", "the validation views"
    return Zoom(zoom_label(scale, report.viewer), scale, in_order(pictures), view.name, truths, judged_on, shown, reason, report.settings.recipe)


def zoom_label(scale: float, viewer: str | None) -> str:
    """What the zoom of an adapted file is called."""
    return f"{zoom_name(scale)}{f' for {viewer}' if viewer else ''}"


def _psnr(psnr_db: float | None) -> Quality:
    return {} if psnr_db is None else {"psnr_db": psnr_db}


def _lead(zoom: Zoom, rows: Sequence[Row]) -> str:
    """What one zoom gained, in a sentence."""
    judged = {picture.role: picture for picture in reversed(zoom.pictures) if picture.mean.get("psnr_db") is not None}
    means = {role: picture.mean["psnr_db"] for role, picture in judged.items()}
    if "base" not in means:
        return ""
    adapted = ""
    if "adapted" in means:
        by = f" by {recipe}" if (recipe := recipe_of(judged["adapted"].name)) else ""
        adapted = f", {means['adapted']:.1f} dB adapted{by}{_in_seconds(judged['adapted'], zoom.scale, rows)}"
    sampled = f", {means['supersampled']:.1f} dB supersampled" if "supersampled" in means else ""
    base = judged["base"]
    where = f" in the {base.note} viewers" if base.note else base.name.removeprefix(BASE)
    return f"{zoom.label}{where}: {means['base']:.1f} dB as it is{adapted}{sampled}."


def _in_seconds(adapted: Picture, scale: float, rows: Sequence[Row]) -> str:
    seconds = next((row.adapt_seconds for row in rows if row.scale == scale and shown_as(row)[0] == adapted.name), None)
    return "" if seconds is None else f" in {seconds:.1f} s"


def _gain(zoom: Zoom, report: dict[str, Any]) -> str:
    before, after = (next(each.mean.get("psnr_db") for each in zoom.pictures if each.role == role) for role in ("base", "adapted"))
    gain = f"{before:.1f} → {after:.1f} dB on views that nothing was adapted to, " if before is not None and after is not None else ""
    splats = f"{report['gaussians_before']:,} → {plural(report['gaussians_after'], 'splat')}"
    return f"{report['title']}: {gain}{report['seconds']['total']:.1f} s, {splats}."
