"""Matching of joint and body names."""

from __future__ import annotations

import pytest

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.names import match_names, values_by_name

NAMES = ["left_hip", "right_hip", "left_axle", "right_axle"]


def match(expressions, **options):
    return match_names(expressions, NAMES, key="k", what="joint", **options)


def spread(values, default=0.0):
    return values_by_name(values, NAMES, default, key="k", what="joint")


def test_one_expression_may_stand_alone():
    assert match(".*_hip") == ([0, 1], ["left_hip", "right_hip"])


def test_names_come_in_the_order_of_the_asset():
    assert match(["right_axle", "left_hip"])[1] == ["left_hip", "right_axle"]


def test_names_come_in_the_order_of_the_expressions_when_asked():
    assert match(["right_axle", ".*_hip"], preserve_order=True) == (
        [3, 0, 1],
        ["right_axle", "left_hip", "right_hip"],
    )


def test_a_number_is_spread_over_all_names():
    assert spread(2.0) == [2.0] * 4


def test_a_mapping_leaves_the_default_where_nothing_matches():
    assert spread({".*_hip": 2.0, "right_axle": 3.0}, default=7.0) == [2.0, 2.0, 7.0, 3.0]


@pytest.mark.parametrize(
    ("call", "given", "words"),
    [
        (match, "left", "matches nothing"),  # an expression must match the whole name
        (match, ["left_.*", ".*_hip"], "'left_hip' is matched by both 'left_.*' and '.*_hip'"),
        (match, "lft_hip", "did you mean 'left_hip'"),
        (match, "left_(hip", "regular expression"),
        (spread, {"knee": 2.0}, "matches nothing"),
        (spread, {".*": 2.0, "left_hip": 1.0}, "matched by both"),
    ],
)
def test_wrong_expressions_are_refused(call, given, words):
    with pytest.raises(ConfigError) as caught:
        call(given)
    assert words in str(caught.value)
