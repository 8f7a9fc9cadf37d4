"""The decoding of anchors in float64, one anchor after the other, written from the formats' formulas and not from the package's code."""

import math

import numpy as np
import torch
from anchor_checkpoints import STANDARD, VOXEL, Layout
from oracle import rotation_one


def decode(columns, states, layout: Layout, camera, appearance=None):
    """Rows (anchor, mean, scales, quaternion, opacity, rgb) of the splats that a camera sees."""
    eye, rows = camera.center.numpy(), []
    for i in range(len(columns["x"])):
        one = {name: float(column[i]) for name, column in columns.items()}
        anchor = np.array([one["x"], one["y"], one["z"]])
        fade = faded(one, columns, anchor, eye, layout, camera) if layout.family == "octree" else 1.0
        if fade is None or not visible(one, anchor, camera):
            continue
        for splat in splats(one, anchor, anchor - eye, states, layout, appearance):
            opacity = splat[3] * fade
            if opacity > 0:
                rows.append((i, *splat[:3], opacity, splat[4]))
    return rows


def splats(one, anchor, ray, states, layout, appearance):
    distance = math.sqrt(ray @ ray)
    view, level = ray / distance, one.get("level")
    feature = np.array([one[f"f_anchor_feat_{j}"] for j in range(layout.features)])
    if layout.bank:
        tail = [distance] if layout.family == "scaffold" else [level] * layout.level
        logits = network(states["feature_bank_mlp"], [*view, *tail])
        share = np.exp(logits) / np.exp(logits).sum()
        feature = np.tile(feature[::4], 4) * share[0] + np.tile(feature[::2], 2) * share[1] + feature * share[2]

    def run(name, last=()):
        return network(states[name], [*feature, *view, *[distance] * (name in layout.distance), *[level] * layout.level, *last])

    opacities, shapes = np.tanh(run("opacity_mlp")), run("cov_mlp").reshape(layout.splats, 7)
    colors = sigmoid(run("color_mlp", () if appearance is None else appearance)).reshape(layout.splats, 3)
    reach, size = (np.exp([one[f"scale_{c}"] for c in range(a, a + 3)]) for a in (0, 3))
    for j in range(layout.splats):
        offset = np.array([one[f"f_offset_{c * layout.splats + j}"] for c in range(3)])
        quaternion = shapes[j, 3:] / math.sqrt(shapes[j, 3:] @ shapes[j, 3:])
        yield anchor + offset * reach, size * sigmoid(shapes[j, :3]), quaternion, opacities[j], colors[j]


def network(state, values):
    held = {key: value.astype(np.float64) for key, value in state.items()}
    hidden = np.maximum(held["0.weight"] @ np.array(values, np.float64) + held["0.bias"], 0)
    return held["2.weight"] @ hidden + held["2.bias"]


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def visible(one, anchor, camera):
    """The original's preprocess, with its tile rectangle spelled out."""
    view = camera.viewmat.numpy()
    x, y, z = view[:3, :3] @ anchor + view[:3, 3]
    if z <= 0.2:
        return False
    scales, quaternion = (np.array([one[f"{name}_{c}"] for c in range(count)]) for name, count in (("scale", 3), ("rot", 4)))
    scales, rotation = np.exp(scales), rotation_one(torch.from_numpy(quaternion / math.sqrt(quaternion @ quaternion))).numpy()
    covariance = rotation @ np.diag(scales**2) @ rotation.T
    limit = 1.3 * np.array([camera.width / camera.fx, camera.height / camera.fy]) / 2
    u, v = np.clip([x / z, y / z], -limit, limit)
    jacobian = np.array([[camera.fx / z, 0, -camera.fx * u / z], [0, camera.fy / z, -camera.fy * v / z]])
    flat = jacobian @ view[:3, :3] @ covariance @ view[:3, :3].T @ jacobian.T + 0.3 * np.eye(2)
    middle = np.trace(flat) / 2
    radius = math.ceil(3 * math.sqrt(middle + math.sqrt(max(0.1, middle**2 - np.linalg.det(flat)))))  # (forward.cu)
    for center, side in ((camera.fx * x / z + camera.cx - 0.5, camera.width), (camera.fy * y / z + camera.cy - 0.5, camera.height)):
        tiles = (side + 15) // 16
        first, last = (min(tiles, max(0, int(edge / 16))) for edge in (center - radius, center + radius + 15))
        if first >= last:
            return False
    return True


def faded(one, columns, anchor, eye, layout, camera):
    """The share of its opacity that an anchor of Octree-GS shows; None where its level is too fine."""
    levels = columns["level"].max() - columns["level"].min() + 1
    corner = anchor + VOXEL / 2 / 2 ** one["level"]
    wanted = math.log2(STANDARD / (math.dist(corner, eye) / camera.zoom)) + one["extra_level"]
    if layout.to_level == "progressive":
        wanted = min(max(wanted + 1, 0.9999), levels - 1 + 0.9999)
        whole = math.floor(wanted)
        return None if one["level"] > whole else wanted - whole if one["level"] == whole else 1.0
    whole = min(max({"floor": math.floor, "round": round, "ceil": math.ceil}[layout.to_level](wanted), 0), levels - 1)
    return 1.0 if one["level"] <= whole else None
