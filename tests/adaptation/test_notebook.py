"""What models show of themselves, in a notebook and elsewhere, and the notebook of the examples, run without Jupyter."""

import ast
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import tiny
import torch

from mipmap_plugin import load_model, load_scene, wrap_model
from mipmap_plugin.cli import main
from mipmap_plugin.errors import MipmapPluginError, SettingsError
from mipmap_plugin.formats.images import image_size
from mipmap_plugin.models.adapted_scale import adapted_scale

pytestmark = pytest.mark.usefixtures("few_views")

NOTEBOOK = Path(__file__).parents[2] / "examples" / "notebook.ipynb"


@pytest.fixture(scope="module")
def base():
    return wrap_model(tiny.model(), cameras=tiny.cameras(3))


@pytest.fixture(scope="module")
def adapted(base):
    return base.adapt(1 / 2, viewer="classic", steps=3, views="given")


def test_a_base_says_what_it_is(base):
    assert repr(base) == "<Wrapped: family 3dgs, splats 60, cameras 3 of 32 x 24 px, drawn with classic, 0.3 px², file in memory>"


def test_an_adapted_model_says_what_it_is_and_gained(adapted):
    report = adapted.report
    gain = f"{report.psnr_before():.2f} -> {report.psnr_after():.2f} dB on views that nothing was adapted to"
    splats, seconds = f"60 -> {report.gaussians_after}", f"{report.seconds['total']:.1f}"
    expected = f"family 3dgs, scale x0.5, made for classic, splats {splats}, PSNR {gain}, seconds {seconds}, ended by 3 steps"
    assert repr(adapted) == f"<Adapted: {expected}>"


def test_what_holds_many_numbers_says_what_it_is_in_a_line(base, adapted, tmp_path):
    path, report = tiny.scene(tmp_path / "scene", tiny.cameras(2)), adapted.report
    gain = f"{report.psnr_before():.2f} -> {report.psnr_after():.2f} dB on views that nothing was adapted to"
    splats = f"60 -> {report.gaussians_after}"
    assert repr(load_scene(path)) == f"<Scene: cameras 2 of 32 x 24 px, photographs 2, from {path}>"
    assert repr(base.model.gaussians()) == "<Gaussians: splats 60, SH degree 1, float32 on cpu>"
    assert str(report) == repr(report) == f"<Report: scale x0.5, splats {splats}, {gain}, ended by 3 steps>"


@pytest.mark.parametrize("shown", ["base", "adapted"])
def test_a_notebook_shows_a_table_and_a_picture(request, shown):
    html = request.getfixturevalue(shown)._repr_html_()
    assert html.count("data:image/png;base64,") == 1 and "image-rendering:pixelated" in html
    for fact in re.findall(r"(?<=splats )[^,]*", repr(request.getfixturevalue(shown))):
        assert f"<td style='text-align:left'>{fact.replace('>', '&gt;')}</td>" in html


def test_no_name_of_a_file_becomes_markup(tmp_path):
    ply = tiny.ply(tmp_path / "<b>bold.ply")
    assert "<b>bold" not in wrap_model(ply, cameras=tiny.cameras(1))._repr_html_()


def test_the_views_of_an_adapted_model_have_its_scale(base, adapted):
    assert [view.size for view in adapted.views()] == [(12, 16)] * 3
    assert [replace(view, zoom=1.0).name for view in adapted.views()] == [view.name for view in base.views()]
    assert torch.equal(adapted.views()[0].viewmat, base.views()[0].viewmat)


def test_the_curve_of_an_adapted_model_is_plotted(adapted):
    pytest.importorskip("matplotlib")
    figure = adapted.plot()
    [axes] = figure.axes
    assert [list(axes.lines[0].get_xdata()), list(axes.lines[0].get_ydata())] == [
        [point.seconds for point in adapted.report.curve], [point.validation_db for point in adapted.report.curve],
    ]  # fmt: skip
    assert figure._repr_png_().startswith(b"\x89PNG")


def test_a_plot_without_matplotlib_is_one_sentence(adapted, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(SettingsError, match=r'pip install "mipmap-plugin\[plot\]"'):
        adapted.plot()


def test_render_takes_the_scale_that_a_file_was_adapted_to(tmp_path, capsys):
    base = tiny.folder(tmp_path / "base", tiny.cameras(2))
    assert main(["adapt", str(base), "--scale", "1/4", "--recipe", "instant"]) == 0
    for name, options, size in [("own", [], (8, 6)), ("asked", ["--scale", "1/2"], (16, 12))]:
        assert main(["render", str(tmp_path / "base_x0.25"), "--output", str(tmp_path / name), *options]) == 0
        assert {image_size(path) for path in (tmp_path / name).iterdir()} == {size}
    own, asked = capsys.readouterr().out.splitlines()[-2:]
    assert own == f"2 pictures in {tmp_path / 'own'}, at x0.25, which the file was adapted for"
    assert asked == f"2 pictures in {tmp_path / 'asked'}"
    assert main(["render", str(base), "--output", str(tmp_path / "base_pictures")]) == 0
    assert {image_size(path) for path in (tmp_path / "base_pictures").iterdir()} == {(32, 24)}


def test_render_takes_the_viewer_that_a_file_was_adapted_for(tmp_path, capsys):
    base, drawn = tiny.folder(tmp_path / "base", tiny.cameras(1)), {}
    for viewer in ("spark", "portable"):
        made = tmp_path / f"base_x0.25_{viewer}"
        assert main(["adapt", str(base), "--scale", "1/4", "--recipe", "instant", "--viewer", viewer]) == 0
        for name, options in {"own": [], "spark": ["--viewer", "spark"], "mip": ["--screen-filter", "mip"]}.items():
            assert main(["render", str(made), "--output", str(tmp_path / viewer / name), *options]) == 0
            [picture] = (tmp_path / viewer / name).iterdir()
            drawn[viewer, name] = picture.read_bytes()
            told = capsys.readouterr().out.splitlines()[-1].partition(f"{tmp_path / viewer / name}, ")[2]
            own = " in spark" if (viewer, name) == ("spark", "own") else ""
            assert told == f"at x0.25{own}, which the file was adapted for"
    assert drawn["spark", "own"] == drawn["spark", "spark"] != drawn["spark", "mip"]
    assert drawn["portable", "own"] != drawn["portable", "spark"]  # which is one of several that it was made for


def test_a_file_for_a_viewer_of_a_package_that_is_absent_says_so(tmp_path, capsys):
    file = tiny.model().save(tmp_path / "a.ply", provenance={"scale": 1.0, "viewer": "kiosk"})
    words = ["render", str(file), "--output", str(tmp_path / "out"), "--view", "orbit_0003", "--backend", "cpu"]
    assert main(words) == 2
    told = "a.ply was adapted for the viewer 'kiosk', which is not installed here; install the package that adds it, or give another one (--viewer)"
    assert told in capsys.readouterr().err
    assert main([*words, "--viewer", "spark"]) == 0


def test_the_scale_is_read_from_the_header_or_from_the_report(tmp_path):
    base = wrap_model(tiny.ply(tmp_path / "base.ply"))
    saved = base.adapt(2, recipe="instant").save(tmp_path / "a.ply")
    assert adapted_scale(saved) == 2 and adapted_scale(load_model(saved).source) == 2
    assert adapted_scale(tmp_path / "base.ply") is None and adapted_scale(None) is None
    (tmp_path / "b.spz").write_bytes(b"not read")
    (tmp_path / "b.spz.adaptation.json").write_text('{"scale": 0.5}')
    assert adapted_scale(tmp_path / "b.spz") == 0.5
    (tmp_path / "b.spz.adaptation.json").write_text('{"scale": ')
    with pytest.raises(MipmapPluginError, match=r"b\.spz"):
        adapted_scale(tmp_path / "b.spz")


def cells() -> list[str]:
    """The code of the notebook."""
    return ["".join(cell["source"]) for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]


def shown_by(code: str, names: dict) -> object:
    """Run a cell as a notebook does; return the value of the expression in its last line."""
    tree = ast.parse(code)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), names)
    return None if last is None else eval(compile(ast.Expression(last.value), "cell", "eval"), names)


def test_the_notebook_runs(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    pytest.importorskip("numba")
    monkeypatch.chdir(tmp_path)
    names, shown = {}, []
    for code in cells():
        shown.append(shown_by(code, names))
    assert len(shown) == 5
    assert all("data:image/png" in value._repr_html_() for value in shown[:2]) and shown[2]._repr_png_()
    assert shown[4].name == "demo_x0.25.ply" and shown[4].is_file() and shown[3].is_file()
    assert names["adapted"].report.psnr_after() > names["adapted"].report.psnr_before() + 5


def test_the_notebook_is_kept_without_outputs():
    for cell in json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]:
        assert cell.get("outputs", []) == [] and cell.get("execution_count") is None
