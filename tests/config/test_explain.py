import json

import pytest

from wheelleg_exp.cli.main import main
from wheelleg_exp.config.explaining.explanation import explain_key
from wheelleg_exp.errors import ConfigError

DOCUMENTED = '''
"""Targets with documentation."""

import enum
from typing import Literal

class Shade(enum.Enum):
    LIGHT = "light"
    DARK = "dark"

def bend(env, angle: float, side: Literal["left", "right"] = "left", shade: Shade = Shade.DARK, cfg=None):
    """How far a thing is bent, rad.

    Args:
        env: the environment.
        angle: where bending begins,
            rad/s.
        side: which side bends.
    """

class Inner:
    """Something inside a term.

    Args:
        reach: how far it reaches, m.
    """

    def __init__(self, reach: float, tight: bool = False):
        pass

def stretch(env):
    """Not used by any file."""
'''

BEND = """\
# Bent things.
bend:
  _target_: documented.bend
  weight: 2.0
  # rad, not degrees
  angle: 0.5
  cfg: {_target_: documented.Inner, reach: 0.1}   # m beyond the wall
"""


@pytest.fixture
def documented(stock, edit, tmp_path, monkeypatch):
    from wheelleg_exp.terms import term_binding

    (tmp_path / "documented.py").write_text(DOCUMENTED, encoding="utf-8")
    monkeypatch.setattr(term_binding, "allowed_packages", lambda: ("wheelleg_exp", "shelf_terms", "documented"))
    edit("reward/bend.yaml", BEND)
    edit("task/stand.yaml", "[alive, height]", "[alive, height, bend]")


def test_a_leaf_has_value_type_and_every_source_in_order(composed):
    explained = explain_key(composed("env.rewards.height.weight=3"), "env.rewards.height.weight")
    assert (explained.kind, explained.value) == ("value", 3)
    assert [(s.where, s.value) for s in explained.sources] == [
        ("configs/reward/height.yaml:4", 1.0),
        ("configs/task/stand.yaml:23", -50.0),
        ("override env.rewards.height.weight=3", 3),
    ]
    assert explained.alternatives.type == "a number"


def test_the_meaning_is_the_comment_then_the_line_of_the_parameter_then_that_of_the_term(documented, composed):
    explained = explain_key(composed(), "env.rewards.bend.angle")
    assert [(note.text, note.about) for note in explained.meanings] == [
        ("rad, not degrees", "key"),
        ("where bending begins, rad/s.", "key"),
        ("How far a thing is bent, rad.", "term"),
    ]
    assert (explained.meanings[0].where, explained.unit) == ("configs/reward/bend.yaml:6", "rad")
    assert explain_key(composed("env.rewards.bend.angle=1"), "env.rewards.bend.angle").unit == "rad"


def test_a_key_inside_a_nested_target_is_described_by_that_target(documented, composed):
    reach = explain_key(composed(), "env.rewards.bend.cfg.reach")
    assert [note.text for note in reach.meanings[:2]] == ["m beyond the wall", "how far it reaches, m."]
    tight = explain_key(composed(), "env.rewards.bend.cfg.tight")
    assert (tight.kind, tight.value, tight.alternatives.values) == ("not set", False, (True, False))


def test_literals_enums_booleans_and_targets_of_the_same_module_are_listed(documented, composed):
    config = composed()
    for key, values in {
        "env.rewards.bend.side": ("left", "right"),
        "env.rewards.bend.shade": ("light", "dark"),
        "env.sim.solver": ("newton", "cg"),
        "env.observations.policy.enable_corruption": (True, False),
        "env.events.push.mode": ("prestartup", "startup", "reset", "interval", "step"),
    }.items():
        assert explain_key(config, key).alternatives.values == values
    targets = explain_key(config, "env.rewards.bend._target_").alternatives.values
    assert ("documented.stretch" in targets, "documented.Literal" in targets) == (True, False)


def test_a_parameter_that_is_not_set_has_its_default(composed):
    explained = explain_key(composed("+reward@env.rewards=smooth"), "env.rewards.smooth.order")
    assert (explained.kind, explained.value, explained.has_value) == ("not set", 1, True)
    scale = explain_key(composed(), "env.observations.policy.terms.speed.scale")
    assert (scale.kind, scale.value) == ("not set", None)
    assert "factor on the observation" in scale.meanings[0].text


def test_keys_of_other_kinds(composed):
    # The value is the default of a dataclass field.
    unset = explain_key(composed(), "env.observations.critic.concatenate_terms")
    assert (unset.kind, unset.value) == ("not set", True)
    dotted = explain_key(composed(), "env.robot.joint_pos[.*_hip]")
    assert (dotted.key, dotted.value, dotted.alternatives.type) == ("env.robot.joint_pos[.*_hip]", 0.1, "a number")
    assert not explain_key(composed("+env.wind=3"), "env.wind").is_read
    assert explain_key(composed(), "env.sim.dt").alternatives.limits == ("more than 0",)
    assert explain_key(composed(), "env.num_envs").alternatives.limits == ("at least 1",)


def test_a_section_has_no_comments_of_the_sections_inside_it(composed, edit):
    edit("sim/mujoco.yaml", "# @package env.sim\n", "# @package env.sim\n# The solver.\n")
    assert explain_key(composed(), "env.sim").meanings[0].text == "The solver."
    assert "The solver." not in [note.text for note in explain_key(composed(), "env").meanings]


def test_the_references_of_an_interpolation_are_followed(composed, edit):
    explained = explain_key(composed("task=walk", "seed=${env.decimation}"), "env.num_envs")
    assert (explained.value, explained.raw) == (2, "${seed}")
    assert [(r.path, r.value, r.raw, r.where) for r in explained.references] == [
        ("seed", 2, "${env.decimation}", "override seed=${env.decimation}"),
        ("env.decimation", 2, None, "configs/task/stand.yaml:19"),
    ]
    edit("sim/mujoco.yaml", "dt: 0.01", "dt: 0.01\nhalf: ${.dt}\nenvs: ${..num_envs}")
    for key, path in (("env.sim.half", "env.sim.dt"), ("env.sim.envs", "env.num_envs")):  # relative interpolations
        assert [r.path for r in explain_key(composed(), key).references] == [path]


def test_a_removed_term_is_explained_with_its_former_values(composed):
    explained = explain_key(composed("task=walk"), "env.rewards.alive.weight")
    sources = [("configs/reward/alive.yaml:3", 1.0), ("configs/task/walk.yaml:12", None)]
    assert (explained.kind, [(s.where, s.value) for s in explained.sources]) == ("removed", sources)
    explained = explain_key(composed("~env.events.push"), "env.events.push.mode")
    assert (explained.kind, explained.sources[0].value) == ("removed", "interval")
    assert explained.sources[-1].where == "override ~env.events.push"


def test_a_term_that_a_replaced_list_dropped_names_who_replaced_it(composed):
    explained = explain_key(composed("reward@env.rewards=[alive]", "~env.rewards.height"), "env.rewards.smooth")
    assert (explained.kind, explained.option) == ("not selected", "smooth")
    places = ["configs/task/stand.yaml:11", "override reward@env.rewards=[alive]"]
    assert [choice.where for choice in explained.mount.choices] == places


def test_a_group_is_explained_with_its_options_and_its_place(composed):
    for key in ("robot", "reward@env.rewards", "reward"):
        assert explain_key(composed(), key).kind == "group"
    robot = explain_key(composed("robot=physical"), "robot").mount
    assert (robot.package, robot.selected, robot.options) == ("env.robot", ("physical",), ("article", "physical"))
    assert [choice.value for choice in robot.choices] == ["article", "physical"]


def test_a_key_that_a_group_mounts_names_the_group(composed):
    section = explain_key(composed(), "env.robot")
    assert (section.kind, section.mount.name) == ("section", "robot")
    rewards = explain_key(composed("task=walk"), "env.rewards")
    assert rewards.mount.selected == ("alive", "height", "smooth")
    places = ["configs/task/stand.yaml:11", "configs/task/walk.yaml:5"]
    assert [choice.where for choice in rewards.mount.choices] == places
    term = explain_key(composed(), "env.rewards.alive")
    assert (term.kind, term.option) == ("term", "alive")
    assert [note.text for note in term.meanings] == ["One while the robot is up."]


def test_an_element_of_a_list_has_the_lists_sources(composed):
    explained = explain_key(composed("env.robot.order.1=z"), "env.robot.order.1")
    assert (explained.value, [s.path for s in explained.sources]) == ("z", ["env.robot.order"] * 2)


@pytest.mark.parametrize(
    ("wrong", "right"),
    [
        ("env.rewards.height.wieght", "env.rewards.height.weight"),
        ("env.observations.policy.terms.speed.noize", "env.observations.policy.terms.speed.noise"),
        ("env.events.push.mode.deep", None),
        ("sede", "seed"),
        ("robt", "robot"),
        ("env.rewards.mine", None),
        ("env.robot.joint_pos[.*_hop]", "env.robot.joint_pos[.*_hip]"),
        ("", None),
    ],
)
def test_a_misspelt_key_is_refused_with_the_nearest_key(composed, wrong, right):
    with pytest.raises(ConfigError) as raised:
        explain_key(composed(), wrong)
    assert raised.value.key == wrong
    assert raised.value.nearest == right or right is None


def test_the_command_prints_value_unit_meaning_and_sources_or_json(documented, capsys):
    assert main(["explain", "env.rewards.bend.angle", "env.rewards.bend.angle=1"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert (lines[0], lines[1].split()) == ("env.rewards.bend.angle = 1", ["unit", "rad"])
    assert lines[-2].split() == ["configs/reward/bend.yaml:6", "0.5"]
    assert lines[-1].split() == ["override", "env.rewards.bend.angle=1", "1"]
    assert main(["explain", "env.rewards.bend.side", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["kind"], found["default"], found["values"]) == ("not set", "left", ["left", "right"])


@pytest.mark.parametrize(
    ("words", "first"),
    [
        (["env.rewards.alive", "~env.rewards.alive"], "env.rewards.alive: removed by override ~env.rewards.alive"),
        (["robot"], "robot: a group"),
        (["env.rewards.smooth"], "env.rewards.smooth: a term that is not selected"),
        (["env.actions.effort.gain"], "env.actions.effort.gain: not set; default 1.0"),
        (["env.robot.joint_pos"], "env.robot.joint_pos: a section"),
    ],
)
def test_the_first_line_names_the_kind_of_the_key(stock, capsys, words, first):
    assert main(["explain", *words]) == 0
    assert capsys.readouterr().out.splitlines()[0] == first


def test_a_key_of_a_drive_belongs_to_the_config_of_play(capsys):
    assert main(["explain", "drive.push"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "drive.push = 0.1"
