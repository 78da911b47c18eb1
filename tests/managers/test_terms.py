"""Binding nodes to targets: what is refused and how."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from sim.small_envs import env_config

from managers import spies
from wheelleg_exp.config.checking.check_terms import check_nested_targets
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, TermBase
from wheelleg_exp.sim.options import read_env
from wheelleg_exp.terms.config_sections import plain_section


def uses_reserved(env: Env, weight: float):
    return None


def takes_env_only(env: Env):
    return None


class NotATerm:
    def __init__(self, env: Env) -> None: ...


class Refuses(TermBase):
    def __init__(self, env: Env, count: int) -> None:
        self.items = [0, 1, 2][count]


def leaves(env: Env):
    sys.exit(0)


def breaks(env: Env):
    raise RuntimeError("broken")


HERE = "managers.test_terms."
ALIVE = {"_target_": "wheelleg_exp.mdp.rewards.is_alive", "weight": 1.0}
R = "wheelleg_exp.mdp.rewards."
HEIGHT = {"_target_": R + "base_height_l2", "weight": 1.0}
SPEED = {"_target_": R + "joint_vel_l2", "weight": 1.0}


def _own(name, **fields):
    return {"_target_": HERE + name, "weight": 1.0, **fields}


def _entity(**fields):
    return {"_target_": "wheelleg_exp.managers.SceneEntityCfg", **fields}


def _refused(make_env, node):
    with pytest.raises(ConfigError) as caught:
        make_env(rewards={"term": node})
    return caught.value


@pytest.mark.parametrize(
    ("node", "key", "words", "nearest"),
    [
        (HEIGHT | {"target_hight": 0.1}, "target_hight", "", "target_height"),
        (_own("takes_env_only", anything=1), "anything", "", None),
        (HEIGHT, "", "target_height", None),
        (ALIVE | {"time_out": True}, "time_out", "", None),  # a field of another manager
        *((ALIVE | {name: 1}, name, "", None) for name in ("env", "env_ids", "generator")),
        (_own("uses_reserved"), "", "'weight'", None),
        *(
            ({"_target_": target, "weight": 1.0}, "_target_", "outside", None)
            for target in ("os.system", "subprocess.run", "wheelleg_exp_evil.x", "builtins.eval")
        ),
        (SPEED | {"asset_cfg": {"_target_": "os.getcwd"}}, "asset_cfg._target_", "outside", None),
        ({"_target_": R + "is_alife", "weight": 1.0}, "_target_", "", "is_alive"),
        ({"_target_": "wheelleg_exp.mdp.reward.is_alive", "weight": 1.0}, "_target_", "import", None),
        ({"weight": 1.0}, "", "_target_", None),
        (3.0, "", "", None),
        (_own("NotATerm"), "", "not the class of a term", None),
        (_own("Refuses", count=7), "", "", None),
        (SPEED | {"asset_cfg": _entity(name="robott")}, "asset_cfg.name", "", "robot"),
        (SPEED | {"asset_cfg": _entity(name="robot", joint_names=["knee"])}, "asset_cfg.joint_names", "", None),
        (SPEED | {"asset_cfg": _entity(name="robot", body_names=["knee"])}, "asset_cfg.body_names", "", None),
        (SPEED | {"asset_cfg": _entity(name="contact", joint_names=[".*"])}, "asset_cfg.joint_names", "", None),
        (SPEED | {"asset_cfg": _entity(name="contact", body_names=["shin"])}, "asset_cfg.body_names", "", None),
    ],
)
def test_a_wrong_term_is_rejected_by_key(make_env, node, key, words, nearest):
    error = _refused(make_env, node)
    assert error.key == "env.rewards.term" + (f".{key}" if key else "")
    assert words in error.message
    assert nearest in (None, error.nearest)


TIMES, LEAST = "resampling_time_range", "min_step_count_between_reset"
POSITION = {"_target_": "wheelleg_exp.mdp.actions.JointPositionAction", "joint_names": [".*_hip"]}
RANGES = {"lin_vel_x": [-0.3, 0.3], "lin_vel_y": [0.1, 0.2], "ang_vel_z": [-0.5, 0.5]}
COMMAND = {"_target_": "wheelleg_exp.mdp.commands.UniformVelocityCommand", "ranges": RANGES, TIMES: [0.1, 0.1]}
EVENT, INTERVAL = {"_target_": spies.HERE + "noted"}, {"_target_": spies.HERE + "noted", "mode": "interval"}


@pytest.mark.parametrize(
    ("section", "node", "key"),
    [
        ("actions", POSITION | {"scale": {"hip": 1.0}}, "scale"),  # no whole name
        ("actions", POSITION | {"scale": {".*": 1.0, "left_.*": 2.0}}, "scale"),  # matched twice
        ("actions", POSITION | {"clip": {"left_axle": [0, 1]}}, "clip"),
        ("actions", POSITION | {"clip": [-1.0, 1.0]}, "clip"),
        ("actions", POSITION | {"joint_names": ["ankle"]}, "joint_names"),
        ("commands", COMMAND | {"heading_command": True}, "ranges.heading"),
        ("commands", COMMAND | {"ranges": RANGES | {"lin_vel_z": [0, 1]}}, "ranges.lin_vel_z"),
        ("commands", COMMAND | {"ranges": RANGES | {"lin_vel_x": [1, 0]}}, "ranges.lin_vel_x"),
        *(("commands", COMMAND | {TIMES: times}, TIMES) for times in ([2.0, 1.0], [0.0, 0.0])),
        ("events", EVENT, "mode"),
        ("events", EVENT | {"mode": "reset", LEAST: -1}, LEAST),
        ("events", INTERVAL, "interval_range_s"),
        *(("events", INTERVAL | {"interval_range_s": s}, "interval_range_s") for s in ([2.0, 1.0], [1.0])),
        *(("rewards", ALIVE | {"weight": weight}, "weight") for weight in (None, "2.0", True)),
    ],
)
def test_a_wrong_setting_is_rejected_by_key(make_env, section, node, key):
    with pytest.raises(ConfigError) as caught:
        make_env(**{section: {"t": node}})
    assert caught.value.key == f"env.{section}.t.{key}"


@pytest.mark.parametrize(
    "target", ["wheelleg_exp.managers.manager_base.inspect.signature", "wheelleg_exp.mdp.observations.torch.load"]
)
def test_imports_of_an_allowed_module_cannot_be_targets(make_env, target):
    _refused(make_env, {"_target_": target, "weight": 1.0})
    node = {"_target_": "wheelleg_exp.mdp.observations.joint_pos", "modifiers": [{"_target_": target}]}
    with pytest.raises(ConfigError):
        make_env(observations={"policy": {"terms": {"term": node}}})


def test_a_string_that_looks_like_an_interpolation_is_a_string(make_env, tmp_path):
    """Hydra's own instantiate would resolve the interpolation, and call the function in it."""
    read = tmp_path / "read.npy"
    np.save(read, np.arange(3))
    text = "${oc.create:" + f"{{_target_: numpy.load, file: '{read}'}}" + "}"
    assert text in str(_refused(make_env, SPEED | {"asset_cfg": _entity(name=text)}))


@pytest.mark.parametrize("key", ["_args_", "_partial_", "_recursive_", "_convert_"])
def test_no_other_special_key_of_hydra_works(make_env, key):
    node = SPEED | {"asset_cfg": _entity(name="robot", **{key: False})}
    error = _refused(make_env, node)
    assert error.key == f"env.rewards.term.asset_cfg.{key}"
    assert error.key in str(next(check_nested_targets({"env": {"rewards": {"term": node}}})))


@pytest.mark.parametrize(
    ("section", "words"),
    [("actions", "action term"), ("commands", "command term"), ("recorders", "not the class of a recorder")],
)
def test_a_class_of_another_section_is_rejected(make_env, section, words):
    with pytest.raises(ConfigError, match=words) as caught:
        make_env(**{section: {"t": {"_target_": spies.HERE + "CountingObservation"}}})
    assert caught.value.key == f"env.{section}.t"


def test_null_terms_are_absent_and_the_others_follow_the_order_of_the_config(start_env):
    rewards = {"gone": None, "b": ALIVE, "a": ALIVE, "c": ALIVE}
    env = start_env(rewards=rewards, events={"gone": None}, terminations={"gone": None})
    assert (env.reward_manager.active_terms, env.event_manager.active_terms) == (["b", "a", "c"], {})


def test_an_unknown_term_that_a_curriculum_names_is_reported_with_the_nearest(make_env):
    change = {"_target_": "wheelleg_exp.mdp.curriculums.modify_reward_weight", "weight": 3.0, "num_steps": 2}
    env = make_env(rewards={"alive": ALIVE}, curriculum={"c": change | {"term_name": "alve"}})
    with pytest.raises(ConfigError) as caught:
        env.reset()
    assert caught.value.nearest == "alive"


def test_an_entity_finds_joints_in_the_robots_or_its_own_order(make_env):
    names = ["right_.*", "left_hip"]
    for preserve, expected in ((False, [0, 1, 3]), (True, [1, 3, 0])):
        cfg = _entity(name="robot", joint_names=names, preserve_order=preserve)
        env = make_env(rewards={"term": SPEED | {"asset_cfg": cfg}})
        assert env.reward_manager.get_term_cfg("term").params["asset_cfg"].joint_ids.tolist() == expected


def test_an_entity_that_is_a_default_is_not_resolved_and_means_all_joints(start_env):
    default = {"_target_": spies.HERE + "default_entity", "weight": 1.0}
    given = _entity(name="robot", joint_names=["right_hip"])
    env = start_env(rewards={"a": default, "b": default | {"asset_cfg": given}})
    spies.LOG.clear()
    env.step(torch.zeros(4, 4))
    everything, one = spies.LOG
    assert (everything, one.tolist()) == (slice(None), [1])


def test_configs_are_not_modified(start_env):
    given = read_env(env_config(rewards={"alive": dict(ALIVE)}))
    assert start_env(rewards={"alive": dict(ALIVE)}).cfg == plain_section(given)


def test_managers_print_as_tables(make_env):
    text = make_env(rewards={"alive": ALIVE}).describe()
    for word in ("alive", "is_alive", "left_hip", "JointPositionAction", "time_out", "contact"):
        assert word in text


@pytest.mark.parametrize(("name", "said"), [("leaves", "SystemExit: 0"), ("breaks", "RuntimeError: broken")])
def test_a_term_that_fails_while_the_environment_is_built_is_a_config_error(make_env, name, said):
    with pytest.raises(ConfigError, match=rf"'managers.test_terms.{name}' raises.*{said}") as caught:
        make_env(observations={"policy": {"terms": {"term": {"_target_": HERE + name}}}})
    assert caught.value.key == "env.observations.policy.terms.term"
    assert "test_terms.py:" in caught.value.where
