import pytest

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.names import match_names, values_by_name

NAMES = ["left_hip", "right_hip", "left_axle", "right_axle"]


def match(expressions, **options):
    return match_names(expressions, NAMES, key="k", what="joint", **options)


def spread(values, default=0.0):
    return values_by_name(values, NAMES, default, key="k", what="joint")


@pytest.mark.parametrize(
    ("expressions", "options", "found"),
    [
        (".*_hip", {}, ["left_hip", "right_hip"]),
        (["right_axle", "left_hip"], {}, ["left_hip", "right_axle"]),
        (["right_axle", ".*_hip"], {"preserve_order": True}, ["right_axle", "left_hip", "right_hip"]),
    ],
)
def test_expressions_match_whole_names_in_an_order(expressions, options, found):
    assert match(expressions, **options) == ([NAMES.index(name) for name in found], found)


def test_a_number_is_for_all_names_and_a_mapping_leaves_the_default_where_nothing_matches():
    assert spread(2.0) == [2.0] * 4
    assert spread({".*_hip": 2.0, "right_axle": 3.0}, default=7.0) == [2.0, 2.0, 7.0, 3.0]


@pytest.mark.parametrize(
    ("call", "given", "words"),
    [
        (match, "left", "matches nothing"),
        (match, ["left_.*", ".*_hip"], "'left_hip' is matched by both 'left_.*' and '.*_hip'"),
        (match, "lft_hip", "did you mean 'left_hip'"),
        (match, "left_(hip", "regular expression"),
        (spread, {"knee": 2.0}, "matches nothing"),
        (spread, {".*": 2.0, "left_hip": 1.0}, "matched by both"),
    ],
)
def test_wrong_expressions_are_rejected(call, given, words):
    with pytest.raises(ConfigError) as caught:
        call(given)
    assert words in str(caught.value)


LONG = "a" * 40


@pytest.mark.parametrize(
    "pattern", ["(a|a)*b", "(a+)+b", "((.*)*)*b", "(a|a)" * 40 + "b", "(?=(a|aa)+b).*", "(a?){40}b", ".*" * 20 + "b"]
)
def test_an_expression_that_could_take_for_ever_is_refused(pattern: str) -> None:
    with pytest.raises(ConfigError, match="too many ways"):
        match_names(pattern, [LONG], key="k", what="joint")


@pytest.mark.parametrize(
    "pattern",
    [".*(hip|knee).*", "^(?!.*ankle).*", "(FL|FR|RL|RR)_(hip|thigh|calf)(_joint)?", "[FR][LR]_.*_.*", r"\w{3,}"],
)
def test_usual_expressions_are_accepted(pattern: str) -> None:
    assert match_names(pattern, ["FL_hip_joint", LONG + "_ankle"], key="k", what="joint")[1][0] == "FL_hip_joint"
