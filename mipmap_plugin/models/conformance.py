"""A pytest suite for the authors of families. Only this module needs pytest."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
import torch
from torch import Tensor

from mipmap_plugin.camera import Camera
from mipmap_plugin.errors import OutputError, OutputExists, SettingsError
from mipmap_plugin.models import contract, detect, load_model
from mipmap_plugin.models.adapted_name import adapted_name
from mipmap_plugin.models.base import Filtered, SplatModel, Thinned, tensors_of, why_no_viewer
from mipmap_plugin.models.vanilla import VanillaModel
from mipmap_plugin.scenes.orbits import Orbit
from mipmap_plugin.wrap import Wrapped, wrap_model

# Allowed difference of images, because formats round.
SAME = 1 / 255


class ModelSuite:
    """Subclass it in a test file, with a fixture that writes a checkpoint of your family, and pytest checks the family::

        class TestMine(ModelSuite):
            family = "mine"

            @pytest.fixture
            def checkpoint(self, tmp_path):
                return write_a_small_one(tmp_path / "scene.mine")

    Attributes:
        family: The name that it is registered under.
        cameras: Views of the scene; by default small ones of an orbit.
        saved_as: Name of the file or folder that models are saved to; None: the one that the command line gives.
        scale: Of the adaptation.
        device: Second device of the test that moves the model.
        settings: Of the adaptation.
    """

    family: str
    cameras: Sequence[Camera] = ()
    saved_as: str | None = None
    scale: float = 1 / 2
    device: str = "cpu"
    settings: dict[str, Any] = dict(steps=2, extra_views=2, merge_to=1.0)  # noqa: RUF012

    @pytest.fixture
    def base(self, checkpoint: Path) -> Wrapped:
        model = load_model(checkpoint)
        views = self.cameras or Orbit.around(model.parameters()["means"]).views((24, 32), 4, torch.Generator().manual_seed(0))
        return wrap_model(model, cameras=views, backend="reference")

    def test_is_recognized(self, checkpoint: Path) -> None:
        assert detect(checkpoint).family == self.family

    def test_offers_what_a_model_offers(self, base: Wrapped) -> None:
        assert contract.lacking(base.model) == []

    def test_shows_something_finite(self, base: Wrapped) -> None:
        with torch.no_grad():
            rendered = base.render(base.cameras[0])
        assert rendered.image.isfinite().all() and rendered.alpha.max() > 0

    def test_a_copy_learns_and_the_base_does_not(self, base: Wrapped) -> None:
        before, copied, view = _tensors(base.model), base.model.copy(), base.cameras[0]
        base.backend(gradients=True)[0].render(copied.gaussians(view), view, base.effects()).image.sum().backward()
        gradients = {name: tensor.grad for name, tensor in copied.parameters().items() if tensor.grad is not None}
        assert any(gradient.abs().sum() > 0 for gradient in gradients.values()), "no parameter of a copy has a gradient"
        assert all(gradient.isfinite().all() for gradient in gradients.values()), "gradients hold NaN or infinity"
        with torch.no_grad():
            for tensor in copied.parameters().values():
                tensor.add_(1)
        _assert_same(before, base.model)

    def test_rows_can_be_taken_away(self, base: Wrapped) -> None:
        copied = base.model.copy()
        half = {name: tensor.detach()[: max(1, len(tensor) // 2)].clone().requires_grad_() for name, tensor in copied.parameters().items()}
        copied.replace_parameters(half)
        assert all(copied.parameters()[name] is tensor for name, tensor in half.items()), "replace_parameters() has to keep the tensors themselves"
        assert contract.row_opacities(copied, base.cameras).shape == (len(half["means"]),)
        assert copied.gaussians(base.cameras[0]).means.isfinite().all()

    def test_rows_can_be_left_out(self, base: Wrapped) -> None:
        copied, count = base.model.copy(), len(base.model.parameters()["means"])
        if not copied.traits.thins:
            return
        cast(Thinned, copied).thin(torch.arange(count) < count // 2)
        assert len(copied.parameters()["means"]) < count == len(base.model.parameters()["means"])
        assert copied.gaussians(base.cameras[0]).means.isfinite().all()

    def test_keeps_what_its_traits_promise(self, base: Wrapped) -> None:
        traits = base.model.traits
        models = [cast(Filtered, base.model).fused()] if traits.filtered else []
        models += [VanillaModel(base.model.parameters(), base.model.trained)] if traits.plain else []
        if traits.same_for_all_views:
            models.append(base.model.copy())
            contract.rebuild(models[-1], lambda gaussians: gaussians[torch.arange(len(gaussians))])
        for model in models:
            _assert_looks_alike(base, base.model, model)

    def test_shapes_that_stay_keep_the_picture(self, base: Wrapped) -> None:
        copied = base.model.copy()
        copied.reshape(lambda gaussians: (gaussians.scales, gaussians.opacities), base.cameras)
        _assert_looks_alike(base, base.model, copied)

    def test_writes_a_ply_for_viewers(self, base: Wrapped, tmp_path: Path) -> None:
        if why_no_viewer(base.model):
            return
        copied = cast(Filtered, base.model).bare() if base.model.traits.filtered else base.model.copy()
        _assert_looks_alike(base, copied, load_model(contract.save(copied, tmp_path / "viewer.ply", {})))

    def test_the_base_is_never_an_output(self, base: Wrapped) -> None:
        for path in filter(None, {base.model.source, base.model.folder}):
            with pytest.raises((OutputError, OutputExists, SettingsError)):
                base.model.refuse_output(path, overwrite=True, networks_move=False)

    def test_adapts_and_is_saved_and_loaded_again(self, base: Wrapped, checkpoint: Path, tmp_path: Path) -> None:
        with _untouched(base.model, checkpoint):
            adapted = base.adapt(self.scale, **self.settings)
            saved = adapted.save(path := self._output(checkpoint, tmp_path))
        assert saved.is_file(), f"save() returned {saved}, where it wrote no file"
        again = load_model(path)
        read = wrap_model(again, cameras=base.cameras, backend="reference")
        views = [view.zoomed(self.scale) for view in _moments(base)]
        difference = max((adapted.render(view).image - read.render(view).image).abs().max().item() for view in views)
        assert difference <= SAME, f"what is saved looks otherwise when it is read, by up to {difference:.3f}"

    def test_a_name_without_an_ending_is_refused_or_read_again(self, base: Wrapped, tmp_path: Path) -> None:
        path = tmp_path / "without-an-ending"
        try:
            base.model.refuse_output(path, overwrite=False, networks_move=False)
        except (OutputError, OutputExists, SettingsError):
            return
        contract.save(base.model.copy(), path, {})
        assert load_model(path)

    def test_is_read_again_under_the_name_that_the_command_line_gives(self, base: Wrapped, checkpoint: Path) -> None:
        path = checkpoint.with_name(adapted_name(checkpoint, self.scale))
        base.model.copy().save(path, provenance={})
        assert len(load_model(path).parameters()["means"]) == len(base.model.parameters()["means"])

    def test_what_exists_is_not_replaced_unasked(self, base: Wrapped, checkpoint: Path, tmp_path: Path) -> None:
        saved = base.model.copy().save(path := self._output(checkpoint, tmp_path), provenance={})
        before = _digests(tmp_path)
        with pytest.raises(OutputExists):
            base.model.copy().save(path, provenance={"again": True})
        assert saved.is_file() and _digests(tmp_path) == before, "save() without overwrite has changed files"

    def test_goes_to_another_device(self, base: Wrapped) -> None:
        moved = base.model.to(self.device)
        assert {tensor.device.type for tensor in moved.parameters().values()} == {torch.device(self.device).type}
        _assert_looks_alike(base, base.model, moved)
        with torch.no_grad():
            for tensor in moved.parameters().values():
                tensor.zero_()
        alone = any(tensor.abs().sum() > 0 for tensor in base.model.parameters().values())
        assert alone, "to() returned tensors of the model itself, as torch's does on the same device; clone them"

    def _output(self, checkpoint: Path, folder: Path) -> Path:
        """Where a model adapted from the checkpoint is saved."""
        return folder / "output" / (self.saved_as or adapted_name(checkpoint, self.scale))


@contextmanager
def _untouched(model: SplatModel, checkpoint: Path) -> Iterator[None]:
    tensors, files = _tensors(model), _digests(checkpoint)
    yield
    _assert_same(tensors, model)
    assert _digests(checkpoint) == files, "the files of the base have changed"


def _tensors(model: SplatModel) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in tensors_of(model).items()}


def _assert_same(before: dict[str, Tensor], model: SplatModel) -> None:
    after = _tensors(model)
    assert before.keys() == after.keys() and all(torch.equal(tensor, after[name]) for name, tensor in before.items()), "the base has changed"


def _assert_looks_alike(base: Wrapped, *models: SplatModel) -> None:
    first, second = (Wrapped(model, base.cameras, "reference", base.trained) for model in models)
    difference = max((first.render(view).image.cpu() - second.render(view).image.cpu()).abs().max().item() for view in _moments(base))
    assert difference <= SAME, f"a picture changes by up to {difference:.3f}"


def _moments(base: Wrapped) -> list[Camera]:
    """The first view; of a model that moves, at the beginning, within and at the end: what loses its motion still shows the beginning."""
    return [replace(base.cameras[0], time=time) for time in (0.0, 0.4, 1.0)] if base.model.traits.moves else list(base.cameras[:1])


def _digests(path: Path) -> dict[Path, str]:
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    return {file: hashlib.sha256(file.read_bytes()).hexdigest() for file in files}
