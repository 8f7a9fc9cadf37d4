"""gsplat checkpoints: every rank, every name, in and out again, and the normalized world found from COLMAP's points."""

import json
import math
import warnings

import numpy as np
import pytest
import tiny
import torch
from oracle import brute_force
from torch_checkpoints import Hostile, activated, aim, equal, gsplat_folder, normalized_by_numpy, splatfacto_folder, splats

from mipmap_plugin.errors import CheckpointError, MipmapPluginWarning, SceneError
from mipmap_plugin.evaluation.metrics import psnr
from mipmap_plugin.formats.tags import provenance_of
from mipmap_plugin.formats.yaml_scalars import read_scalars
from mipmap_plugin.models import load_model
from mipmap_plugin.models.adapted_name import adapted_name
from mipmap_plugin.models.adapted_scale import adapted_scale, adapted_viewer
from mipmap_plugin.models.hosts import Capture
from mipmap_plugin.models.live import adopt
from mipmap_plugin.wrap import wrap_model

NAMES = ["means", "scales", "quats", "opacities", "sh0", "shN"]


@pytest.mark.parametrize("antialiased", ["true", "false"])
def test_it_renders_as_an_independent_evaluation_in_float64(tmp_path, antialiased):
    raw, camera = splats(), tiny.cameras()[0]
    wrapped = wrap_model(gsplat_folder(tmp_path / "r", raw, antialiased=antialiased), backend="reference")
    screen_filter = {"true": "antialiased", "false": "classic"}[antialiased]
    expected, _ = brute_force(activated(raw), camera, screen_filter=screen_filter, near=0.01)
    assert torch.allclose(wrapped.render(camera).image.double(), expected, atol=1e-5)


def test_all_ranks_of_a_step_are_put_together_in_order(tmp_path):
    raw = splats(31)
    folder = gsplat_folder(tmp_path / "r", raw, ranks=11)  # rank 10 sorts before rank 2 by name
    model = load_model(folder)
    assert equal(model, raw)
    assert (model.family, model.folder, model.source.name) == ("gsplat", folder, "ckpt_6999_rank0.pt")
    assert "the splats of 11 ranks are put together" in " ".join(model.notes)
    assert equal(load_model(folder / "ckpts/ckpt_6999_rank7.pt"), raw)


def test_a_missing_rank_is_named(tmp_path):
    folder = gsplat_folder(tmp_path / "r", splats(), ranks=3)
    (folder / "ckpts/ckpt_6999_rank1.pt").unlink()
    with pytest.raises(CheckpointError, match="rank 1 of step 6999 is missing"):
        load_model(folder)


def test_the_newest_step_or_the_requested_one(tmp_path):
    raw, older = splats(), splats(seed=1)
    folder = gsplat_folder(tmp_path / "r", raw, step=29_999)
    gsplat_folder(tmp_path / "older", older, ranks=2)
    for file in (tmp_path / "older/ckpts").iterdir():
        file.rename(folder / "ckpts" / file.name)
    assert equal(load_model(folder), raw)
    assert equal(load_model(folder, iteration=6999), older)
    with pytest.raises(CheckpointError, match="no checkpoint of step 5; it has 6999, 29999"):
        load_model(folder, iteration=5)


def test_the_options_are_read_past_the_tags_of_python_objects(tmp_path):
    folder = gsplat_folder(tmp_path / "r", splats(), antialiased="true")
    trained = load_model(folder).trained
    assert (trained.screen_filter, trained.near_plane, trained.resolution) == ("antialiased", 0.01, 4)
    options = read_scalars(folder / "cfg.yml")
    assert options["far_plane"] == 1e10 and options["ckpt"] is None and options["data_dir"] == "data/360_v2/garden"
    assert options["refine_every"] == 100 and "strategy" not in options and "save_steps" not in options


def test_a_lone_file_is_classic_with_a_note(tmp_path):
    torch.save({"step": 7, "splats": splats()}, tmp_path / "lone.pt")
    model = load_model(tmp_path / "lone.pt")
    assert model.trained.screen_filter == "classic"
    assert "cfg.yml is not beside" in model.notes[0] and "2DGS" in model.notes[0]


@pytest.mark.parametrize("target", ["out", "out.pt"])
def test_saving_and_loading_gives_the_same_numbers_and_what_the_trainer_reads(tmp_path, target):
    raw = splats()
    folder = gsplat_folder(tmp_path / "r", raw, ranks=2, antialiased="true")
    saved = load_model(folder).save(tmp_path / target, provenance={"scale": 4})
    assert equal(load_model(tmp_path / target), raw)
    assert load_model(tmp_path / target).trained.screen_filter == "antialiased"
    content = torch.load(saved, weights_only=True)  # as simple_trainer.py reads it
    assert content["step"] == 6999 and set(content["splats"]) == set(NAMES)
    assert content["splats"]["opacities"].dim() == 1
    assert all(tensor.dtype == torch.float32 for tensor in content["splats"].values())
    assert provenance_of(content["comments"]) == {"scale": 4}


def test_poses_that_the_training_moved_are_carried_along(tmp_path):
    torch.save({"step": 7, "splats": splats(), "pose_adjust": {"embeds.weight": torch.ones(2, 9)}}, tmp_path / "a.pt")
    model = load_model(tmp_path / "a.pt")
    assert "the training moved its cameras" in model.notes[-1]
    saved = model.save(tmp_path / "b.pt", provenance={})
    assert torch.equal(torch.load(saved)["pose_adjust"]["embeds.weight"], torch.ones(2, 9))


def test_version_1_0_keeps_its_own_name_for_the_means_and_its_json(tmp_path):
    raw = splats()
    renamed = {"means3d" if name == "means" else name: tensor for name, tensor in raw.items()}
    (tmp_path / "r/ckpts").mkdir(parents=True)
    (tmp_path / "r/cfg.json").write_text(json.dumps({"antialiased": True, "data_factor": 2}))
    torch.save({"step": 29_999, "splats": renamed}, tmp_path / "r/ckpts/ckpt_29999.pt")
    model = load_model(tmp_path / "r")
    assert equal(model, raw) and model.trained.screen_filter == "antialiased"
    model.trained = type(model.trained)("classic")
    saved = model.save(tmp_path / "s", provenance={})
    assert set(torch.load(saved)["splats"]) == set(renamed)
    assert json.loads((tmp_path / "s/cfg.json").read_text()) == {"antialiased": False, "data_factor": 2}


@pytest.mark.parametrize("scale", [1 / 4, 4])
def test_adapting_for_classic_renderers_raises_the_quality_and_says_so_in_the_cfg(tmp_path, scale):
    folder, cameras = gsplat_folder(tmp_path / "r", splats(60), antialiased="true"), tiny.cameras()
    base = wrap_model(folder, cameras=cameras, backend="reference")
    adapted = base.adapt(scale, viewer="classic", steps=16 if scale < 1 else 0, extra_views=2)
    adapted.save(tmp_path / "out")
    again = wrap_model(tmp_path / "out", cameras=cameras, backend="reference")
    camera, truth = cameras[0].zoomed(scale), aim(base, cameras[0], scale)
    assert psnr(again.render(camera).image, truth) > psnr(base.render(camera, screen_filter="classic").image, truth) + 2
    assert read_scalars(tmp_path / "out/cfg.yml")["antialiased"] is False
    assert "  antialiased: null" in (folder / "cfg.yml").read_text()


@pytest.mark.parametrize("write", [gsplat_folder, splatfacto_folder])
@pytest.mark.parametrize("viewer", ["mip", "playcanvas-aa"])
def test_a_file_for_a_viewer_is_read_back_with_its_dilation(tmp_path, viewer, write):
    base = wrap_model(write(tmp_path / "r", splats(60)), cameras=tiny.cameras(), backend="reference")
    adapted = base.adapt(1 / 2, viewer=viewer, recipe="instant")
    trained = load_model(adapted.save(tmp_path / "out")).trained
    assert (trained.screen_filter, trained.eps2d) == ("mip", base.effects(viewer=viewer).eps2d)


@pytest.mark.parametrize("write", [gsplat_folder, splatfacto_folder])
def test_an_adapted_file_is_known_for_one_without_its_report(tmp_path, write):
    """Its pictures at x1, to which it would be adapted again, are wrong."""
    adapted = wrap_model(write(tmp_path / "r", splats()), cameras=tiny.cameras()).adapt(1 / 2, viewer="classic", recipe="instant")
    file = adapted.save(tmp_path / "out")
    file.with_name(f"{file.name}.adaptation.json").unlink()
    assert (adapted_scale(file), adapted_viewer(file), adapted_scale(load_model(tmp_path / "r").source)) == (0.5, "classic", None)


@pytest.mark.parametrize("target", ["out", "out.pt"])
def test_a_file_of_its_own_format_keeps_all_bands_and_is_not_said_to_lack_some(tmp_path, target):
    """A loader of PLYs does not read it, whatever bands it has."""
    raw = tiny.model(40).with_degree(4).parameters()
    adapted = wrap_model(gsplat_folder(tmp_path / "r", raw), cameras=tiny.cameras()).adapt(1 / 4, viewer="spark", recipe="instant")
    file = adapted.save(tmp_path / target)
    assert load_model(file).parameters()["shN"].shape[1] == 24 and not any("left out" in note for note in adapted.report_of(file).notes)


@pytest.mark.parametrize("write", [gsplat_folder, splatfacto_folder])
@pytest.mark.parametrize(("viewer", "ending"), [(None, ""), ("nerfstudio", "_nerfstudio"), ("spark", "_spark.ply"), ("classic", "_classic.ply")])
def test_a_viewer_that_reads_no_file_of_its_project_gets_a_ply(tmp_path, write, viewer, ending):
    assert adapted_name(write(tmp_path / "run", splats(4)), 1 / 4, viewer) == f"run_x0.25{ending}"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda s: {**s, "features": torch.zeros(30, 32), "colors": torch.zeros(30, 3)}, "trained with app_opt"),
        (lambda s: {name: s[name] for name in NAMES[:-1]}, "expected are means"),
        (lambda s: {**s, "opacities": s["opacities"][:, None]}, "opacities: expected shape"),
        (lambda s: {**s, "shN": s["shN"][:, :2]}, "fit no SH degree"),
        (lambda s: {**s, "means": s["means"] * math.nan}, "none of 30 splats is finite"),
        (lambda s: {name: tensor[:0] for name, tensor in s.items()}, "a.pt holds no splats; export it again"),
        (lambda s: {**s, "means": 7}, "means should be tensors"),
        (lambda s: [s], "no dictionary of splats"),
        (lambda s: {**s, "hook": Hostile()}, "is not executed"),
    ],
)
def test_what_is_no_gsplat_checkpoint_is_refused_in_one_sentence(tmp_path, change, sentence, capsys):
    torch.save({"step": 1, "splats": change(splats())}, tmp_path / "a.pt")
    with pytest.raises(CheckpointError, match=sentence):
        load_model(tmp_path / "a.pt")
    assert capsys.readouterr().out == ""


def test_flat_splats_are_surfels_whose_third_scale_stays_as_it_is(tmp_path):
    """simple_trainer_2dgs stores three scales, of which its rasterizer reads two."""
    folder = gsplat_folder(tmp_path / "r", splats())
    (folder / "cfg.yml").write_text("model_type: 2dgs\n")
    model = load_model(folder)
    assert (model.family, model.trained.screen_filter, model.trained.eps2d, model.trained.keeps_filter) == ("gsplat", "surfel", 0.5, True)
    assert (model.gaussians().scales[:, 2] == 0).all()
    student = model.copy()
    student.reshape(lambda held: (2 * held.scales, held.opacities))
    again = load_model(student.save(tmp_path / "s", provenance={}).parents[1])
    torch.testing.assert_close(again.parameters()["scales"][:, :2], model.parameters()["scales"][:, :2] + math.log(2))
    assert torch.equal(again.parameters()["scales"][:, 2], model.parameters()["scales"][:, 2])
    assert again.trained == model.trained


# The normalized world


@pytest.mark.parametrize("turn", [(1, 1, 1), (1, -1, -1), (-1, -1, 1)])
def test_the_normalized_world_is_found_again_whatever_half_turn_was_taken(tmp_path, turn):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)) ** 3 @ np.diag([3.0, 1.0, 2.0]) + [1.0, 2.0, 3.0]
    cameras = tiny.cameras(5, width=128, height=96)
    frame = np.diag([*turn, 1.0]) @ normalized_by_numpy(cameras, points)
    raw = {**splats(500), "means": torch.tensor(points @ frame[:3, :3].T + frame[:3, 3], dtype=torch.float32)}
    model = load_model(gsplat_folder(tmp_path / "r", raw))
    placed = model.as_trained(cameras, Capture(torch.tensor(points)))
    for camera, new in zip(cameras, placed, strict=True):
        pose = frame @ np.linalg.inv(camera.viewmat.numpy())
        pose[:3, :3] /= np.linalg.norm(pose[0, :3])
        assert np.allclose(new.viewmat.numpy(), np.linalg.inv(pose), atol=1e-6)
        assert (new.width, new.height, new.fx) == (32, 24, camera.fx / 4)
    with pytest.raises(SceneError, match="give the scene that gsplat was trained on"):
        model.as_trained(cameras, Capture(torch.tensor(points) @ torch.diag(torch.tensor([1.0, 9.0, 1.0])).double()))
    with pytest.raises(SceneError, match=r"give the COLMAP scene .* has to say normalize_world_space: false"):
        model.as_trained(cameras, Capture())


def test_without_its_options_the_cameras_keep_their_size_with_a_warning(tmp_path):
    rng = np.random.default_rng(0)
    points, cameras = torch.tensor(rng.normal(size=(500, 3)) @ np.diag([3.0, 1.0, 2.0])), tiny.cameras(5, width=128, height=96)
    folder = gsplat_folder(tmp_path / "r", splats(500))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_model(folder).as_trained(cameras, Capture(points))[0].size == (24, 32)
    (folder / "cfg.yml").unlink()
    for model in (load_model(folder), adopt(splats(500))):
        with pytest.warns(MipmapPluginWarning, match="x1 is taken to be the size of the cameras, but gsplat's trainer shrinks"):
            assert model.as_trained(cameras, Capture(points))[0].size == (96, 128)


def test_a_world_that_was_not_normalized_is_the_scenes_own(tmp_path):
    model = load_model(gsplat_folder(tmp_path / "r", splats(), normalized="false"))
    camera = tiny.cameras(1, width=128, height=96)[0]
    [placed] = model.as_trained([camera], Capture())
    assert torch.equal(placed.viewmat, camera.viewmat) and placed.size == (24, 32)
