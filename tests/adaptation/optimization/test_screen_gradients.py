"""Screen gradients, by which density control grows splats: right, and averaged over the views that gave any."""

import tiny
import torch

from mipmap_plugin.adaptation.optimization.density import ScreenGradients, strongest
from mipmap_plugin.adaptation.optimization.loop import adapt as optimize
from mipmap_plugin.adaptation.optimization.run import Run, Task
from mipmap_plugin.adaptation.optimization.validation import Validation
from mipmap_plugin.config import AdaptConfig, LearningRates
from mipmap_plugin.gaussians import Gaussians
from mipmap_plugin.splatting.projection import project

COUNT = 6


def by_differences(camera, means, pull):
    """d loss / d NDC of one splat, loss = pull · mean2d, by moving its image with central differences in world space."""

    def pixels(point):
        one = Gaussians(point[None], torch.ones(1, 4).double(), torch.ones(1, 3).double(), torch.ones(1).double(), torch.ones(1, 1, 3).double())
        return project(one, camera, 0.2).means2d[0]

    axes = torch.linalg.inv(camera.viewmat)[:3, :2].T * 1e-5  # a step to the right and one downwards
    per_step = torch.stack([pixels(means[0] + axis) - pixels(means[0] - axis) for axis in axes])  # px per step: [axis, pixel axis]
    loss_per_step = per_step @ pull
    pixels_per_step = per_step.diagonal()
    return loss_per_step / pixels_per_step * torch.tensor([camera.width, camera.height]) / 2


def test_screen_gradients_equal_finite_differences():
    camera = tiny.cameras(3)[2].resized(50, 21)  # fx is not fy
    means = torch.tensor([[0.1, -0.2, 0.15]], dtype=torch.float64, requires_grad=True)
    pull = torch.tensor([0.3, -0.7], dtype=torch.float64)
    one = Gaussians(means, torch.ones(1, 4).double(), torch.ones(1, 3).double(), torch.ones(1).double(), torch.ones(1, 1, 3).double())
    (project(one, camera, 0.2).means2d[0] @ pull).backward()
    gradients = ScreenGradients(1, means.device)
    gradients.add(means, means.grad, camera)
    torch.testing.assert_close(gradients.mean().double(), by_differences(camera, means.detach(), pull).norm()[None], atol=0, rtol=1e-6)


def test_screen_gradients_are_averaged_over_the_views_that_gave_any():
    camera = tiny.cameras(1)[0]
    means = torch.zeros(2, 3)
    gradients = ScreenGradients(2, means.device)
    for second in (0.0, 4.0, 2.0):
        gradients.add(means, torch.tensor([[0.0, 0, 0], [second, 0, 0]]), camera)
    three, one = gradients.mean(), ScreenGradients(2, means.device)
    one.add(means, torch.tensor([[0.0, 0, 0], [3.0, 0, 0]]), camera)
    torch.testing.assert_close(three, one.mean())
    assert three[0] == 0 < three[1]


def test_the_strongest_gradients_grow_first():
    gradients = torch.tensor([3.0, 0.1, 5.0, 4.0])
    assert strongest(gradients, 1.0, 3).tolist() == strongest(gradients, 1.0, 9).tolist() == [True, False, True, True]
    assert strongest(gradients, 1.0, 2).tolist() == [False, False, True, True]
    assert not strongest(gradients, 1.0, 0).any() and not strongest(gradients, 1.0, -4).any()


def test_two_views_in_one_step_count_as_two_views_each_with_its_own_gradient():
    """Gradients of a step's views add up in `.grad`; the statistics want them one by one."""
    views = tiny.cameras(2)
    pull = {view: torch.randn(COUNT, 3, generator=torch.Generator().manual_seed(i)) for i, view in enumerate(views)}
    student = tiny.model(COUNT).copy()

    def render(gaussians, camera):
        here = next(view for view in views if view.name == camera.name)
        return (gaussians.means * pull[here]).sum().sqrt().expand(1, 1, 1)

    with torch.no_grad():
        student.parameters()["means"].fill_(1.0)
        for each in pull.values():
            each.abs_()
    config = AdaptConfig(steps=1, views_per_step=2, densify_gradient=1.0, rates=LearningRates(), returns="last")
    black = lambda view: torch.zeros(1, 1, 1)  # noqa: E731
    validation = Validation(views, views, 1.0, black, [lambda gaussians, camera: torch.zeros(1, 1, 1)], "area")
    task = Task(views, 1.0, black, [render], white_background=False, validation=validation)
    run = Run.start(student, task, config)
    optimize(run, task, config, lambda run: None)
    expected = ScreenGradients(COUNT, torch.device("cpu"))
    for view in views:
        expected.add(torch.ones(COUNT, 3), pull[view], view)  # the loss is the pull itself, whose gradient is `pull`
    torch.testing.assert_close(run.gradients.mean(), expected.mean(), atol=1e-5, rtol=1e-4)
