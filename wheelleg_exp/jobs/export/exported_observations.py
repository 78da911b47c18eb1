"""Describe observation terms and sensor readings for the exported ``runner.py``; reject unsupported terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import FunctionType
from typing import Any, TypedDict, cast

import torch

from wheelleg_exp.constraints import Node
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.export.policy_json import Modifier, ObservationGroup, ObservationTerm, TermValue
from wheelleg_exp.managers import SceneEntityCfg, Term, observation_term
from wheelleg_exp.mdp import modifiers
from wheelleg_exp.mdp import observations as obs
from wheelleg_exp.mdp.commands import UniformVelocityTravelCommand
from wheelleg_exp.terms.term_binding import TARGET

COMMANDS = "commands."


@dataclass(frozen=True)
class Reading:
    """A sensor reading: its unit, its meaning, and a function that returns it from a simulation, (N, width)."""

    unit: str
    meaning: str
    of: Callable[[ManagerBasedRLEnv], torch.Tensor]


READINGS = {
    "base_ang_vel": Reading("rad/s", "angular velocity of the base in its own axes: a gyroscope", obs.base_ang_vel),
    "projected_gravity": Reading(
        "1",
        "unit vector of gravity in the base's axes, upright (0, 0, -1); base_quat (w, x, y, z) may stand for it",
        obs.projected_gravity,
    ),
    "base_quat": Reading("1", "orientation of the base in the world (w, x, y, z)", obs.root_quat_w),
    "base_lin_vel": Reading(
        "m/s", "velocity of the base's centre of mass in its own axes: an estimate", obs.base_lin_vel
    ),
    "base_height": Reading("m", "height of the base above the ground below it: an estimate", obs.base_height),
    "joint_pos": Reading("rad", "joint positions, in the order of joint_names: encoders", obs.joint_pos),
    "joint_vel": Reading("rad/s", "joint velocities, in the order of joint_names", obs.joint_vel),
    "joint_effort": Reading("N·m", "torques of the drives, in the order of joint_names", obs.joint_effort_commanded),
}

# ``QUANTITIES`` maps each IMU quantity to its unit, its meaning, and its attribute in the simulated IMU's data.
QUANTITIES = {
    "ang_vel": ("rad/s", "angular velocity in its own axes", "ang_vel_b"),
    "lin_acc": ("m/s^2", "acceleration in its own axes; at rest it reads gravity upwards", "lin_acc_b"),
    "projected_gravity": ("1", "unit vector of gravity in its own axes", "projected_gravity_b"),
    "quat": ("1", "orientation in the world (w, x, y, z)", "quat_w"),
}


def reading(name: str) -> Reading:
    """Return unit, meaning, and simulation function of a sensor reading or command, such as ``base_quat``."""
    if name in READINGS:
        return READINGS[name]
    if not name.startswith(COMMANDS):
        sensor, _, quantity = name.rpartition(".")
        unit, meaning, attribute = QUANTITIES[quantity]
        text = f"of the IMU '{sensor}': {meaning}"
        return Reading(unit, text, lambda env: getattr(env.scene[sensor].data, attribute))
    term = name.removeprefix(COMMANDS)
    meaning = f"the command '{term}'; commands.{term} lists its components and ranges"
    return Reading("m/s, rad/s", meaning, lambda env: env.command_manager.get_command(term))


class Scaled(TypedDict, total=False):
    """The factors of an observation term, if it has any."""

    scale: list[float]


_ROBOT = SceneEntityCfg("robot")
_IMU = SceneEntityCfg("imu")  # the IMU that observation terms read by default


def observation_specs(env: ManagerBasedRLEnv, groups: list[str]) -> list[ObservationGroup]:
    """Return a description of a policy's observation groups and of the groups' terms, in order."""
    found: list[ObservationGroup] = []
    for group in groups:
        node = env.cfg["observations"][group]
        terms = env.observation_manager.terms(group)
        specs = [_term(env, node["terms"][name], term) for name, term in terms.items()]
        found.append({"name": group, "history_order": node.get("history_order", "term"), "terms": specs})
    return found


def readings_of(groups: list[ObservationGroup]) -> list[str]:
    """Return the names of the sensor readings that observation terms need; ``joint_pos`` is always one of them."""
    names: list[str] = []
    for term in (term for group in groups for term in group["terms"]):
        names += [term["reading"]] if "reading" in term else term.get("needs", [])
    return list(dict.fromkeys([*names, "joint_pos"]))


def _term(env: ManagerBasedRLEnv, node: Mapping[str, Any], term: observation_term.ObservationTerm) -> ObservationTerm:
    bound, fields = term.term, term.term.fields
    known = _KNOWN.get(bound.func) or _KNOWN.get(type(bound.func))
    if known is None:
        message = f"a runner without the simulation cannot work out '{bound.target}'"
        expected = "one of " + ", ".join(
            sorted(function.__name__ for function in _KNOWN if isinstance(function, (type, FunctionType)))
        )
        raise ConfigError(message, key=bound.path, expected=expected)
    clip, scale = fields.get("clip"), fields.get("scale")
    parts = [part for name, part in term.parts().items() if name != "noise"]
    scales: Scaled = {}
    if scale is not None:
        scales = {"scale": [float(scale)] * term.width if isinstance(scale, (int, float)) else [*map(float, scale)]}
    # The exported ``runner.py`` adds no noise, because the sensors of a real robot have noise.
    noise = node.get("noise") if env.cfg["observations"][bound.path.split(".")[2]].get("enable_corruption") else None
    return {
        "name": bound.name,
        **known(env, bound),
        "width": term.width,
        "history_length": term.history_length,
        "modifiers": [
            _modifier(modifier, part, f"{bound.path}.modifiers[{number}]")
            for number, (modifier, part) in enumerate(zip(node.get("modifiers") or [], parts, strict=True))
        ],
        "clip": None if clip is None else [float(clip[0]), float(clip[1])],
        **scales,
        "trained_with": {"noise": noise, "delay_steps": node.get("delay")},
    }


def _modifier(node: Node, part: object, path: str) -> Modifier:
    kinds: dict[type[object], str] = {modifiers.Scale: "scale", modifiers.Bias: "bias", modifiers.Clip: "clip"}
    kinds |= {modifiers.DigitalFilter: "filter", modifiers.Integrator: "integrator"}
    if type(part) not in kinds:
        message = f"a runner does not know the modifier '{node[TARGET]}'"
        raise ConfigError(message, key=path, expected="one of " + ", ".join(kind.__name__ for kind in kinds))
    settings = {name: value for name, value in node.items() if name != TARGET}
    return cast("Modifier", {"kind": kinds[type(part)], **settings})


def _of_joints(env: ManagerBasedRLEnv, term: Term, name: str) -> tuple[list[int], list[str]]:
    if term.params.get("measured") is False and name == "joint_pos":
        message = "the term shows joint positions that encoders do not measure"
        raise ConfigError(message, key=term.path, expected="measured: true")
    return _joints(env, term.params.get("asset_cfg", _ROBOT).joint_ids)


def _joints(env: ManagerBasedRLEnv, chosen: slice | torch.Tensor | Sequence[int]) -> tuple[list[int], list[str]]:
    """Return the columns and the names of the joints that a slice or a tensor of indices selects."""
    names = env.scene.robot.joint_names
    ids = torch.arange(len(names))[chosen].tolist()
    return ids, [names[i] for i in ids]


def _reading(name: str, function: str = "reading") -> TermValue:
    return {"function": function, "reading": name}


def _plain(name: str, function: str = "reading") -> Callable[[ManagerBasedRLEnv, Term], TermValue]:
    return lambda _env, _term: _reading(name, function)


def _of_imu(quantity: str) -> Callable[[ManagerBasedRLEnv, Term], TermValue]:
    return lambda _env, term: _reading(f"{term.params.get('asset_cfg', _IMU).name}.{quantity}")


def _joint_values(name: str, function: str = "reading") -> Callable[[ManagerBasedRLEnv, Term], TermValue]:
    def spec(env: ManagerBasedRLEnv, term: Term) -> TermValue:
        columns, names = _of_joints(env, term, name)
        return {"function": function, "reading": name, "columns": columns, "joint_names": names}

    return spec


def _minus_default(name: str, default: str) -> Callable[[ManagerBasedRLEnv, Term], TermValue]:
    def spec(env: ManagerBasedRLEnv, term: Term) -> TermValue:
        found = _joint_values(name, "minus_default")(env, term)
        return {**found, "subtract": getattr(env.scene.robot.layout, default)[found["columns"]].tolist()}

    return spec


def _within_limits(env: ManagerBasedRLEnv, term: Term) -> TermValue:
    function: Any = term.func
    columns, names = _joints(env, function._ids)
    low, high = env.scene.robot.layout.soft_joint_pos_limits[columns].unbind(dim=1)
    return {
        "function": "within_limits",
        "reading": "joint_pos",
        "columns": columns,
        "joint_names": names,
        "middle": ((low + high) / 2).tolist(),
        "range": (high - low).tolist(),
    }


def _travel_error(env: ManagerBasedRLEnv, term: Term) -> TermValue:
    name = term.params["command_name"]
    command: Any = env.command_manager.get_term(name)
    if type(command) is not UniformVelocityTravelCommand:
        message = f"a runner does not know how a '{type(command).__name__}' sums up its error"
        raise ConfigError(message, key=term.path, expected="a UniformVelocityTravelCommand")
    most = command._most.tolist()
    columns, names = _joints(env, command._wheel_ids)
    return {
        "function": "travel_error",
        "needs": ["joint_vel", "base_ang_vel", f"{COMMANDS}{name}"],
        "columns": columns,
        "joint_names": names,
        "command": f"{COMMANDS}{name}",
        "signs": list(command.wheel_signs),
        "wheel_radius": command._radius,
        "max_travel_error": most[0],
        "max_heading_error": most[1],
    }


_MOST_LINKS = 16  # joints between a wheel and the base, so that a runner's time is bounded


def _height_error(env: ManagerBasedRLEnv, term: Term) -> TermValue:
    name = term.params["command_name"]
    command: Any = env.command_manager.get_term(name)
    legs = command.height_over_wheels
    if len(legs.links) > _MOST_LINKS:
        raise ConfigError("a leg has too many joints for a runner", key=term.path, expected=f"at most {_MOST_LINKS}")
    return {
        "function": "height_error",
        "needs": ["joint_pos", "projected_gravity", f"{COMMANDS}{name}"],
        "command": f"{COMMANDS}{name}",
        "centres": legs.centres.tolist(),
        "links": [{key: value.tolist() for key, value in link._asdict().items()} for link in legs.links],
        "wheel_radius": legs.radius,
        "max_height_error": command.max_height_error,
    }


def _last_action(env: ManagerBasedRLEnv, term: Term) -> TermValue:
    manager, chosen = env.action_manager, term.params.get("action_name")
    start, columns = 0, {}
    for name, width in zip(manager.active_terms, manager.action_term_dim, strict=True):
        columns[name] = list(range(start, start + width))
        start += width
    return {"function": "last_action", "columns": list(range(start)) if chosen is None else columns[chosen]}


_KNOWN: dict[object, Callable[[ManagerBasedRLEnv, Term], TermValue]] = {
    obs.base_ang_vel: _plain("base_ang_vel"),
    obs.base_lin_vel: _plain("base_lin_vel"),
    obs.base_height: _plain("base_height"),
    obs.projected_gravity: _plain("projected_gravity"),
    obs.base_roll_pitch: _plain("projected_gravity", "roll_pitch"),
    obs.joint_pos: _joint_values("joint_pos"),
    obs.joint_pos_rel: _minus_default("joint_pos", "default_joint_pos"),
    obs.joint_pos_sin_cos: _joint_values("joint_pos", "sin_cos"),
    obs.joint_pos_limit_normalized: _within_limits,
    obs.joint_vel: _joint_values("joint_vel"),
    obs.joint_vel_rel: _minus_default("joint_vel", "default_joint_vel"),
    obs.joint_effort_commanded: _joint_values("joint_effort"),
    obs.imu_ang_vel: _of_imu("ang_vel"),
    obs.imu_lin_acc: _of_imu("lin_acc"),
    obs.imu_projected_gravity: _of_imu("projected_gravity"),
    obs.imu_orientation: _of_imu("quat"),
    obs.generated_commands: lambda _env, term: _reading(f"{COMMANDS}{term.params['command_name']}"),
    obs.last_action: _last_action,
    obs.travel_error: _travel_error,
    obs.height_error: _height_error,
    obs.current_time_s: lambda _env, _term: {"function": "time"},
    obs.remaining_time_s: lambda env, _: {"function": "remaining_time", "episode_length_s": env.max_episode_length_s},
    obs.gait_phase: lambda _env, term: {
        "function": "gait_phase",
        "period": term.params["period"],
        "offsets": list(term.params.get("offsets", (0.0,))),
    },
}
