"""Describe a policy in ``policy.json``: everything between sensor readings and joint targets, as numbers.

If the exported ``runner.py`` cannot compute a term or a network, ConfigError names this term or network.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, get_args

import mujoco
import numpy as np
import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution

from wheelleg_exp.anatomy.compiled_robot import at_default
from wheelleg_exp.config.tree_lookup import section_at
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.export import policy_json
from wheelleg_exp.jobs.export.bundle.runner import projected_gravity
from wheelleg_exp.jobs.export.exported_observations import COMMANDS, observation_specs, reading, readings_of
from wheelleg_exp.jobs.export.policy_json import ActionLaw, ActionTerm, Drive, Limits, Robot
from wheelleg_exp.mdp import actions
from wheelleg_exp.mdp.commands import JumpCommand
from wheelleg_exp.sim import actuators
from wheelleg_exp.sim.actuators.actuator_base import ActuatorBase
from wheelleg_exp.sim.sensors import Imu

_DRIVE_LAWS: dict[type, str] = {actuators.ImplicitActuator: "implicit", actuators.DCMotor: "dc_motor"}
_DRIVE_LAWS |= dict.fromkeys((actuators.IdealPDActuator, actuators.DelayedPDActuator), "pd")
_DRIVE_RATE_MARGIN = 10.0
_DriveKey = Literal["stiffness", "damping", "effort_limit", "velocity_limit"]
_DRIVE_KEYS: tuple[_DriveKey, ...] = get_args(_DriveKey)


def drive_specs(env: ManagerBasedRLEnv) -> list[Drive]:
    """Return a description of each actuator group of the robot, in the order of the config.

    ``law`` is ``implicit`` (a spring and a damper inside the solver, clipped to the effort limit), ``pd`` (spring and
    damper, computed from the state before each physics step), ``dc_motor`` (with a motor's torque-speed line), or null:
    a law that only the training's simulation has.
    """
    found = []
    for name, group in env.scene.robot.actuators.items():
        node = env.cfg["robot"]["actuators"][name]
        delay = node.get("delay") or ([node["min_delay"], node["max_delay"]] if "max_delay" in node else None)
        spec: Drive = {
            "name": name,
            "law": drive_law(group),
            "class": type(group).__name__,
            "joint_names": list(group.joint_names),
            "joint_ids": group.joint_ids.tolist(),
            "stiffness": _numbers(group.stiffness),
            "damping": _numbers(group.damping),
            "effort_limit": _numbers(group.effort_limit),
            "velocity_limit": _numbers(group.velocity_limit),
            "saturation_effort": group._saturation.tolist() if isinstance(group, actuators.DCMotor) else None,
            "trained_with": {"delay_steps": delay},
        }
        found.append(spec)
    return found


def _numbers(values: torch.Tensor) -> Limits:
    return [finite(value) for value in values[0].tolist()]


def drive_law(group: ActuatorBase) -> str | None:
    """Return an actuator group's control law, such as ``pd``; None if the export does not support this group."""
    return _DRIVE_LAWS.get(type(group))


def per_joint(env: ManagerBasedRLEnv, drives: list[Drive]) -> policy_json.PerJoint:
    """Return the drive gains, limits, and mechanical properties of every joint, in the robot's joint order.

    The drive gains of a joint without a drive are 0. ``inertia`` is the inertia of the bodies that a joint moves, about
    the joint's axis, without ``armature``. ``drive_rate`` (Hz) is the rate at which a drive must compute its torque:
    each physics step, and ten times the rate for stability (kp·dt² + 2·kd·dt < 4·I).
    """
    robot = env.scene.robot
    count = len(robot.joint_names)
    gains: dict[_DriveKey, Limits] = {
        key: [0.0 if key in ("stiffness", "damping") else None] * count for key in _DRIVE_KEYS
    }
    for drive in drives:
        for key in _DRIVE_KEYS:
            for joint, value in zip(drive["joint_ids"], drive[key], strict=True):
                gains[key][joint] = value
    model, dofs = env.scene.sim.model, robot.layout.dof_ids.tolist()
    matrix = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, at_default(model, robot), matrix)
    # ``effective`` is the inertia that a joint's torque accelerates if all other joints can move freely.
    effective = 1.0 / np.linalg.inv(matrix).diagonal()[dofs]
    kp, kd = (np.array([value or 0.0 for value in gains[key]]) for key in _DRIVE_KEYS[:2])
    least = (kd + np.sqrt(kd**2 + 4 * kp * effective)) / (4 * effective)
    return {
        "stiffness": gains["stiffness"],
        "damping": gains["damping"],
        "effort_limit": gains["effort_limit"],
        "velocity_limit": gains["velocity_limit"],
        "armature": model.dof_armature[dofs].tolist(),
        "friction": model.dof_frictionloss[dofs].tolist(),
        "viscous_friction": model.dof_damping[dofs].tolist(),
        "inertia": (matrix.diagonal() - model.dof_armature)[dofs].tolist(),
        "drive_rate": np.maximum(_DRIVE_RATE_MARGIN * least, 1 / env.physics_dt).tolist(),
    }


def finite(value: float) -> float | None:
    """Return ``value``, or None if it is not finite, because JSON has no inf."""
    return value if abs(value) < float("inf") else None


def action_specs(env: ManagerBasedRLEnv) -> list[ActionTerm]:
    """Return the action terms of a policy in order, each with its slice of the policy's output and its joints."""
    manager, start, found = env.action_manager, 0, []
    for name, width in zip(manager.active_terms, manager.action_term_dim, strict=True):
        term: Any = manager.get_term(name)
        bound = manager.get_term_cfg(name)
        known = _KNOWN_ACTIONS.get(type(term))
        if known is None:
            message = f"a runner does not know the actions of '{bound.target}'"
            expected = "one of " + ", ".join(sorted(kind.__name__ for kind in _KNOWN_ACTIONS))
            raise ConfigError(message, key=bound.path, expected=expected)
        ids = torch.arange(len(env.scene.robot.joint_names))[term._ids].tolist()
        spec: ActionTerm = {
            "name": name,
            "start": start,
            "stop": start + width,
            "joint_names": list(term.joint_names),
            "joint_ids": ids,
            "drives": term.drives,
            **known(term),
            "clip": _clip(term),
            # The exported ``runner.py`` adds no action delay, because a real robot has its own delay.
            "trained_with": {"delay_steps": env.cfg["actions"][name].get("delay")},
        }
        found.append(spec)
        start += width
    return found


def _clip(term: actions.JointTerm) -> list[Limits] | None:
    """Return the lower and upper bound to which each joint's target is clipped; null means no bound."""
    if term._low is None or term._high is None:
        return None
    return [[finite(low), finite(high)] for low, high in zip(term._low.tolist(), term._high.tolist(), strict=True)]


def _affine(term: actions.JointAction, function: str = "affine") -> ActionLaw:
    return {"function": function, "scale": term._scale.tolist(), "offset": term._offset[0].tolist()}


def _to_limits(term: actions.JointPositionToLimitsAction) -> ActionLaw:
    low, high = term._limits()
    return {
        "function": "to_limits",
        "scale": term._scale.tolist(),
        "offset": [0.0] * len(term._scale),
        "rescale": term._rescale,
        "low": _numbers(low),
        "high": _numbers(high),
    }


def _binary(term: actions.BinaryJointAction) -> ActionLaw:
    absolute = term if isinstance(term, actions.AbsBinaryJointPositionAction) else None
    return {
        "function": "binary",
        "threshold": absolute._threshold if absolute else 0.0,
        "strict": absolute._positive if absolute else False,
        "opens_above": absolute._positive if absolute else True,
        "open": term._open.tolist(),
        "close": term._close.tolist(),
    }


_KNOWN_ACTIONS: dict[type, Callable[[Any], ActionLaw]] = {
    **dict.fromkeys((actions.JointPositionAction, actions.JointVelocityAction, actions.JointEffortAction), _affine),
    actions.RelativeJointPositionAction: lambda term: _affine(term, "relative"),
    actions.JointPositionToLimitsAction: _to_limits,
    actions.EMAJointPositionToLimitsAction: lambda term: {**_to_limits(term), "alpha": term._alpha.tolist()},
    actions.BinaryJointPositionAction: _binary,
    actions.BinaryJointVelocityAction: _binary,
    actions.AbsBinaryJointPositionAction: _binary,
}

_ACTIVATIONS: dict[type, str] = {
    torch.nn.ELU: "elu",
    torch.nn.CELU: "elu",  # CELU equals ELU, because rsl_rl sets CELU's parameter alpha to 1.
    torch.nn.ReLU: "relu",
    torch.nn.LeakyReLU: "leaky_relu",
    torch.nn.SELU: "selu",
    torch.nn.Tanh: "tanh",
    torch.nn.Sigmoid: "sigmoid",
    torch.nn.Softplus: "softplus",
    torch.nn.SiLU: "swish",
    torch.nn.Identity: "identity",
}
ROLES = ("student", "actor")
_GAUSSIAN = GaussianDistribution.__name__


def require_perceptron(section: Mapping[str, object], key: str) -> None:
    """Raise ConfigError unless the network is an ``MLPModel`` whose output is the mean action."""
    if section["class_name"] != MLPModel.__name__:
        message = f"a runner does not know networks of class '{section['class_name']}'"
        raise ConfigError(message, key=f"{key}.class_name", expected="MLPModel: no memory of its own, no pictures")
    distribution = section_at(section, "distribution_cfg").get("class_name", _GAUSSIAN)
    if distribution != _GAUSSIAN:
        message = f"a runner does not know the mean of a '{distribution}'"
        expected = f"{_GAUSSIAN}, whose mean is the network's output"
        raise ConfigError(message, key=f"{key}.distribution_cfg.class_name", expected=expected)


def network_arrays(policy: MLPModel, role: str) -> tuple[policy_json.Network, dict[str, np.ndarray]]:
    """Return the description of a perceptron, and its arrays by name: float32, the deviation float64."""
    arrays: dict[str, np.ndarray] = {}
    if policy.obs_normalization:
        normalizer = policy.obs_normalizer
        arrays["mean"] = _array(normalizer._mean[0])
        arrays["deviation"] = (normalizer._std[0].double() + normalizer.eps).numpy()
    activations: list[str] = []
    for layer in policy.mlp:
        if isinstance(layer, torch.nn.Linear):
            arrays[f"weight_{len(activations)}"] = _array(layer.weight)
            arrays[f"bias_{len(activations)}"] = _array(layer.bias)
            activations.append("identity")
        elif type(layer) in _ACTIVATIONS:
            activations[-1] = _ACTIVATIONS[type(layer)]
        else:
            message = f"a runner does not know the activation '{type(layer).__name__}'"
            expected = "one of elu, relu, lrelu, selu, tanh, sigmoid, softplus, swish, identity"
            raise ConfigError(message, key=f"agent.{role}.activation", expected=expected)
    widths = [arrays[f"bias_{k}"].size for k in range(len(activations))]
    about: policy_json.Network = {
        "file": "policy.npz",
        "dtype": "float32",
        "widths": widths,
        "activations": activations,
        "normalized": bool(policy.obs_normalization),
    }
    return about, arrays


def _array(values: torch.Tensor) -> np.ndarray:
    return values.detach().cpu().numpy().astype(np.float32)


FORMAT_VERSION = 1


def specification(
    env: ManagerBasedRLEnv, agent: Mapping[str, Any], ranges: Mapping[str, Mapping[str, list[float]]]
) -> policy_json.Specification:
    """Return the content of ``policy.json`` for an environment and its agent, without the network.

    Lists such as ``stiffness`` have one value per joint, in the order of ``joint_names``; a null limit means no limit.
    ``policy.json`` uses Isaac Lab's names where possible. ``env`` must have one robot and no events, because events can
    change the robot. ``ranges`` contains the range [low, high] of each command component at the end of training.
    """
    robot, layout = env.scene.robot, env.scene.robot.layout
    groups = observation_specs(env, agent["obs_groups"]["student" if "student" in agent else "actor"])
    actions, drives = action_specs(env), drive_specs(env)
    names = readings_of(groups)
    commands = [name.removeprefix(COMMANDS) for name in names if name.startswith(COMMANDS)]
    limits = [[finite(low), finite(high)] for low, high in layout.joint_pos_limits.tolist()]
    by_joint = per_joint(env, drives)
    found: Robot = {
        "format_version": FORMAT_VERSION,
        "step_dt": env.step_dt,
        "physics_dt": env.physics_dt,
        "decimation": env.decimation,
        "robot_profile": robot.options.profile,
        "joint_names": list(robot.joint_names),
        "default_joint_pos": layout.default_joint_pos.tolist(),
        "default_joint_vel": layout.default_joint_vel.tolist(),
        "joint_pos_limits": limits,
        "rolling_joints": [robot.joint_names[i] for i in _rolling(limits, by_joint["stiffness"], actions)],
        **by_joint,
        "readings": {
            name: {"width": known.of(env).shape[1], "unit": known.unit, "meaning": known.meaning}
            for name, known in ((name, reading(name)) for name in names)
        },
        "commands": {name: dict(ranges.get(name, {})) for name in commands},
        "command_accelerations": _accelerations(env, commands),
        "bump": bump_spec(env, groups, commands),
        "observation_width": sum(
            int(term["width"]) * max(1, int(term["history_length"])) for group in groups for term in group["terms"]
        ),
        "observations": groups,
        "action_width": env.action_manager.total_action_dim,
        "clip_actions": agent.get("clip_actions"),
        "actions": actions,
        "actuators": drives,
        "imus": _imus(env, names),
        "root": {
            "body": robot.body_names[0],
            "floating": robot.floating,
            "pos": layout.default_root_pos.tolist(),
            "quat": layout.default_root_quat.tolist(),
        },
    }
    return {**found, "safety": safety(env, found)}


# ``policy_step`` of the C header returns ``not_finite``; ``update`` returns the other codes.
STATUS = {"ok": 0, "not_finite": 1, "held": 2, "late": 3, "fallen": 4, "stopped": 5, "starting": 6}
_FALL_ANGLE = 1.0  # rad, if no termination of the task has a limit angle
_MOST = {"ang_vel": 35.0, "lin_acc": 157.0}  # rad/s and m/s²: gyroscopes of 2000 °/s and accelerometers of 16 g
_STILL, _SLOW = {"ang_vel": 0.2, "joint_vel": 0.5}, {"ang_vel": 4.0, "joint_vel": 20.0}  # rad/s
_POSITION_MARGIN, _VELOCITY_FACTOR = 0.2, 2.0  # rad beyond the joint limits; times the velocity or effort limit


def safety(env: ManagerBasedRLEnv, spec: Robot) -> policy_json.Safety:
    """Return the section ``safety`` of ``policy.json``, with one value per component of a reading; null: no bound."""
    angles = [node["limit_angle"] for node in env.cfg["terminations"].values() if node and "limit_angle" in node]
    angle, fall = min(angles, default=_FALL_ANGLE), _upright(spec)
    return {
        "status": STATUS,
        "rate_hz": 1 / spec["step_dt"],
        "hold_steps": 3,
        "missed_steps": 3,
        "stale_s": 2.5 * spec["step_dt"],
        "readings": {name: _plausible(name, spec) for name in spec["readings"]},
        "fall": None if fall is None else {**fall, "angle": angle, "steps": 3},
        "stop": {"position": spec["default_joint_pos"], "gain": 0.2, "ramp_s": 0.5},
        "recover": {"angle": min(0.35, angle / 2), "stopped_s": 0.03, "fallen_s": 1.0, "gain_ramp_s": 0.1},
        "start": {"rest_s": 1.0, "lift_s": 2.0, "upright_s": 0.5},
    }


def _upright(spec: Robot) -> policy_json.Upright | None:
    """Return the reading that shows the base's tilt, and its value when the base is upright; None without such one."""
    if "projected_gravity" in spec["readings"] and spec["root"]["floating"]:
        return {"reading": "projected_gravity", "upright": [0.0, 0.0, -1.0]}
    for name, imu in spec["imus"].items():
        if imu["body"] == spec["root"]["body"] and f"{name}.projected_gravity" in spec["readings"]:
            return {"reading": f"{name}.projected_gravity", "upright": projected_gravity(imu["quat"]).tolist()}
    return None


def _plausible(name: str, spec: Robot) -> policy_json.Rule:
    """Return the checks of one reading: its kind, its bounds, its largest jump in a control step, and slow values."""
    width, kind = spec["readings"][name]["width"], name.rpartition(".")[2].removeprefix("base_")
    speeds = spec["velocity_limit"]
    rule: policy_json.Rule = {
        "check": "bounds",
        "low": [None] * width,
        "max_jump": [None] * width,
        "high": [_MOST.get(kind)] * width,
        "still": _STILL.get(kind),
        "slow": _SLOW.get(kind),
    }
    if name == "joint_pos":
        rule["check"] = "encoder"
        low, high = zip(*spec["joint_pos_limits"], strict=True)
        rule["low"] = [None if bound is None else bound - _POSITION_MARGIN for bound in low]
        rule["high"] = [None if bound is None else bound + _POSITION_MARGIN for bound in high]
        rule["max_jump"] = [speed and _VELOCITY_FACTOR * speed * spec["step_dt"] for speed in speeds]
        return rule
    if name in ("joint_vel", "joint_effort"):
        limits = speeds if name == "joint_vel" else spec["effort_limit"]
        rule["high"] = [limit and _VELOCITY_FACTOR * limit for limit in limits]
    elif name.startswith(COMMANDS):
        ranges = list(spec["commands"][name.removeprefix(COMMANDS)].values())
        if len(ranges) == width:  # 0 is always allowed, because a lost command becomes 0.
            rule["low"], rule["high"] = [min(0.0, *pair) for pair in ranges], [max(0.0, *pair) for pair in ranges]
        rule["check"] = "command"
        return rule
    elif kind in ("projected_gravity", "quat"):
        rule["check"], rule["norm"] = "unit_vector", [0.5, 1.5]
        if kind == "projected_gravity":  # Gravity turns in the base's axes at most as fast as the gyroscope can show.
            rule["max_jump"] = [_MOST["ang_vel"] * spec["step_dt"]] * width
    rule["low"] = [None if high is None else -high for high in rule["high"]]
    return rule


def _rolling(limits: list[Limits], stiffness: Limits, actions: list[ActionTerm]) -> list[int]:
    """Return the wheels, whose positions count from the reset: joints without limits and without absolute targets."""
    driven = {i: term["function"] for term in actions if term["drives"] == "position" for i in term["joint_ids"]}
    free = [i for i, pair in enumerate(limits) if pair == [None, None]]
    return [i for i in free if driven.get(i, "absolute" if stiffness[i] else "relative") == "relative"]


def _accelerations(env: ManagerBasedRLEnv, commands: list[str]) -> dict[str, Limits]:
    """Return the acceleration limits of the commands, m/s² and rad/s², without commands that have no limits."""
    found = {}
    for name in commands:
        most = getattr(env.command_manager.get_term(name), "max_acceleration", None)
        if most is not None and any(limit is not None for limit in most):
            found[name] = list(most)
    return found


def bump_spec(
    env: ManagerBasedRLEnv, groups: list[policy_json.ObservationGroup], commands: list[str]
) -> policy_json.Bump | None:
    """Return the bump trigger of the first jump command; None unless the policy observes the command's travel error."""
    terms = {name: env.command_manager.get_term(name) for name in commands}
    travels = {term["command"]: term for group in groups for term in group["terms"] if "wheel_radius" in term}
    for name, term in terms.items():
        if isinstance(term, JumpCommand) and (travel := travels.get(f"{COMMANDS}{term.velocity_command}")):
            return {
                "on": term.trigger == "bump",
                "jump": COMMANDS + name,
                "velocity": travel["command"],
                "columns": travel["columns"],
                "signs": travel["signs"],
                "wheel_radius": travel["wheel_radius"],
                "max_acceleration": _accelerations(env, commands).get(str(term.velocity_command), [None] * 3),
                "settings": {"window_s": term.window_s, "height": term.highest, **vars(term.bump_settings)},
            }
    return None


def _imus(env: ManagerBasedRLEnv, readings: list[str]) -> dict[str, policy_json.Imu]:
    """Return the pose of each IMU whose readings the policy observes."""
    found: dict[str, policy_json.Imu] = {}
    for name, sensor in env.scene.sensors.items():
        if isinstance(sensor, Imu) and any(reading.rpartition(".")[0] == name for reading in readings):
            pos, quat = sensor._offset_pos.tolist(), sensor._offset_quat.tolist()
            found[name] = {"body": sensor.body_names[0], "pos": pos, "quat": quat}
    return found
