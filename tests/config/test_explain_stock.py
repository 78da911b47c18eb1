import pytest
from patience import thinned

from wheelleg_exp.config import key_slots as known
from wheelleg_exp.config import schema
from wheelleg_exp.config.composing.compose import Composed, compose
from wheelleg_exp.config.explaining import key_documentation as fixed
from wheelleg_exp.config.explaining.explanation import explain_key
from wheelleg_exp.config.tree_lookup import leaves
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.rl.options import Agent
from wheelleg_exp.sim.options import EnvOptions
from wheelleg_exp.terms.config_sections import keys_of
from wheelleg_exp.terms.key_syntax import dotted
from wheelleg_exp.terms.term_binding import RESERVED

pytestmark = pytest.mark.slow

TASKS = sorted(path.stem for path in (configs_dir() / "task").glob("*.yaml"))


@pytest.fixture(scope="module")
def stand() -> Composed:
    return compose(["task=stand"])


@pytest.mark.parametrize("task", thinned(TASKS, 3))
def test_every_leaf_of_a_task_has_a_meaning_a_type_and_a_source(task):
    composed = compose([f"task={task}"])
    found = [explain_key(composed, dotted(keys)) for keys, value in leaves(composed.config) if value != {}]
    assert [e.key for e in found if not any(note.about == "key" for note in e.meanings)] == []
    assert [e.key for e in found if e.kind != "value" or not e.is_read or not e.sources] == []
    assert {e.key: e.value for e in found} == {dotted(k): v for k, v in leaves(composed.config) if v != {}}


UNITS = {
    "env.sim.dt": "s",
    "env.robot.init_state.joint_pos[.*01$]": "rad",
    "env.robot.actuators.legs.stiffness": "N·m/rad",
    "env.robot.actuators.wheels.velocity_limit": "rad/s",
    "env.scene.sensors.contact_forces.force_threshold": "N",
    "env.commands.base_velocity.resampling_time_range": "s",
    "env.actions.leg_pos.scale": "rad per unit of action",
    "env.observations.policy.terms.joint_vel_rel.scale": "per rad/s",
    "env.rewards.base_height.target_height": "m",
    "env.events.push_robot.interval_range_s": "s",
    "agent.num_steps_per_env": "control steps",
    "env.rewards.alive.weight": None,
    "agent.algorithm.gamma": None,
}


@pytest.mark.parametrize("key", UNITS)
def test_the_unit_of_a_stock_leaf(stand, key):
    assert explain_key(stand, key).unit == UNITS[key]


def test_parameters_of_rsl_rl_names_and_the_inside_of_default_objects_are_explained(stand):
    rnd = explain_key(stand, "agent.algorithm.rnd_cfg")
    assert (rnd.kind, rnd.value) == ("not set", None)
    activation = explain_key(stand, "agent.actor.activation")
    assert {"elu", "relu", "tanh"} <= set(activation.alternatives.values)
    assert activation.alternatives.default == "elu"
    assert any("ctivation function" in note.text for note in activation.meanings)
    for key, values in {
        "agent.obs_groups.actor": ("policy", "critic"),
        "env.rewards.track_ang_vel_z.command_name": ("base_velocity",),
        "env.rewards.wheel_air.sensor_cfg.name": ("robot", "contact_forces"),
    }.items():
        assert explain_key(stand, key).alternatives.values == values
    name, joints = (explain_key(stand, f"env.events.reset_base.asset_cfg.{key}") for key in ("name", "joint_names"))
    assert (name.kind, name.value) == ("not set", "robot")
    text = "joint expressions; null is all. Once resolved, the names."
    assert (joints.value, joints.meanings[0].text) == (None, text)


def test_every_field_of_a_manager_and_every_fixed_key_has_a_meaning():
    assert set(fixed.FIELDS) == {name for names in RESERVED.values() for name in names}
    for path, options in {"": schema.Experiment, "env": EnvOptions, "agent": Agent, "task": schema.Task}.items():
        for name in keys_of(options):
            assert fixed.meaning_of((*filter(None, path.split(".")), name)), (path, name)


def test_a_key_of_play_is_explained_and_a_key_that_nothing_reads_has_no_slot():
    explained = explain_key(compose(primary="play"), "play.settle_s")
    assert (explained.value, explained.sources[0].where.endswith("configs/play.yaml:5")) == (1.0, True)
    tree = compose(["task=stand"]).config
    assert known.slot(tree, ("env", "rewards", "alive", "nothing")) is None
    assert known.slot(tree, ("nothing",)) is None
    assert known.slot(tree, ("env", "robot", "init_state", "joint_pos", "any")).annotation is float
