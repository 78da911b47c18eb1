"""Terms that cannot be built: each row is a section, a node, the key of the error below the term, and its words."""

import pytest

from mdp.nodes import MDP
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.mdp import events

HIPS = [".*_hip"]
TIME = {"resampling_time_range": [9.0, 9.0]}
NORMAL = {"mean_vel": [0.5, 0.0, 1.0], "std_vel": [0.1, 0.2, 0.0], "zero_prob": [0.0, 0.0, 0.3]}
BODY_RANGES = {f"pos_{axis}": [0.1, 0.1] for axis in "xyz"}
STIFFNESS, DAMPING = "stiffness_distribution_params", "damping_distribution_params"
LOWER, UPPER = "lower_limit_distribution_params", "upper_limit_distribution_params"
MASS, GRAVITY = "mass_distribution_params", "gravity_distribution_params"
GAUSSIAN, LOG = {"distribution": "gaussian"}, {"distribution": "log_uniform"}


def _mass(key, words="", **fields):
    return ("events", "randomize_rigid_body_mass", {"operation": "add", MASS: [0, 1]} | fields, key, words)


def _gains(key, **fields):
    return ("events", "randomize_actuator_gains", fields, key, "")


def _gravity(pairs, **fields):
    return ("events", "randomize_physics_scene_gravity", {GRAVITY: pairs, "operation": "abs", **fields}, GRAVITY, "")


def _reset(pose, key):
    node = {"mode": "reset", "pose_range": pose, "velocity_range": {}}
    return ("events", "reset_root_state_uniform", node, key, "")


def _normal(key, **ranges):
    given = {name: value for name, value in (NORMAL | ranges).items() if value is not None}
    return ("commands", "NormalVelocityCommand", {**TIME, "ranges": given}, key, "")


def _command(name, key, words="", **fields):
    return ("commands", name, TIME | fields, key, words)


def _action(name, key, words="", **fields):
    return ("actions", name, {"joint_names": HIPS} | fields, key, words)


HALF_OPEN = {"open_command_expr": {"left_.*": 0.0}, "close_command_expr": {".*": 0.0}}
ROWS = [
    _mass("operation", operation="ad"),
    _mass("distribution", distribution="loguniform"),
    _mass(MASS, operation="scale", **{MASS: [0.0, 1.0]}),
    _mass(MASS, **{MASS: [1.0, 0.0]}),
    _mass(MASS, **{MASS: [1.0, -0.1]}, **GAUSSIAN),
    _gains(STIFFNESS, operation="scale", **{STIFFNESS: [0.0, 1.0]}),
    _gains(DAMPING, operation="scale", **{DAMPING: [-0.1, 1.0]}),
    _gains(DAMPING, **{DAMPING: [2.0, 1.0]}),
    _gains(DAMPING, **{DAMPING: [0.0, 1.0]}, **LOG),
    _gains(DAMPING, **{DAMPING: [1.0, -1.0]}, **GAUSSIAN),
    # The hips' upper limit is below 9 rad.
    ("events", "randomize_joint_parameters", {LOWER: [-1.0, 9.0]}, "", "could exceed an upper limit"),
    ("events", "randomize_joint_parameters", {LOWER: [0.0, 0.1], UPPER: [0.05, 9.0]}, "", "could exceed an upper"),
    _gravity([[0, 0, 1], [0, 0, -1]]),
    _gravity([[1, 1, -9], [1, 1, 9]], **LOG),
    _gravity([[0, 0, 1], [0, 0, -1]], **GAUSSIAN),
    _gravity([[0, 0], [0, 0]]),
    _reset({"X": [0, 1]}, "pose_range.X"),
    _reset({"x": [1, 0]}, "pose_range.x"),
    _reset({"x": [1]}, "pose_range.x"),
    ("events", "reset_root_state_from_terrain", {"pose_range": {}, "velocity_range": {}}, "", "no flat patches"),
    *(("events", name, {}, "_target_", why) for name, why in events.ABSENT.items()),
    _normal("ranges.std_vel", std_vel=[0.1, -0.1, 0.0]),
    _normal("ranges.zero_prob", zero_prob=[0.0, 1.1, 0.0]),
    _normal("ranges.mean_vel", mean_vel=[0.0, 1.0]),
    _normal("ranges.lin_vel_x", lin_vel_x=[0.0, 1.0]),
    _normal("ranges.mean_vel", mean_vel=None),
    _command("UniformPose2dCommand", "ranges.heading", simple_heading=False, ranges={"pos_x": [0.0, 1.0]}),
    _command("TerrainBasedPose2dCommand", "", "no flat patches named 'target'", simple_heading=True, ranges={}),
    _command("UniformPoseCommand", "body_name", "left_wheel, right_wheel", body_name=".*_wheel", ranges=BODY_RANGES),
    _command("UniformBasePoseCommand", "ranges.height", ranges={"pitch": [0.0, 0.1]}),
    _action("JointPositionToLimitsAction", "joint_names", "left_axle, right_axle has no limits", joint_names=[".*"]),
    _action("EMAJointPositionToLimitsAction", "alpha", alpha=1.5),
    _action("EMAJointPositionToLimitsAction", "alpha", alpha=-0.1),
    _action("EMAJointPositionToLimitsAction", "alpha.left_hip", alpha={"left_hip": 2.0}),
    _action("BinaryJointPositionAction", "open_command_expr", "no value for joint right_hip", **HALF_OPEN),
    _action("JointPositionAction", "asset_name", "no robot or sensor 'robto'", asset_name="robto"),
    _action("JointPositionAction", "delay", delay=[2, 1]),
]


@pytest.mark.parametrize(("section", "name", "fields", "key", "words"), ROWS)
def test_a_wrong_term_is_rejected_by_key(make_env, section, name, fields, key, words):
    node = {"_target_": f"{MDP}{section}.{name}", **({"mode": "startup"} if section == "events" else {}), **fields}
    with pytest.raises(ConfigError) as caught:
        make_env(**{section: {"t": node}})
    assert caught.value.key == f"env.{section}.t" + (f".{key}" if key else "")
    assert words in str(caught.value)
