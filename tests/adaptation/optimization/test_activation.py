"""Activating splats once for all views of a step changes no gradient."""

import pytest
import tiny
import torch
from anchor_checkpoints import write

from mipmap_plugin.adaptation.optimization.activation import Activation
from mipmap_plugin.backends.reference import ReferenceBackend
from mipmap_plugin.effects import Effects
from mipmap_plugin.models import load_model


def gradients(model, views, *, share):
    """Of the sum of the views' squares, and how often the model was asked for its splats."""
    student, asked, backend = model.copy(), [], ReferenceBackend()
    activate = student.gaussians
    student.gaussians = lambda camera: (asked.append(camera), activate(camera))[1]
    splats = Activation(student, share=share)
    splats.activate(views[0])
    for view in views:
        seen = splats(view)
        backend.render(seen, view, Effects(1)).image.square().sum().backward()
        splats.accumulate(seen)
        assert not share or splats._splats is None or seen.sh.grad is None  # at most the sum and one view's are in memory
    splats.backward()
    return {name: tensor.grad for name, tensor in student.parameters().items()}, len(asked)


@pytest.mark.parametrize("frozen", [(), ("quats", "shN")])
def test_shared_or_not_the_gradients_are_the_same(frozen):
    class Partly:
        """A model whose copies do not move everything."""

        def copy(self):
            student = tiny.model(30).copy()
            for name in frozen:
                student.parameters()[name].requires_grad_(False)
            return student

    views = tiny.cameras(3)
    apart, often = gradients(Partly(), views, share=False)
    shared, once = gradients(Partly(), views, share=True)
    assert (often, once) == (3, 1)
    assert {name for name, grad in shared.items() if grad is None} == set(frozen)
    for name in set(shared) - set(frozen):
        torch.testing.assert_close(shared[name], apart[name], atol=1e-5, rtol=1e-4)


def test_splats_that_depend_on_the_view_are_not_shared(tmp_path):
    """Anchors decode other splats for each camera."""
    model, views = load_model(write(tmp_path / "anchors")), tiny.cameras(2)
    apart, shared = (gradients(model, views, share=share) for share in (False, True))
    assert apart[1] == shared[1] == 2
    for name, grad in apart[0].items():
        torch.testing.assert_close(shared[0][name], grad)
