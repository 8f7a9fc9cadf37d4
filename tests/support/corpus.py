"""One small sound checkpoint or scene for each kind of file that is read, and which of its files is damaged."""

import gzip
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import anchor_checkpoints
import gltf_files
import moving
import moving_captures
import numpy as np
import ply_files
import tiny
import torch
import torch_checkpoints
from PIL import Image

from mipmap_plugin.adaptation.adapted import Adapted
from mipmap_plugin.adaptation.optimization import resume
from mipmap_plugin.adaptation.target import super_resolution
from mipmap_plugin.errors import CheckpointError
from mipmap_plugin.formats.magic import SPLAT_RECORD
from mipmap_plugin.formats.state_dict import read_state_dict
from mipmap_plugin.models import load_model
from mipmap_plugin.models.hosts import Capture
from mipmap_plugin.scenes import load_scene
from mipmap_plugin.wrap import wrap_model


@dataclass(frozen=True)
class Sample:
    make: Callable[[Path], Path]  # fills an empty folder; what to open
    damaged: str  # the file that is damaged, in that folder
    kinds: tuple[str, ...]  # what is done to it: functions of `mutations`
    is_scene: bool = False
    open: Callable[[Path], None] | None = None  # where it is neither a checkpoint nor a scene

    def opened(self, path: Path) -> None:
        """Read all that a command would read of it."""
        (self.open or (open_scene if self.is_scene else open_checkpoint))(path)


def open_checkpoint(path: Path) -> None:
    """Load, and draw one small view, which has to be finite."""
    model = wrap_model(path, backend="reference")
    camera = model.any_camera()
    image = model.render(replace(camera.resized(8, 6), time=0.4)).image
    assert image.isfinite().all(), "the image is not finite"


def open_scene(path: Path) -> None:
    """Load, and let a checkpoint be seen by its cameras."""
    scene = load_scene(path)
    model = wrap_model(tiny.model(5), cameras=scene, backend="reference")
    for camera in scene.cameras[:2]:
        assert model.render(camera.resized(8, 6)).image.isfinite().all(), "the image is not finite"


def open_images(path: Path) -> None:
    scene = load_scene(path)
    for camera in scene.cameras:
        assert scene.image(camera, (1.0, 1.0, 1.0)).isfinite().all(), "the photograph is not finite"


def open_placed(path: Path) -> None:
    """A checkpoint, and a scene seen in its frame."""
    model = load_model(path)
    assert model.as_trained(tiny.cameras(2), Capture())


def open_state(path: Path) -> None:
    """Go on with an interrupted run."""
    _quick_run(path)


def open_exchange(path: Path) -> None:
    """A format for which the error names the command that converts it counts as read."""
    try:
        open_checkpoint(path)
    except CheckpointError as error:
        if "convert it first" not in str(error):
            raise


def open_network(path: Path) -> None:
    """The weights of an upsampler, of which spandrel makes a network."""
    super_resolution._weights(path)


def _quick_run(state: Path) -> Adapted:
    model = wrap_model(tiny.model(8), cameras=tiny.cameras(2, width=8, height=6), backend="reference")
    return model.adapt(1 / 2, steps=2, extra_views=0, views_per_step=1, resume=state)


def _state(path: Path) -> Path:
    path.mkdir()
    kept, resume.SAVE_EVERY_S = resume.SAVE_EVERY_S, 0.0
    try:
        _quick_run(path / "state")
    finally:
        resume.SAVE_EVERY_S = kept
    return path / "state"


def _network(path: Path) -> Path:
    path.mkdir()
    rng = torch.Generator().manual_seed(0)
    shapes = {"lin0.model.1.weight": (1, 3, 1, 1), "layer.weight": (4, 3), "layer.bias": (4,)}
    torch.save({name: torch.randn(shape, generator=rng) for name, shape in shapes.items()}, path / "net.pth")
    return path / "net.pth"


def _pictures(form: str, mode: str) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        scene = tiny.scene(path, test=tiny.cameras(1, split="test", width=16, height=12))
        rgb = Image.open(scene / "test/view_0.png")
        picture = rgb.convert("I").point(lambda value: value * 256).convert("I;16") if mode == "I;16" else rgb.convert(mode)
        picture.save(scene / "test/view_0.png", format=form)
        return scene

    return make


def _gsplat_json(path: Path) -> Path:
    folder = _gsplat(path)
    (folder / "cfg.yml").unlink()
    facts = {"antialiased": True, "data_factor": 4, "sh_degree": 3, "near_plane": 0.01, "normalize_world_space": False, "model_type": "3dgs"}
    (folder / "cfg.json").write_text(json.dumps(facts))
    return folder


def _dot_splat(path: Path) -> Path:
    path.mkdir()
    rows = np.zeros(20, SPLAT_RECORD)
    rows["scale"], rows["quat"] = 0.1, (255, 128, 128, 128)
    rows.tofile(path / "a.splat")
    return path / "a.splat"


def _glb(path: Path) -> Path:
    path.mkdir()
    return gltf_files.glb(path / "a.glb", tiny.gaussians(8))


def _gltf(path: Path) -> Path:
    path.mkdir()
    made, data = gltf_files.document(gltf_files.attributes(tiny.gaussians(8)))
    made["buffers"][0]["uri"] = "a.bin"
    (path / "a.bin").write_bytes(data)
    (path / "a.gltf").write_text(json.dumps(made))
    return path / "a.gltf"


def _spz(path: Path) -> Path:
    path.mkdir()
    count, bytes_a_splat = 10, 9 + 1 + 3 + 3 + 3  # version 2: center, opacity, color, scales, rotation
    (path / "a.spz").write_bytes(gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 2, count, 0, 12, 0, 0) + bytes(count * bytes_a_splat)))
    return path / "a.spz"


def _folder(path: Path) -> Path:
    tiny.folder(path.with_name("made"), tiny.cameras(3), count=20).rename(path)  # no model is saved to the name of another file
    (path / "cfg_args").write_text("Namespace(sh_degree=1, resolution=2, white_background=True, images='images_2', kernel_size=0.1, eval=True)")
    identity = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.0]]
    (path / "exposure.json").write_text(json.dumps({"view_0": identity, "view_1": identity}))
    return path


def _ply(form: str, lists: bool = False) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        path.mkdir()
        file = ply_files.write_splats(path / "a.ply", 12, 3, form=form, comments=("SplatRenderMode: default", 'mipmap_plugin {"scale": 1.0}'))
        if lists:
            header, body = file.read_bytes().split(b"element vertex")
            face = b"element face 2\nproperty list uchar int vertex_indices\nproperty list uint float more\n"
            rows = (b"\x03" + bytes(12) + b"\x01\x00\x00\x00" + bytes(4)) * 2
            body = body.replace(b"end_header\n", b"end_header\n" + (rows if form != "ascii" else b"3 0 1 2 1 0.5\n" * 2), 1)
            file.write_bytes(header + face + b"element vertex" + body)
        return file

    return make


def _mip(path: Path) -> Path:
    path.mkdir()
    columns = {**ply_files.splat_columns(12, 0), "filter_3D": np.full(12, 0.01, np.float32)}
    return ply_files.write(path / "a.ply", columns)


def _adapted(path: Path) -> Path:
    return wrap_model(tiny.ply(path.with_name("base.ply")), cameras=tiny.cameras(2)).adapt(1 / 2, recipe="instant").save(path / "a.ply")


def _anchors(layout: anchor_checkpoints.Layout) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        anchor_checkpoints.write(path, layout, count=12)
        return path

    return make


def _gsplat(path: Path) -> Path:
    return torch_checkpoints.gsplat_folder(path, torch_checkpoints.splats(12))


def _splatfacto(path: Path) -> Path:
    return torch_checkpoints.splatfacto_folder(path, torch_checkpoints.splats(12))


def _placed_splatfacto(path: Path) -> Path:
    folder = _splatfacto(path)
    facts = {"scale": 0.5, "transform": [[1.0, 0, 0, 0.1], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]}
    (folder / "dataparser_transforms.json").write_text(json.dumps(facts))
    return folder


def _transforms(path: Path) -> Path:
    path.mkdir()
    pose = np.eye(4).tolist()
    pose[2][3] = 3.0
    lens = {"camera_angle_x": 0.8, "fl_y": 20.0, "cx": 9.0, "w": 20, "h": 15, "k1": 0.0, "camera_model": "OPENCV"}
    frames = [{"file_path": f"./images/{i}", "transform_matrix": pose, "time": 0.5} for i in range(2)]
    (path / "transforms.json").write_text(json.dumps({**lens, "applied_transform": pose[:3], "frames": frames}, indent=1))
    return path


def _colmap(path: Path) -> Path:
    import colmap_files
    import pycolmap

    colmap_files.write_text_model(path / "text", colmap_files.names(3))
    (path / "sparse/0").mkdir(parents=True)
    pycolmap.Reconstruction(path / "text").write_binary(path / "sparse/0")
    return path


def _deformable(path: Path) -> Path:
    return moving.write_deformable(path, moving.deform_state(width=8))


SPLATS = "point_cloud/iteration_30000/point_cloud.ply"
BINARY, TEXT, OPTIONS = ("of_bytes",), ("of_text", "of_text", "of_bytes"), ("of_options", "of_options", "of_text")
PLY, TORCH = ("of_bytes", "of_text"), ("of_bytes", "of_torch", "of_torch")
PICTURE, PICTURES = "test/view_0.png", ("of_bytes", "of_png")
SCAFFOLD, UNITED = anchor_checkpoints.Layout(appearance=(3, 2)), anchor_checkpoints.Layout(united=True)

SAMPLES: dict[str, Sample] = {
    "ply": Sample(_ply("binary_little_endian"), "a.ply", PLY),
    "ply, ascii": Sample(_ply("ascii"), "a.ply", PLY),
    "ply, big endian": Sample(_ply("binary_big_endian"), "a.ply", PLY),
    "ply, lists": Sample(_ply("binary_little_endian", lists=True), "a.ply", PLY),
    "ply, ascii lists": Sample(_ply("ascii", lists=True), "a.ply", PLY),
    "ply, adapted": Sample(_adapted, "a.ply", PLY),
    "ply of Mip-Splatting": Sample(_mip, "a.ply", PLY),
    "ply of Scaffold-GS": Sample(_anchors(UNITED), SPLATS, PLY),
    "ply of Octree-GS": Sample(_anchors(anchor_checkpoints.Layout("octree", united=True)), SPLATS, PLY),
    "cfg_args": Sample(_folder, "cfg_args", OPTIONS),
    "cfg_args of 4D Gaussians": Sample(moving.write_hexplane, "cfg_args", OPTIONS),
    "cfg_args of Octree-GS": Sample(_anchors(anchor_checkpoints.Layout("octree", united=True)), "cfg_args", OPTIONS),
    "cameras.json": Sample(_folder, "cameras.json", ("of_json", *TEXT)),
    "exposure.json": Sample(_folder, "exposure.json", ("of_json", *TEXT)),
    "poses_bounds.npy": Sample(moving_captures.dynerf, "poses_bounds.npy", BINARY, open=lambda path: load_scene(path) and None),
    "dataset.json": Sample(moving_captures.hypernerf, "dataset.json", ("of_json", *TEXT), is_scene=True),
    "a camera of HyperNeRF": Sample(moving_captures.hypernerf, "camera/000001.json", ("of_json", *TEXT), is_scene=True),
    "transforms.json": Sample(_transforms, "transforms.json", ("of_json", "of_json", *TEXT), is_scene=True),
    "deform.pth": Sample(_deformable, "deform/iteration_40000/deform.pth", TORCH),
    "deformation.pth": Sample(moving.write_hexplane, "point_cloud/iteration_14000/deformation.pth", TORCH),
    "checkpoints.pth": Sample(_anchors(UNITED), "point_cloud/iteration_30000/checkpoints.pth", TORCH),
    "opacity_mlp.pt": Sample(_anchors(SCAFFOLD), "point_cloud/iteration_30000/opacity_mlp.pt", BINARY),
    "ckpt of gsplat": Sample(_gsplat, "ckpts/ckpt_6999_rank0.pt", TORCH),
    "cfg.yml": Sample(_gsplat, "cfg.yml", OPTIONS),
    "ckpt of splatfacto": Sample(_splatfacto, "nerfstudio_models/step-000029999.ckpt", TORCH),
    "config.yml": Sample(_splatfacto, "config.yml", OPTIONS),
    "cfg.json": Sample(_gsplat_json, "cfg.json", ("of_json", *TEXT), open=open_placed),
    "dataparser_transforms.json": Sample(_placed_splatfacto, "dataparser_transforms.json", ("of_json", *TEXT), open=open_placed),
    "state of a run": Sample(_state, "state", BINARY, open=open_state),
    "state dict of a network": Sample(_network, "net.pth", TORCH, open=lambda path: read_state_dict(path) and None),
    "weights of an upsampler": Sample(_network, "net.pth", TORCH, open=open_network),
    "png": Sample(_pictures("PNG", "RGBA"), PICTURE, PICTURES, open=open_images),
    "png, 16 bits": Sample(_pictures("PNG", "I;16"), PICTURE, PICTURES, open=open_images),
    "png, palette": Sample(_pictures("PNG", "P"), PICTURE, PICTURES, open=open_images),
    "jpeg": Sample(_pictures("JPEG", "RGB"), PICTURE, BINARY, open=open_images),
    ".splat": Sample(_dot_splat, "a.splat", BINARY, open=open_exchange),
    "glb": Sample(_glb, "a.glb", BINARY),
    "gltf": Sample(_gltf, "a.gltf", ("of_json", *TEXT)),
    ".spz": Sample(_spz, "a.spz", BINARY, open=open_exchange),
    "COLMAP cameras": Sample(_colmap, "sparse/0/cameras.bin", BINARY, is_scene=True),
    "COLMAP images": Sample(_colmap, "sparse/0/images.bin", BINARY, is_scene=True),
    "COLMAP rigs": Sample(_colmap, "sparse/0/rigs.bin", BINARY, is_scene=True),
    "COLMAP frames": Sample(_colmap, "sparse/0/frames.bin", BINARY, is_scene=True),
    "COLMAP points": Sample(_colmap, "sparse/0/points3D.bin", BINARY, is_scene=True),
}
