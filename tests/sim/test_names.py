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


def test_an_expression_must_match_the_whole_name():
    with pytest.raises(ConfigError, match="matches nothing"):
        match("left")


def test_names_come_in_the_order_of_the_asset():
    assert match(["right_axle", "left_hip"])[1] == ["left_hip", "right_axle"]


def test_names_come_in_the_order_of_the_expressions_when_asked():
    assert match(["right_axle", ".*_hip"], preserve_order=True) == (
        [3, 0, 1],
        ["right_axle", "left_hip", "right_hip"],
    )


def test_a_name_matched_twice_is_an_error_that_names_both_expressions():
    with pytest.raises(ConfigError) as caught:
        match(["left_.*", ".*_hip"])
    assert "left_hip" in str(caught.value)
    assert "left_.*" in str(caught.value)
    assert ".*_hip" in str(caught.value)


def test_nothing_matched_names_the_nearest():
    with pytest.raises(ConfigError) as caught:
        match("lft_hip")
    assert caught.value.nearest == "left_hip"


def test_what_is_no_regular_expression_is_said_so():
    with pytest.raises(ConfigError, match="regular expression"):
        match("left_(hip")


def test_a_number_is_spread_over_all_names():
    assert spread(2.0) == [2.0] * 4


def test_a_mapping_leaves_the_default_where_nothing_matches():
    assert spread({".*_hip": 2.0, "right_axle": 3.0}, default=7.0) == [2.0, 2.0, 7.0, 3.0]


def test_a_mapping_whose_key_matches_nothing_is_an_error():
    with pytest.raises(ConfigError, match="matches nothing"):
        spread({"knee": 2.0})


def test_a_mapping_whose_keys_overlap_is_an_error():
    with pytest.raises(ConfigError, match="matched by both"):
        spread({".*": 2.0, "left_hip": 1.0})
