"""No state is forgotten: a walk over all objects finds the same in an environment and in one restored from it."""

from __future__ import annotations

import copy
import inspect
import io
import re
from functools import partial

import pytest
import torch
from managers import spies
from sim.small_envs import ACTUATORS, env_config

from env.composed import event, term
from env.crawler import Crawl, differing
from env.test_determinism import SECTIONS
from wheelleg_exp.env.undeclared import UndeclaredChanges
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import TermBase
from wheelleg_exp.mdp import actions, commands, curriculums, events, modifiers, noise, observations, rewards
from wheelleg_exp.mdp import terminations as terminations_module
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.sim import actuators
from wheelleg_exp.sim.sensors import ContactSensor, Imu, RayCaster

HIPS = {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": "robot", "joint_names": [".*_hip"]}
SENSOR = "wheelleg_exp.sim.sensors."
PATTERN = {"_target_": SENSOR + "GridPattern", "resolution": 0.1, "size": [0.2, 0.2]}
RAYS = {"_target_": SENSOR + "RayCaster", "pattern": PATTERN}
NOISE = {"_target_": SENSOR + "ImuNoise", "std": 0.1, "bias_walk": 0.1}
SENSORS = {
    "scan": {**RAYS, "body_name": "base", "ray_cast_drift_range": {"z": [-0.1, 0.1]}},
    "imu": {"_target_": SENSOR + "Imu", "body_name": "base", "gyroscope": NOISE},
    "held": {**RAYS, "body_name": "left_wheel", "update_period": 0.05},
}

# These values may differ after loading, because the environment recomputes them before their next use.
DERIVED = frozenset(
    {
        "._views['sensordata']",  # MuJoCo results, which sensors read after each physics step
        "._views['actuator_force']",
        *(f".sensors['contact'].{name}" for name in ("_readings", "_pressures", "_normals", "_norms", "_counts")),
        *(f".sensors['contact'].{name}" for name in ("_largest_norm", "data._history")),
        *("._ended", "._attributes"),  # masks of the last step that are being copied to the host
        *("._has_worked", ".form"),  # used in error messages only
        *(".robot.data._cache", ".robot.data._shows_outputs"),  # quantities that are derived from the state on demand
        *(".robot.data.motion_at_start", ".command_manager.step_errors"),  # only used within a control step
        # recomputed if a curriculum has changed a weight
        *(".reward_manager._factors", ".reward_manager._weights"),
        *(".robot._has_new_targets", ".action_manager._is_new"),  # set at the start of a control step
    }
)


def everything() -> dict:
    """Return a config with every stateful class of the term library."""
    sections = copy.deepcopy(SECTIONS)
    left, right = {"joint_names": ["left_hip"]}, {"joint_names": ["right_hip"]}
    axles = {"joint_names": [".*_axle"]}
    sections["actions"] = {
        "position": term("actions.JointPositionAction", **left, scale=0.2, clip={".*": [-1.0, 1.0]}),
        "relative": term("actions.RelativeJointPositionAction", **right, scale=0.1),
        "velocity": term("actions.JointVelocityAction", **axles, scale=2.0),
        "effort": term("actions.JointEffortAction", **axles, scale=0.1),
    }
    lift = {"pose_range": {"z": [0.0, 0.1]}, "velocity_range": {}}
    gains = {f"{name}_distribution_params": [0.5, 1.5] for name in ("stiffness", "damping")}
    limits = {"lower_limit_distribution_params": [-1.5, -1.0], "upper_limit_distribution_params": [1.0, 1.5]}
    passive = {"friction_distribution_params": [0.0, 0.1], "armature_distribution_params": [0.01, 0.02]}
    gravity = {"gravity_distribution_params": [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], "per_env": True}
    force = {"force_range": [-2.0, 2.0], "torque_range": [-0.1, 0.1], "duration_s": [0.02, 0.1], "pause_s": [0.0, 0.2]}
    turn = {"interval_range_s": [0.2, 0.5], "velocity_range": {"yaw": [-1.0, 1.0]}}
    inertia = {"inertia_distribution_params": [0.5, 1.5]}
    sections["events"] |= {
        "set": event("set_root_velocity", "interval", **turn),
        "orientation": event(
            "reset_root_state_with_random_orientation", "reset", min_step_count_between_reset=20, **lift
        ),
        "gains": event("randomize_actuator_gains", "reset", operation="scale", **gains),
        "parameters": event("randomize_joint_parameters", "reset", asset_cfg=HIPS, **passive, **limits),
        "encoders": event("randomize_encoder_bias", "reset", bias_range=[-0.05, 0.05]),
        "gravity": event("randomize_physics_scene_gravity", "reset", operation="add", **gravity),
        "inertia": event("randomize_rigid_body_inertia", "reset", operation="scale", **inertia),
        "impulse": event("apply_body_impulse", "step", **force),
    }
    uniform = term("noise.UniformNoise", n_min=-0.01, n_max=0.01)
    chain = [
        term("modifiers.Scale", multiplier=2.0),
        term("modifiers.Bias", value=0.1),
        term("modifiers.Clip", bounds=[-3.0, 3.0]),
        term("modifiers.Integrator", dt=0.02),
        term("modifiers.DigitalFilter", A=[0.5], B=[0.5, 0.2]),
    ]
    biased = term("noise.NoiseModelWithAdditiveBias", noise_cfg=uniform, bias_noise_cfg={**uniform, "operation": "abs"})
    sections["observations"]["policy"]["terms"] |= {
        "modified": term("observations.base_lin_vel", modifiers=chain, noise=term("noise.ConstantNoise", bias=0.5)),
        "normal": term("observations.joint_pos_limit_normalized", asset_cfg=HIPS),
        "biased": term("observations.joint_vel", noise=biased, clip=[-5.0, 5.0], scale=0.5),
    }
    sections["observations"]["critic"] = {"terms": {"v": term("observations.base_lin_vel")}, "history_length": 2}
    sections["robot"] = {"actuators": copy.deepcopy(env_config()["robot"]["actuators"])}
    sections["robot"]["actuators"]["axles"]["_target_"] = ACTUATORS + "IdealPDActuator"
    sections["scene"] = {"sensors": {"contact": env_config()["scene"]["sensors"]["contact"], **SENSORS}}
    for name in ("is_terminated_term", "action_acceleration_l2", "joint_vel_rate_l2"):
        sections["rewards"][name] = term(f"rewards.{name}", weight=-1.0)
    stuck = term("terminations.stuck", command_name="v", distance=0.01, time=0.3)
    sections["terminations"] = {**sections.get("terminations", {}), "stuck": stuck}
    schedule = {"modify_fn": "wheelleg_exp.mdp.schedules.linear"}
    schedule["modify_params"] = {"start": 1.0, "end": 2.0, "num_steps": 50}
    levels = {"reward_term_name": "is_terminated_term", "command_name": "v", "limit_ranges": {"lin_vel_x": [-9.0, 9.0]}}
    sections["curriculum"] = {
        **sections.get("curriculum", {}),
        "levels": term("curriculums.command_range_levels", **levels),
        "setting": term("curriculums.modify_term_cfg", address="rewards.joint_vel_rate_l2.weight", **schedule),
        "anything": term("curriculums.modify_env_param", address="max_episode_length_s", **schedule),
    }
    return sections


@pytest.fixture
def make(make_env):
    def build(seed=0, **changes):
        return make_env(seed=seed, **everything() | changes)

    return build


GAINS = {"stiffness": 20.0, "damping": 1.0}
LIMITS = {"effort_limit": 4.0, "velocity_limit": 30.0}
TABLE = [[-1.0, 1.0, 2.0], [1.0, 1.0, 4.0]]
MODELS = {
    "ImplicitActuator": {**GAINS, **LIMITS, "delay": [0, 3]},
    "DCMotor": {**GAINS, **LIMITS, "saturation_effort": 5.0, "delay": [1, 1]},
    "DelayedPDActuator": {**GAINS, **LIMITS, "min_delay": 0, "max_delay": 4},
    "RemotizedPDActuator": {**GAINS, "joint_parameter_lookup": TABLE, "max_delay": 2},
}


def driven(model):
    """Return the robot section with a network as the actuator model of the hips."""
    robot = everything()["robot"]
    target = model if "." in model else ACTUATORS + model
    hips = {"_target_": target, "joint_names_expr": [".*_hip"], **MODELS.get(model, {**GAINS, **LIMITS})}
    robot["actuators"]["hips"] = hips
    return robot


def act(env, steps, start=0):
    """Run steps whose actions depend only on the step number; return the results of each step."""
    given = []
    for k in range(start, start + steps):
        generator = torch.Generator().manual_seed(k)
        action = torch.randn(env.num_envs, env.action_manager.total_action_dim, generator=generator)
        obs, reward, terminated, time_outs, extras = env.step(action)
        log = {name: float(value) for name, value in extras.get("log", {}).items()}
        given.append(copy.deepcopy((obs, reward, terminated, time_outs, log)))
    return given


def lived(env, steps=0):
    """Return the environment after a reset and some steps."""
    env.reset()
    act(env, steps)
    return env


def restored(env, make, lived_for=0):
    """Return a new environment, stepped ``lived_for`` times with another seed, and then loaded with the state."""
    file = io.BytesIO()
    torch.save(env.state_dict(), file)
    other = lived(make(seed=91))
    act(other, lived_for, start=1000)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    return other


@pytest.mark.parametrize(("steps", "lived_for"), [(0, 0), (1, 9), (37, 60)])
def test_a_restored_environment_has_the_same_values_everywhere(make, steps, lived_for):
    env = lived(make(), steps)
    other = restored(env, make, lived_for)
    assert differing(Crawl(env, DERIVED), Crawl(other, DERIVED)) == []
    assert equal(act(env, 25, steps), act(other, 25, steps))
    assert differing(Crawl(env), Crawl(other)) == []


def equal(a, b):
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[k], b[k]) for k in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(equal, a, b))
    return a == b


def _classes(module, *bases):
    inside = (module.__name__, f"{module.__name__}.")
    members = inspect.getmembers(module, inspect.isclass)
    found = [c for _, c in members if c.__module__ == inside[0] or c.__module__.startswith(inside[1])]
    return {c for c in found if issubclass(c, bases) and not c.__name__.startswith("_")} if bases else set(found)


def test_the_walk_meets_every_class_that_may_have_state(make):
    env = lived(make())
    found = Crawl(env).classes.union(*(Crawl(make(robot=driven(model))).classes for model in MODELS))
    library = {ContactSensor, Imu, RayCaster, *_classes(actuators, actuators.ActuatorBase), *_classes(noise)}
    library |= _classes(modifiers, modifiers.Modifier)
    for module in (actions, commands, curriculums, events, observations, rewards, terminations_module):
        library |= _classes(module, TermBase)
    library -= {actuators.ActuatorNetMLP, actuators.ActuatorNetLSTM}  # Tests in tests/sim cover these actuators.
    texts = [path.read_text(encoding="utf-8") for path in configs_dir().rglob("*.yaml")]
    stock = {name.rpartition(".")[2] for text in texts for name in re.findall(r"_target_: *([\w.]+)", text)}
    left = {c.__qualname__ for c in library - found if not inspect.isabstract(c)} - stock - BASES
    assert left == set(), "neither here nor among the stock nodes, all of which tests/env/test_stock_nodes.py restores"


BASES = {"ActuatorBase", "BinaryJointAction", "Modifier", "JointAction", "JointTerm", "TermBase", "ActionTerm"}
BASES |= {"CommandTerm"}


SPOILS = [
    lambda env: env.episode_length_buf.add_(1),
    lambda env: env.command_manager.get_term("v").time_left.add_(0.1),
    lambda env: env.event_manager._last_step["wrench"].add_(1),
    lambda env: env.observation_manager._groups["policy"]["modified"]._modifiers[3]._integral.add_(1e-6),
    lambda env: env.scene.robot.data._qvel_before.add_(1e-12),
    lambda env: env.scene.sim.expand("body_mass").mul_(1.0 + 1e-12),
    lambda env: env.scene.sensors["contact"].data.last_air_time.add_(1e-6),
    lambda env: env.streams.get("env.commands.v").manual_seed(1),
    lambda env: setattr(env, "common_step_counter", env.common_step_counter + 1),
    lambda env: env.reward_manager.get_term_cfg("alive").fields.update(weight=1.5),
]


def test_the_walk_notices_any_of_them_and_loading_a_state_takes_each_back(make):
    env = lived(make(), 20)
    other, walked, state = restored(env, make), Crawl(env, DERIVED), copy.deepcopy(env.state_dict())
    for number, spoil in enumerate(SPOILS):
        spoil(other)
        assert differing(walked, Crawl(other, DERIVED)) != [], number
        other.load_state_dict(copy.deepcopy(state))
        assert differing(walked, Crawl(other, DERIVED)) == [], number


# --- user-defined terms: supported state ---

OWN = ["RemembersInAList", "RemembersNumbers", "RemembersInAHelper", "RemembersGenerators"]


def test_a_terms_own_state_is_saved_without_its_help(make):
    own = {kind: {"_target_": spies.HERE + kind, "weight": 1.0} for kind in OWN}
    build = partial(make, rewards=everything()["rewards"] | own)
    env = lived(build(), 15)
    other = restored(env, build, lived_for=8)
    assert differing(Crawl(env, DERIVED), Crawl(other, DERIVED)) == []
    assert equal(act(env, 10, 15), act(other, 10, 15))


def test_an_actuators_memory_is_saved(make):
    plain = [g[0] for g in act(make(), 5)]
    for model in (spies.HERE + "Delayed", *MODELS):
        build = partial(make, robot=driven(model))
        env = build()
        assert not equal([g[0] for g in act(env, 5)], plain), model
        other = restored(lived(env, 15), build, lived_for=8)
        assert differing(Crawl(env, DERIVED), Crawl(other, DERIVED)) == [], model
        assert equal(act(env, 10, 15), act(other, 10, 15)), model


UNDECLARED = {
    "remembers_on_the_robot": ("env.scene.robot", "'own_calls' of 'Robot'"),
    "remembers_on_its_term": ("env.rewards.own", "'calls' of 'Term'"),
    "RemembersLate": ("env.rewards.own", "'calls' of 'RemembersLate'"),
}


@pytest.mark.parametrize("kind", UNDECLARED)
def test_undeclared_state_is_named_after_some_steps(make, kind):
    env = make(rewards=everything()["rewards"] | {"own": {"_target_": spies.HERE + kind, "weight": 1.0}})
    watch = UndeclaredChanges(env)
    act(lived(env), 2)
    key, words = UNDECLARED[kind]
    with pytest.raises(ConfigError, match=words) as caught:
        watch.require_none()
    assert caught.value.key == key


def test_all_terms_of_the_library_declare_their_state(make):
    env = make()
    watch = UndeclaredChanges(env)
    act(lived(env), 40)
    watch.require_none()


def test_an_expanded_batch_is_refused_when_it_is_saved(make):
    kind = spies.HERE + "expands_the_batch"
    env = lived(make(rewards=everything()["rewards"] | {"own": {"_target_": kind, "weight": 1.0}}), 1)
    with pytest.raises(ConfigError, match="jnt_stiffness") as caught:
        env.state_dict()
    assert caught.value.key == "env.scene.sim.batch"


MODEL_WRITES = {
    "opt.gravity": lambda m: m.opt.gravity.__setitem__(2, -5.0),
    "opt.wind": lambda m: setattr(m.opt, "wind", [1.0, 0.0, 0.0]),
    "opt.disableflags": lambda m: setattr(m.opt, "disableflags", 1),
    "body_mass": lambda m: m.body_mass.__imul__(1.1),
    "geom_friction": lambda m: setattr(m.geom("ground"), "friction", [2.0, 0.005, 0.0001]),
}


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_a_write_to_the_compiled_model_is_refused_by_name_and_expanded_fields_are_saved(make_env, engine):
    env = lived(make_env(sim={"engine": engine}))
    for name, write in MODEL_WRITES.items():
        before = copy.deepcopy(env.scene.sim.model)
        write(env.scene.sim.model)
        with pytest.raises(ConfigError, match=rf"has changed {name} of .* no effect") as caught:
            env.state_dict()
        assert caught.value.key == "env.scene.sim.model"
        assert f"env.scene.sim.expand('{name}')" in str(caught.value)
        for field in ("body_mass", "geom_friction"):
            getattr(env.scene.sim.model, field)[:] = getattr(before, field)
        for field in ("gravity", "wind", "disableflags"):
            setattr(env.scene.sim.model.opt, field, getattr(before.opt, field))
    for name in ("opt.gravity", "body_mass", "geom_friction"):
        env.scene.sim.expand(name)[:] *= 1.5
    env.scene.sim.set_const()
    other = make_env(sim={"engine": engine}, seed=3)
    other.load_state_dict(env.state_dict())
    action = torch.zeros(env.num_envs, env.action_manager.total_action_dim)
    assert equal([env.step(action)[0] for _ in range(5)], [other.step(action)[0] for _ in range(5)])


def test_an_event_at_startup_that_writes_to_the_compiled_model_is_refused(make_env):
    spies.VALUES["write"] = lambda env, ids: env.scene.model.body_mass.__imul__(2.0)
    event = {"_target_": spies.HERE + "writes", "mode": "startup", "key": "write"}
    with pytest.raises(ConfigError, match="body_mass of the compiled model"):
        make_env(events={"heavier": event})


def test_attributes_that_a_term_adds_to_the_environment_are_saved_like_its_own(make):
    own = {"_target_": spies.HERE + "remembers_on_the_environment", "weight": 1.0}
    build = partial(make, rewards=everything()["rewards"] | {"own": own})
    env = lived(build(), 15)
    env.max_episode_length = 40  # A curriculum may set this attribute.
    other = restored(env, build, lived_for=8)
    assert equal(act(env, 30, 15), act(other, 30, 15))
    assert other.own_calls == env.own_calls
    fresh = lived(build())
    other.load_state_dict(fresh.state_dict())
    assert (hasattr(other, "own_calls"), other.max_episode_length) == (False, fresh.max_episode_length)


def test_settings_that_a_curriculum_changed_are_state(make):
    env = lived(make())
    env.reward_manager.get_term_cfg("track").params["std"] = 0.75
    env.event_manager.get_term_cfg("joints").params["position_range"][1] = 0.2
    env.termination_manager.get_term_cfg("tilt").params["limit_angle"] = 0.9
    env.observation_manager.terms("policy")["c"].term.fields["scale"] = 3.0
    act(env, 5)
    other = restored(env, make)
    assert differing(Crawl(env, DERIVED | {".cfg"}), Crawl(other, DERIVED | {".cfg"})) == []
    assert other.event_manager.get_term_cfg("joints").params["position_range"] == [-0.1, 0.2]


def test_a_setting_that_the_config_changes_wins_over_the_saved_one_and_one_that_a_curriculum_has_changed(make):
    env = lived(make(), 5)
    env.reward_manager.get_term_cfg("track").fields["weight"] = 7.0
    sections = everything()
    sections["rewards"]["track"]["weight"] = 3.0
    sections["events"]["push"]["velocity_range"] = {"x": [9.0, 9.0]}
    sections["commands"]["v"]["ranges"]["lin_vel_x"] = [5.0, 5.0]
    sections["actions"]["position"]["scale"] = 0.7
    other = make(**sections)
    other.load_state_dict(env.state_dict())
    assert other.reward_manager.get_term_cfg("track").fields["weight"] == 3.0
    assert other.event_manager.get_term_cfg("push").func._high[0] == 9.0
    assert other.command_manager.get_term("v").bounds()[0][0] == 5.0
    assert other.action_manager.get_term("position")._scale[0] == pytest.approx(0.7)


def test_model_fields_that_were_edited_after_the_constants_were_derived_go_round(make):
    env = lived(make(), 3)
    env.scene.sim.expand("body_ipos")[:, 1] += 0.02
    env.scene.sim.expand("dof_armature")[:, 6:] += 0.01
    other = restored(env, make, lived_for=4)
    assert equal(act(env, 20, 3), act(other, 20, 3))
