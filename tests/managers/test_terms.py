"""Binding nodes to targets: what is refused and how."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch

from managers import spies
from wheelleg_exp.config.checking.check_terms import check_nested_targets
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, TermBase


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


def _refused(make_env, node, **sections):
    with pytest.raises(ConfigError) as caught:
        make_env(rewards={"term": node}, **sections)
    return caught.value


def test_an_unknown_parameter_names_the_nearest(make_env):
    node = {"_target_": "wheelleg_exp.mdp.rewards.base_height_l2", "weight": 1.0, "target_hight": 0.1}
    error = _refused(make_env, node)
    assert error.key == "env.rewards.term.target_hight"
    assert error.nearest == "target_height"


def test_an_unknown_parameter_is_refused_even_where_a_function_takes_none(make_env):
    error = _refused(make_env, {"_target_": HERE + "takes_env_only", "weight": 1.0, "anything": 1})
    assert error.key == "env.rewards.term.anything"


def test_a_missing_parameter_is_named(make_env):
    error = _refused(make_env, {"_target_": "wheelleg_exp.mdp.rewards.base_height_l2", "weight": 1.0})
    assert "target_height" in error.message


def test_a_field_of_another_manager_is_an_unknown_parameter(make_env):
    assert _refused(make_env, ALIVE | {"time_out": True}).key == "env.rewards.term.time_out"


def test_what_the_manager_passes_itself_cannot_be_configured(make_env):
    for name in ("env", "env_ids", "generator"):
        assert _refused(make_env, ALIVE | {name: 1}).key == f"env.rewards.term.{name}"


def test_a_target_that_uses_a_reserved_name_is_refused(make_env):
    error = _refused(make_env, {"_target_": HERE + "uses_reserved", "weight": 1.0})
    assert "'weight'" in error.message


@pytest.mark.parametrize("target", ["os.system", "subprocess.run", "wheelleg_exp_evil.x", "builtins.eval"])
def test_a_target_outside_the_allowed_packages_is_refused(make_env, target):
    error = _refused(make_env, {"_target_": target, "weight": 1.0})
    assert error.key == "env.rewards.term._target_"
    assert "outside" in error.message


@pytest.mark.parametrize(
    "target", ["wheelleg_exp.managers.manager_base.inspect.signature", "wheelleg_exp.mdp.observations.torch.load"]
)
def test_no_way_leads_through_an_allowed_module_to_what_it_has_imported(make_env, target):
    _refused(make_env, {"_target_": target, "weight": 1.0})
    nested = {
        "policy": {
            "terms": {
                "term": {
                    "_target_": "wheelleg_exp.mdp.observations.joint_pos",
                    "modifiers": [{"_target_": target}],
                }
            }
        }
    }
    with pytest.raises(ConfigError):
        make_env(observations=nested)


def test_a_text_that_looks_like_an_interpolation_is_a_text(make_env, tmp_path):
    """Hydra's own instantiate would resolve it, and call what stands in it."""
    read = tmp_path / "read.npy"
    np.save(read, np.arange(3))
    text = "${oc.create:" + f"{{_target_: numpy.load, file: '{read}'}}" + "}"
    entity = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": text}
    error = _refused(
        make_env, {"_target_": "wheelleg_exp.mdp.rewards.joint_vel_l2", "weight": 1.0, "asset_cfg": entity}
    )
    assert text in str(error)


@pytest.mark.parametrize("key", ["_args_", "_partial_", "_recursive_", "_convert_"])
def test_no_other_special_key_of_hydra_works(make_env, key):
    entity = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot", key: False}
    node = {"_target_": "wheelleg_exp.mdp.rewards.joint_vel_l2", "weight": 1.0, "asset_cfg": entity}
    error = _refused(make_env, node)
    assert error.key == f"env.rewards.term.asset_cfg.{key}"
    assert error.key in str(check_nested_targets({"env": {"rewards": {"term": node}}})[0])


def test_a_nested_target_outside_the_allowed_packages_is_refused(make_env):
    node = {"_target_": "wheelleg_exp.mdp.rewards.joint_vel_l2", "weight": 1.0, "asset_cfg": {"_target_": "os.getcwd"}}
    assert _refused(make_env, node).key == "env.rewards.term.asset_cfg._target_"


def test_a_target_that_does_not_exist_names_the_nearest(make_env):
    error = _refused(make_env, {"_target_": "wheelleg_exp.mdp.rewards.is_alife", "weight": 1.0})
    assert error.nearest == "is_alive"
    assert "import" in _refused(make_env, {"_target_": "wheelleg_exp.mdp.reward.is_alive", "weight": 1.0}).message


def test_settings_without_a_target_are_refused(make_env):
    assert "_target_" in _refused(make_env, {"weight": 1.0}).message


def test_a_term_that_is_no_mapping_is_refused(make_env):
    assert _refused(make_env, 3.0).key == "env.rewards.term"


def test_a_class_that_is_no_term_is_refused(make_env):
    assert "not a term class" in _refused(make_env, {"_target_": HERE + "NotATerm", "weight": 1.0}).message


def test_a_constructor_that_refuses_its_parameters_gives_no_traceback(make_env):
    error = _refused(make_env, {"_target_": HERE + "Refuses", "weight": 1.0, "count": 7})
    assert error.key == "env.rewards.term"


def test_an_error_inside_a_term_names_the_whole_key(make_env):
    action = make_env().cfg["actions"]["hips"] | {"scale": {"knee": 1.0}}
    with pytest.raises(ConfigError) as caught:
        make_env(actions={"hips": action})
    assert caught.value.key == "env.actions.hips.scale"


def test_a_null_term_is_not_there(make_env):
    env = make_env(rewards={"gone": None, "alive": ALIVE}, events={"gone": None}, terminations={"gone": None})
    assert env.reward_manager.active_terms == ["alive"]
    assert env.event_manager.active_terms == {}
    env.reset()


def test_terms_stand_in_the_order_of_the_config(make_env):
    env = make_env(rewards={"b": ALIVE, "a": ALIVE, "c": ALIVE})
    assert env.reward_manager.active_terms == ["b", "a", "c"]


def test_a_term_asked_for_by_a_wrong_name_names_the_nearest(make_env):
    env = make_env(rewards={"alive": ALIVE})
    with pytest.raises(ConfigError) as caught:
        env.reward_manager.get_term_cfg("alve")
    assert caught.value.nearest == "alive"


def _entity(**fields):
    return {"_target_": "wheelleg_exp.managers.SceneEntityCfg", **fields}


def test_an_entity_finds_joints_in_the_robots_or_its_own_order(make_env):
    node = {"_target_": "wheelleg_exp.mdp.rewards.joint_vel_l2", "weight": 1.0}
    names = ["right_.*", "left_hip"]
    for preserve, expected in ((False, [0, 1, 3]), (True, [1, 3, 0])):
        cfg = _entity(name="robot", joint_names=names, preserve_order=preserve)
        env = make_env(rewards={"term": node | {"asset_cfg": cfg}})
        assert env.reward_manager.get_term_cfg("term").params["asset_cfg"].joint_ids.tolist() == expected


def test_an_entity_that_is_a_default_is_not_resolved_and_stands_for_all_joints(make_env):
    """Isaac Lab resolves what stands among a term's parameters alone."""
    default, given = (
        {"_target_": spies.HERE + "default_entity", "weight": 1.0},
        _entity(name="robot", joint_names=["right_hip"]),
    )
    env = make_env(rewards={"a": default, "b": default | {"asset_cfg": given}})
    env.reset()
    spies.LOG.clear()
    env.step(torch.zeros(4, 4))
    everything, one = spies.LOG
    assert everything == slice(None)
    assert one.tolist() == [1]


@pytest.mark.parametrize(
    ("cfg", "key"),
    [
        (_entity(name="robott"), "name"),
        (_entity(name="robot", joint_names=["knee"]), "joint_names"),
        (_entity(name="robot", body_names=["knee"]), "body_names"),
        (_entity(name="contact", joint_names=[".*"]), "joint_names"),
        (_entity(name="contact", body_names=["shin"]), "body_names"),
    ],
)
def test_an_entity_that_is_not_there_names_its_key(make_env, cfg, key):
    node = {"_target_": "wheelleg_exp.mdp.rewards.joint_vel_l2", "weight": 1.0, "asset_cfg": cfg}
    assert _refused(make_env, node).key == f"env.rewards.term.asset_cfg.{key}"


def test_configs_are_left_as_they_were(make_env):
    from sim.small_envs import env_config

    config = env_config(rewards={"alive": dict(ALIVE)})
    env = make_env(rewards={"alive": dict(ALIVE)})
    env.reset()
    assert env.cfg == config


def test_spies_may_stand_in_configs(make_env):
    spies.VALUES["x"] = 2.0
    env = make_env(rewards={"x": {"_target_": spies.HERE + "value", "key": "x", "weight": 3.0}})
    assert env.reward_manager.compute(0.5).tolist() == [3.0] * 4


def test_managers_print_as_tables(make_env):
    text = make_env(rewards={"alive": ALIVE}).describe()
    for word in ("alive", "is_alive", "left_hip", "JointPositionAction", "time_out", "contact"):
        assert word in text


@pytest.mark.parametrize(("name", "said"), [("leaves", "SystemExit: 0"), ("breaks", "RuntimeError: broken")])
def test_a_term_that_fails_while_the_environment_is_built_is_a_mistake_of_the_config(make_env, name, said):
    observations = {"policy": {"terms": {"term": {"_target_": HERE + name}}}}
    with pytest.raises(ConfigError, match=said) as caught:
        make_env(observations=observations)
    assert caught.value.key == "env.observations.policy.terms.term"
    assert f"'managers.test_terms.{name}' raises" in caught.value.message
    assert "test_terms.py:" in caught.value.where
