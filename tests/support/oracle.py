"""An independent float64 renderer: one sum per pixel over all splats, written from the formulas and not from the package's code."""

import math
from functools import partial

import numpy as np
import torch


def brute_force(gaussians, camera, eps2d=0.3, background=(0.0, 0.0, 0.0), screen_filter="classic", near=0.2):
    """(image [H, W, 3], alpha [H, W]) in float64 from any Gaussians with SH of degree <= 1."""
    g = gaussians.to(dtype=torch.float64)
    view = camera.viewmat
    p = g.means @ view[:3, :3].T + view[:3, 3]
    order = [int(i) for i in p[:, 2].argsort(stable=True) if p[i, 2] > near]
    ys, xs = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    ys, xs = ys.double(), xs.double()
    image = torch.zeros(camera.height, camera.width, 3, dtype=torch.float64)
    through = torch.ones(camera.height, camera.width, dtype=torch.float64)
    done = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    see = ThroughWindows() if screen_filter == "window" else partial(alone, FALLOFFS[screen_filter])
    for i in order:
        covariance, mean = project_one(g, i, p[i], camera)
        offset = torch.stack([xs - mean[0], ys - mean[1]], -1)
        alpha = see(covariance, offset, eps2d, g.opacities[i])
        done = done | ((through * (1 - alpha) < 1e-4) & (alpha > 0))
        alpha = torch.where(done, 0.0, alpha)
        image = image + (through * alpha)[..., None] * color_one(g, i, camera)
        through = through * (1 - alpha)
    return image + through[..., None] * torch.tensor(background, dtype=torch.float64), 1 - through


def dilated(covariance, offset, eps2d, least_compensation=1.0):
    """The Gaussian of `covariance` + eps2d·I at each offset [H, W, 2], scaled to keep its integral, but by `least_compensation` at least."""
    wider = covariance + eps2d * torch.eye(2, dtype=torch.float64)
    compensation = (torch.linalg.det(covariance) / torch.linalg.det(wider)).clamp(least_compensation**2, 1).sqrt()
    return compensation * torch.exp(-0.5 * torch.einsum("hwi,ij,hwj->hw", offset, torch.linalg.inv(wider), offset))


def alone(falloff, covariance, offset, eps2d, opacity):
    """Alpha of a splat that does not depend on those in front."""
    alpha = (opacity * falloff(covariance, offset, eps2d)).clamp_max(0.99)
    return torch.where(alpha >= 1 / 255, alpha, 0.0)


class ThroughWindows:
    """Gaussian Blending with windows kept within a pixel of the centers, its integrals as sums over many points."""

    def __init__(self):
        self.center, self.width = torch.zeros(2, dtype=torch.float64), torch.ones(2, dtype=torch.float64)
        nodes, weights = np.polynomial.legendre.leggauss(64)
        self.nodes, self.weights = torch.from_numpy(nodes) / 2, torch.from_numpy(weights) / 2

    def __call__(self, covariance, offset, eps2d, opacity):
        variances, axes = torch.linalg.eigh(covariance + eps2d * torch.eye(2, dtype=torch.float64))
        if axes[0, 0].abs() < axes[0, 1].abs():  # the first axis is the one nearer to x
            variances, axes = variances.flip(0), axes.flip(1)
        s = self.width[..., None] * self.nodes
        share = self.weights * torch.exp(-0.5 * (((offset + self.center) @ axes)[..., None] + s) ** 2 / variances[:, None])
        p, m, q = (moment.sum(-1) for moment in (share, s * share, s**2 * share))
        opacity = (0.99 / p.prod(-1).clamp_min(0.5)).clamp_max(opacity)  # where it is less, 0.99 is out of reach
        alpha = opacity * p.prod(-1)
        hidden, rest = opacity[..., None] * p.flip(-1), 1 - alpha[..., None]
        mean = -hidden * m / rest
        variance = (self.width**2 / 12 - hidden * q) / rest - mean**2
        width = (12 * variance.clamp_min(1e-3)).sqrt().clamp_max(2)
        center = self.center + mean @ axes.T
        center = torch.minimum(torch.maximum(center, width / 2 - 1), 1 - width / 2)
        seen = alpha[..., None] >= 1 / 255
        self.center, self.width = torch.where(seen, center, self.center), torch.where(seen, width, self.width)
        return torch.where(seen[..., 0], alpha, 0.0)


def integrated(covariance, offset, eps2d):
    """The Gaussian times its area, integrated over squares that lie along its axes."""
    variances, axes = torch.linalg.eigh(covariance + eps2d * torch.eye(2, dtype=torch.float64))
    places, sigmas = offset @ axes, variances.sqrt()
    return 2 * math.pi * (sigmas * (below((places + 0.5) / sigmas) - below((places - 0.5) / sigmas))).prod(-1)


def below(x):
    return 0.5 + 0.5 * torch.tanh(0.5 * (1.6 * x + 0.07 * x**3))


FALLOFFS = {
    "classic": dilated,
    "antialiased": partial(dilated, least_compensation=0.005),
    "mip": partial(dilated, least_compensation=0.001),
    "analytic": integrated,
}


def project_one(g, i, p, camera):
    x, y, z = p
    tan_x, tan_y = camera.width / camera.fx / 2, camera.height / camera.fy / 2
    u = (x / z).clamp(-camera.cx / camera.fx - 0.3 * tan_x, (camera.width - camera.cx) / camera.fx + 0.3 * tan_x)
    v = (y / z).clamp(-camera.cy / camera.fy - 0.3 * tan_y, (camera.height - camera.cy) / camera.fy + 0.3 * tan_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([torch.stack([camera.fx / z, zero, -camera.fx * u / z]), torch.stack([zero, camera.fy / z, -camera.fy * v / z])])
    if g.covariances is None:
        rotation = rotation_one(g.quats[i] / g.quats[i].norm())
        covariance = rotation @ torch.diag(g.scales[i] ** 2) @ rotation.T
    else:
        covariance = g.covariances[i]
    w = camera.viewmat[:3, :3]
    mean = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
    return jacobian @ w @ covariance @ w.T @ jacobian.T, mean


def rotation_one(q):
    w, v = q[0], q[1:]
    zero = torch.zeros_like(w)
    cross = torch.stack([torch.stack([zero, -v[2], v[1]]), torch.stack([v[2], zero, -v[0]]), torch.stack([-v[1], v[0], zero])])
    return torch.eye(3, dtype=q.dtype) + 2 * w * cross + 2 * cross @ cross


def color_one(g, i, camera):
    d = g.means[i] - camera.center
    d = d / d.norm()
    color = math.sqrt(1 / (4 * math.pi)) * g.sh[i, 0]
    if g.sh.shape[1] > 1:
        c1 = math.sqrt(3 / (4 * math.pi))
        color = color - c1 * d[1] * g.sh[i, 1] + c1 * d[2] * g.sh[i, 2] - c1 * d[0] * g.sh[i, 3]
    return (color + 0.5).clamp_min(0)
