"""Recipes: known by name, a stranger's as ours, and wrong ones answered in a sentence."""

import pytest

from mipmap_plugin.config import AdaptConfig
from mipmap_plugin.errors import PluginError, SettingsError
from mipmap_plugin.recipes import RECIPES, recipe, register_recipe


def test_a_registered_recipe_is_asked_for_the_scale_and_the_network():
    asked = []
    register_recipe("mine", lambda scale, network: asked.append((scale, network)) or dict(steps=3))
    assert recipe("mine", 2, upsampler="net.pth", seed=5) == AdaptConfig(recipe="mine", steps=3, upsampler="net.pth", seed=5)
    assert (recipe("mine", 1 / 4).steps, asked) == (3, [(2, True), (1 / 4, False)])


def test_every_built_in_recipe_fits_every_scale():
    for name in RECIPES.names():
        assert {recipe(name, scale).recipe for scale in (1 / 16, 1 / 4, 1, 4)} == {name}


def test_an_unknown_recipe_is_told_the_known_ones():
    with pytest.raises(SettingsError, match="there is no recipe 'best'; choose from default, instant, paper, thorough"):
        recipe("best", 2)


def test_what_is_no_recipe_is_named():
    register_recipe("mine", 3)
    with pytest.raises(PluginError, match="recipe 'mine' is of type int"):
        recipe("mine", 2)
    register_recipe("mine", lambda scale, network: None, replace=True)
    with pytest.raises(PluginError, match="recipe 'mine' failed at x2: TypeError"):
        recipe("mine", 2)
    register_recipe("mine", lambda scale, network: dict(stepps=3), replace=True)
    with pytest.raises(SettingsError, match="setting stepps"):
        recipe("mine", 2)


@pytest.mark.parametrize("name", ["default", "thorough"])
def test_a_conversion_to_a_viewer_learns_as_a_zoom_out_does_and_merges_nothing(name):
    converting, below = recipe(name, 1.0), recipe(name, 0.999)
    assert converting.rates.means == pytest.approx(below.rates.means, rel=0.01) and converting.steps == below.steps
    assert converting.merge_to == 1
