"""What is written as JSON, every parser reads."""

import json
import math

import pytest

from mipmap_plugin.files import json_text, write_json

FACTS = {"psnr_db": math.inf, "rows": [{"gain": -math.inf}, (1.5, math.nan)], "name": "Infinity", "count": 3, "known": True, "none": None}
WRITTEN = {"psnr_db": None, "rows": [{"gain": None}, [1.5, None]], "name": "Infinity", "count": 3, "known": True, "none": None}


def refuse(constant):
    raise AssertionError(f"{constant} is no JSON")


def test_numbers_that_json_lacks_are_null():
    assert json.loads(json_text(FACTS), parse_constant=refuse) == WRITTEN


def test_so_are_those_of_a_file(tmp_path):
    write_json(tmp_path / "a.json", FACTS, overwrite=False)
    assert json.loads((tmp_path / "a.json").read_text(), parse_constant=refuse) == WRITTEN


@pytest.mark.parametrize("value", [0.1, -1e300, 10**30, 1e-320])
def test_other_numbers_come_back_as_they_were(value):
    assert json.loads(json_text([value])) == [value]
