"""Recipes: known by name, a stranger's as ours, and wrong ones answered in a sentence."""

import re

import pytest

from mipmap_plugin.config import AdaptConfig, LearningRates, allowed
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


def test_what_is_no_recipe_is_named():
    register_recipe("mine", 3)
    with pytest.raises(PluginError, match="recipe 'mine' is of type int"):
        recipe("mine", 2)
    register_recipe("mine", lambda scale, network: None, replace=True)
    with pytest.raises(PluginError, match="recipe 'mine' has to return a dict of settings by name; at x2 it returned a NoneType"):
        recipe("mine", 2)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (dict(merge_to=0), "setting merge_to: must be a number above 0 and up to 1, got 0"),
        (dict(min_opacity="x"), "setting min_opacity: must be a number from 0 to below 1, got 'x'"),
        (dict(most_growth=0.5), "setting most_growth: must be a number of at least 1, or None, got 0.5"),
        (dict(nesterov="maybe"), "setting nesterov: must be True or False, got 'maybe'"),
        (dict(upsampler=3), "setting upsampler: must be a text, got 3"),
        (dict(betas=(1, 2)), "setting betas: must be a pair, each a number from 0 to below 1, got (1, 2)"),
        (dict(band=(1,)), "setting band: must be a pair, each a number above 0, got (1,)"),
        (dict(rates=3), "setting rates: must be rates by name, got 3"),
        (dict(rates={3: 1}), "setting rates: must be rates by name, got {3: 1}"),
        (dict(seed=1.5, loss=3), f"setting seed: must be {allowed('seed')}, got 1.5; setting loss: must be 'psnr', 'l2' or 'l1', got 3"),
    ],
    ids=lambda value: "+".join(value) if isinstance(value, dict) else "",
)
def test_each_wrong_setting_is_told_with_what_it_may_be_and_what_was_got(settings, said):
    with pytest.raises(SettingsError) as refused:
        recipe("default", 1 / 4, **settings)
    assert str(refused.value) == said


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: AdaptConfig(steps=-1), "setting steps: must be a whole number of at least 0, got -1"),
        (lambda: AdaptConfig(stps=1), "there is no setting stps; did you mean steps? mipmap_plugin.config has all of them"),
        (lambda: AdaptConfig(nosuch=1), "there is no setting nosuch; mipmap_plugin.config has all of them"),
        (lambda: AdaptConfig(rates={"mean": 1}), "there is no setting rates.mean; did you mean means? mipmap_plugin.config has all of them"),
        (lambda: LearningRates(means=-1), "setting rates.means: must be a number of at least 0, got -1"),
    ],
)
def test_settings_that_are_made_in_python_are_told_of_alike(make, said):
    with pytest.raises(SettingsError) as refused:
        make()
    assert str(refused.value) == said


def test_a_recipe_that_is_wrong_itself_is_named():
    register_recipe("mine", lambda scale, network: dict(steps=-1))
    with pytest.raises(SettingsError, match=r"^recipe mine: setting steps: must be a whole number of at least 0, got -1$"):
        recipe("mine", 2, seed=1)


def test_what_any_setting_may_be_has_words():
    for name in (*AdaptConfig.model_fields, *(f"rates.{name}" for name in LearningRates.model_fields)):
        assert re.fullmatch(r"a (whole )?number\b.*|a pair, each a number .*|a text|True or False|rates by name|'.*' or '.*'", allowed(name))


@pytest.mark.parametrize("name", ["default", "thorough"])
def test_a_conversion_to_a_viewer_learns_as_a_zoom_out_does_and_merges_nothing(name):
    converting, below = recipe(name, 1.0), recipe(name, 0.999)
    assert converting.rates.means == pytest.approx(below.rates.means, rel=0.01) and converting.steps == below.steps
    assert converting.merge_to == 1
