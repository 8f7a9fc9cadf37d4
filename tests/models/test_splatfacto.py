"""splatfacto checkpoints: read past NumPy scalars and Python tags, rendered in their frame, and written back with all else as it was."""

import json
import math

import pytest
import tiny
import torch
from oracle import brute_force
from torch_checkpoints import Hostile, activated, aim, equal, splatfacto_content, splatfacto_folder, splatfacto_state, splats

from mipmap_plugin.errors import CheckpointError, OutputError, SceneError
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.yaml_scalars import read_scalars
from mipmap_plugin.models import load_model
from mipmap_plugin.models.hosts import Capture
from mipmap_plugin.wrap import wrap_model

CKPT = "nerfstudio_models/step-000029999.ckpt"
PREFIXES = ["_model.gauss_params.", "_model.", "_model.module.gauss_params.", "module._model.gauss_params."]

# Rotation by 30 degrees around z, a shift, and a size: what nerfstudio's orientation, centering and scaling come to.
COS, SIN = math.cos(math.pi / 6), math.sin(math.pi / 6)
TRANSFORMS = {"transform": [[COS, -SIN, 0, 0.5], [SIN, COS, 0, -0.2], [0, 0, 1, 0.1]], "scale": 0.25}


@pytest.mark.parametrize(("mode", "bands"), [("classic", 3), ("antialiased", 3), ("classic", 0)])
def test_it_renders_as_an_independent_evaluation_in_float64(tmp_path, mode, bands):
    raw, camera = splats(bands=bands), tiny.cameras()[0]
    wrapped = wrap_model(splatfacto_folder(tmp_path / "r", raw, mode))
    if not bands:  # a color is the sigmoid of its logit, here as SH of that color
        raw["sh0"] = (raw["sh0"].double().sigmoid() - 0.5) * (2 * math.sqrt(math.pi))
    expected, _ = brute_force(activated(raw), camera, screen_filter=mode, near=0.01, background=(0.1490, 0.1647, 0.2157))
    assert torch.allclose(wrapped.render(camera).image.double(), expected, atol=1e-5)


@pytest.mark.parametrize("prefix", PREFIXES)
def test_old_and_parallel_trainings_are_read_and_written_under_their_own_names(tmp_path, prefix):
    raw = splats()
    model = load_model(splatfacto_folder(tmp_path / "r", raw, prefix=prefix))
    assert equal(model, raw) and model.family == "splatfacto"
    saved = model.save(tmp_path / "out.ckpt", provenance={})
    written = load_torch_unsafely(saved)["pipeline"]
    original = load_torch_unsafely(tmp_path / "r" / CKPT)["pipeline"]
    assert {name: tuple(tensor.shape) for name, tensor in written.items()} == {name: tuple(tensor.shape) for name, tensor in original.items()}


def load_torch_unsafely(path):
    """As nerfstudio does; the file was written by this test."""
    return torch.load(path, weights_only=False)


def test_only_the_splats_change_in_a_file_that_is_written(tmp_path):
    folder = splatfacto_folder(tmp_path / "r", splats())
    model = load_model(folder).copy()
    with torch.no_grad():
        model.parameters()["means"].add_(1)
    model.replace_parameters({name: tensor.detach()[:20] for name, tensor in model.parameters().items()})
    written = load_torch_unsafely(model.save(tmp_path / "out", provenance={"scale": 4}))
    original = load_torch_unsafely(folder / CKPT)
    for name, tensor in original["pipeline"].items():
        changed = written["pipeline"][name]
        if "gauss_params" not in name:
            assert torch.equal(changed, tensor)
        elif name.endswith("means"):
            assert torch.equal(changed, tensor[:20] + 1)
        else:
            assert torch.equal(changed, tensor[:20])
    assert written["step"] == 29_999 and set(written) == {*original, "comments"}
    assert written["schedulers"] == original["schedulers"]
    assert written["optimizers"]["means"]["param_groups"] == original["optimizers"]["means"]["param_groups"]


def test_a_folder_is_written_that_nerfstudio_finds_beside_the_old_one(tmp_path):
    raw = splats()
    folder = splatfacto_folder(tmp_path / "2024-05-01_120000", raw, "antialiased")
    (folder / "dataparser_transforms.json").write_text(json.dumps(TRANSFORMS))
    model = load_model(folder)
    model.trained = type(model.trained)("classic")
    saved = model.save(tmp_path / "x0.25", provenance={})
    assert saved == tmp_path / "x0.25" / CKPT
    options = read_scalars(tmp_path / "x0.25/config.yml")
    assert (options["timestamp"], options["rasterize_mode"], options["background_color"]) == ("x0.25", "classic", "random")
    old, new = ((place / "config.yml").read_text().splitlines() for place in (folder, tmp_path / "x0.25"))
    changed = [(before, after) for before, after in zip(old, new, strict=True) if before != after]
    assert changed == [("    rasterize_mode: antialiased", "    rasterize_mode: classic"), ("timestamp: 2024-05-01_120000", 'timestamp: "x0.25"')]
    assert json.loads((tmp_path / "x0.25/dataparser_transforms.json").read_text()) == TRANSFORMS
    again = load_model(tmp_path / "x0.25")
    assert equal(again, raw) and again.trained.screen_filter == "classic"


def test_a_run_of_a_version_without_the_option_is_told_to_be_drawn_classic(tmp_path):
    folder = splatfacto_folder(tmp_path / "r", splats())
    config = folder / "config.yml"
    config.write_text("".join(line for line in config.read_text().splitlines(keepends=True) if "rasterize_mode" not in line))
    adapted = wrap_model(folder, cameras=tiny.cameras()).adapt(1 / 2, viewer="nerfstudio-antialiased", recipe="instant")
    with pytest.warns(UserWarning, match="out: its config.yml is of a nerfstudio without rasterize_mode, which draws the splats classic, and not"):
        adapted.save(tmp_path / "out")


def test_colors_without_sh_come_back_as_the_same_colors(tmp_path):
    raw = splats(bands=0)
    raw["sh0"][0] = 12.0  # a color that float32 rounds to 1
    model = load_model(splatfacto_folder(tmp_path / "r", raw))
    written = load_torch_unsafely(model.save(tmp_path / "out.ckpt", provenance={}))["pipeline"]["_model.gauss_params.features_dc"]
    assert torch.allclose(written.sigmoid(), raw["sh0"][:, 0].sigmoid(), atol=1e-6)
    again = load_model(tmp_path / "out.ckpt").parameters()["sh0"]
    assert torch.allclose(again, model.parameters()["sh0"], atol=1e-5)


# Cameras


def test_the_cameras_of_the_scene_are_carried_into_the_frame_of_the_checkpoint(tmp_path):
    folder = splatfacto_folder(tmp_path / "r", splats())
    (folder / "dataparser_transforms.json").write_text(json.dumps(TRANSFORMS))
    model, camera = load_model(folder), tiny.cameras()[0]
    [placed] = model.as_trained([camera], Capture())
    transform, scale = torch.tensor(TRANSFORMS["transform"], dtype=torch.float64), TRANSFORMS["scale"]
    assert torch.allclose(placed.center, scale * (transform[:, :3] @ camera.center + transform[:, 3]))
    seen = lambda view, points: points @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]  # noqa: E731
    points = torch.randn(9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    moved = scale * (points @ transform[:, :3].T + transform[:, 3])
    assert torch.allclose(seen(placed, moved), scale * seen(camera, points))
    assert placed.size == camera.size


@pytest.mark.parametrize(
    ("downscale", "ratio", "size"),
    [
        *(("null", None, (500, 1000)), ("1", None, (2000, 4000)), ("2", None, (1000, 2000))),
        *(("2", "0.5", (500, 1000)), ("null", "0.7", (350, 700)), ("2", "null", (1000, 2000))),  # of the datamanager
    ],
)
def test_photographs_that_were_shrunk_for_the_training_are_so_small(tmp_path, downscale, ratio, size):
    folder = splatfacto_folder(tmp_path / "r", splats(), downscale=downscale + (f"\n    camera_res_scale_factor: {ratio}" if ratio else ""))
    (folder / "dataparser_transforms.json").write_text(json.dumps(TRANSFORMS))
    [camera] = tiny.cameras(1, width=4000, height=2000)
    [placed] = load_model(folder).as_trained([camera], Capture())
    assert placed.size == size
    assert placed.fx == pytest.approx(camera.fx * size[1] / 4000)


@pytest.mark.parametrize("content", [None, "{", '{"scale": 1}', '{"scale": 1, "transform": [[1, 0], [0, 1]]}', '{"scale": "a", "transform": []}'])
def test_without_its_transform_the_cameras_cannot_be_placed(tmp_path, content):
    folder = splatfacto_folder(tmp_path / "r", splats())
    if content is not None:
        (folder / "dataparser_transforms.json").write_text(content)
    with pytest.raises(SceneError, match=r"dataparser_transforms.json.*copy it"):
        load_model(folder).as_trained(tiny.cameras(), Capture())


# Adapting


@pytest.mark.parametrize("scale", [1 / 4, 4])
def test_adapting_raises_the_quality(tmp_path, scale):
    folder, cameras = splatfacto_folder(tmp_path / "r", splats(60)), tiny.cameras()
    base = wrap_model(folder, cameras=cameras, background=(0.0, 0.0, 0.0))
    adapted = base.adapt(scale, steps=16 if scale < 1 else 0, extra_views=2)
    saved = adapted.save(tmp_path / "out")
    again = wrap_model(tmp_path / "out", cameras=cameras, background=(0.0, 0.0, 0.0))
    camera, truth = cameras[0].zoomed(scale), aim(base, cameras[0], scale)
    assert psnr(again.render(camera).image, truth) > psnr(base.render(camera).image, truth) + 2
    assert saved.with_name(saved.name + ".adaptation.json").is_file()


# Notes and refusals


def test_notes_name_what_is_not_applied(tmp_path):
    pipeline = {**splatfacto_state(splats()), "_model.camera_optimizer.pose_adjustment": torch.zeros(3, 6)}
    torch.save(splatfacto_content(pipeline), tmp_path / "a.ckpt")
    notes = " ".join(load_model(tmp_path / "a.ckpt").notes)
    assert "config.yml is not beside" in notes and "moved its cameras" in notes
    assert "bilateral grid" in load_model(splatfacto_folder(tmp_path / "r", splats(), grid="true")).notes[0]


def test_what_its_splats_have_beyond_those_of_splatfacto_is_told_of(tmp_path):
    torch.save(splatfacto_content({**splatfacto_state(splats()), "_model.gauss_params.normals": torch.zeros(3, 3)}), tmp_path / "a.ckpt")
    assert any(note.startswith("its splats also have normals, which splatfacto's have not: ") for note in load_model(tmp_path / "a.ckpt").notes)


@pytest.mark.parametrize(
    ("pipeline", "sentence"),
    [
        ({"_model.gauss_params.means": torch.zeros(2, 3)}, "lacks scales, quats"),
        ({"_model.field.weight": torch.zeros(2, 3)}, "lacks means"),
        ({**splatfacto_state(splats()), "_model.gauss_params.quats": torch.zeros(30, 3)}, "quats: expected shape"),
        ({**splatfacto_state(splats()), "_model.gauss_params.features_rest": torch.zeros(30)}, "do not fit together"),
        ({**splatfacto_state(splats()), "_model.gauss_params.means": torch.full((30, 3), math.nan)}, "none of 30 splats is finite"),
        ({**splatfacto_state(splats()), "_model.hook": Hostile()}, "is not executed"),
        ([], "no pipeline"),
    ],
)
def test_what_is_no_splatfacto_checkpoint_is_refused_in_one_sentence(tmp_path, pipeline, sentence, capsys):
    torch.save({"step": 1, "pipeline": pipeline}, tmp_path / "a.ckpt")
    with pytest.raises(CheckpointError, match=sentence):
        load_model(tmp_path / "a.ckpt")
    assert capsys.readouterr().out == ""


def test_no_name_is_written_that_nerfstudio_stops_at(tmp_path):
    model = load_model(splatfacto_folder(tmp_path / "r", splats()))
    with pytest.raises(OutputError, match="nerfstudio reads the step from every name"):
        model.save(tmp_path / "r/nerfstudio_models/adapted.ckpt", provenance={})
