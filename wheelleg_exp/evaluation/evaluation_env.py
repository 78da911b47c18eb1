"""Build the environment of a task for an evaluation, and find wheels and mirrored joints by geometry, not by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from wheelleg_exp.anatomy.compiled_robot import at_default
from wheelleg_exp.anatomy.robot_anatomy import anatomy_of
from wheelleg_exp.constraints import Node
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.realism import without_pushes, without_realism
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.evaluation.protocol_options import Ground, Protocol
from wheelleg_exp.managers import Env
from wheelleg_exp.sim.options import EnvOptions

FRICTION = ("static_friction", "dynamic_friction", "restitution")
CONTACTS = "evaluation_contacts"
_CONTACTS = {"_target_": "wheelleg_exp.sim.sensors.ContactSensor", "body_names": [".*"]}
_MOST_CONTACTS = 8  # A wheel on rough ground has at most 8 contacts.


def evaluation_options(
    env: EnvOptions, protocol: Protocol, num_envs: int, horizon_s: float, ground: Ground
) -> EnvOptions:
    """Return the options of a task's environment with the changes that an evaluation needs.

    Time-outs, events within an episode, rewards, curricula, and recorders are removed. Commands, failure terminations,
    and events at startup and reset remain.
    """
    env = without_pushes(env if protocol.realism == "own" else without_realism(env))
    if protocol.command not in env.commands:
        expected = "one of " + (", ".join(env.commands) or "(there are none)")
        message, nearest = f"the task has no command '{protocol.command}'", nearest_name(protocol.command, env.commands)
        raise ConfigError(message, key="protocol.command", expected=expected, nearest=nearest)
    sensors = dict(env.scene.sensors)
    if contact_sensor(sensors) is None:
        options = {"history_length": 1, "track_air_time": False, "max_contacts": _MOST_CONTACTS}
        sensors[CONTACTS] = {**_CONTACTS, **options, "force_threshold": protocol.contact_force}
    terrain = env.scene.terrain
    if ground == "flat":
        terrain = {"_target_": "wheelleg_exp.sim.terrain.Plane", **{name: terrain[name] for name in FRICTION}}
    return replace(
        env,
        num_envs=num_envs,
        episode_length_s=horizon_s,
        scene=replace(env.scene, terrain=terrain, sensors=sensors),
        # Every robot of an evaluation has errors, and late actions.
        realism=replace(env.realism, exact_share=0.0, actions=replace(env.realism.actions, prompt_share=0.0)),
        # Remove the time-out term, because the evaluation protocol defines the episode length.
        terminations={name: node for name, node in env.terminations.items() if not node.get("time_out")},
        rewards={},
        curriculum={},
        recorders={},
    )


def contact_sensor(sensors: Mapping[str, Node | None]) -> str | None:
    """Return the name of a contact sensor on every body of the robot, or None if the scene has no such sensor."""
    return next((n for n, node in sensors.items() if node and node.items() >= _CONTACTS.items()), None)


def on_ground(env: EnvOptions, terrain: Node) -> EnvOptions:
    """Return the options of the environment with another terrain."""
    return replace(env, scene=replace(env.scene, terrain=terrain))


def build(options: EnvOptions, mjcf: Path, seed: int) -> ManagerBasedRLEnv:
    """Build an environment without a reset at an episode's end. Raise ConfigError for a robot with a fixed base."""
    env = ManagerBasedRLEnv(options, mjcf, seed)
    env.autoreset = "disabled"
    if not env.scene.robot.floating:
        message = "only robots with a floating base can be evaluated"
        raise ConfigError(message, key="env.robot.base", expected="floating")
    return env


def target_heights(env: EnvOptions) -> dict[str, Node]:
    """Return the parameter ``target_height`` of the reward terms that have it, by the name of the term."""
    nodes = {name: node for name, node in env.rewards.items() if node.get("target_height") is not None}
    return {name: {"target_height": node["target_height"]} for name, node in nodes.items()}


@dataclass(frozen=True)
class RobotParts:
    """The joints and physical properties of a robot that metrics use. Integer tensors contain joint indices.

    ``wheels`` (W,) are the joints of driven wheels that carry the robot, and ``wheel_radius`` (W,) are their radii, m.
    ``contacts`` is the name of a contact sensor on every body; ``wheel_bodies`` (W,) are body indices in its data and
    in the robot's data; ``wheel_links`` (W, L) also has the links fixed to them, such as tires, and fills shorter rows
    with repetitions. ``wheel_offsets`` (W,) are the wheels' y coordinates in the base's axes, m; None if the robot
    has no forward direction. ``left`` (P,) and ``right`` (P,) are driven leg joints: the image of ``left`` at q is
    ``right`` at ``sign`` · q. ``groups`` maps each actuator group to its joints. ``effort_limit`` (N, J), N·m, is inf
    for a joint without a limit. ``mass`` is in kg, ``gravity`` in m/s².
    """

    joint_names: tuple[str, ...]
    wheels: torch.Tensor
    contacts: str
    wheel_bodies: torch.Tensor
    wheel_links: torch.Tensor
    wheel_radius: torch.Tensor
    wheel_offsets: torch.Tensor | None
    left: torch.Tensor
    right: torch.Tensor
    sign: torch.Tensor
    groups: dict[str, torch.Tensor]
    effort_limit: torch.Tensor
    mass: float
    gravity: float


def parts_of(env: Env) -> RobotParts:
    """Return the ``RobotParts`` of an environment's robot, computed at its default pose."""
    robot, model, device = env.scene.robot, env.scene.model, env.device
    names = robot.joint_names
    driven = [name for actuator in robot.actuators.values() for name in actuator.joint_names]
    anatomy = anatomy_of(model, at_default(model, robot).qpos, driven)
    wheels = [wheel for wheel in anatomy.standing if wheel.driven and wheel.joint in names]
    legs = {*driven} - {wheel.joint for wheel in anatomy.wheels}
    pairs = [p for p in anatomy.mirrored if p.left != p.right and p.left in legs and p.right in driven]
    contacts = contact_sensor(env.options.scene.sensors)
    assert contacts is not None  # ``evaluation_options`` added a contact sensor.
    bodies, most = env.scene[contacts].body_names, max((len(wheel.bodies) for wheel in wheels), default=0)

    def indices(found: Sequence[object]) -> torch.Tensor:
        return torch.tensor(found, dtype=torch.long, device=device)

    offsets = None
    if anatomy.forward is not None:
        left = np.cross(anatomy.up, anatomy.forward)
        offsets = torch.tensor([float(left @ np.array(wheel.contact)) for wheel in wheels], device=device)
    groups = {name: indices([names.index(j) for j in drive.joint_names]) for name, drive in robot.actuators.items()}
    return RobotParts(
        joint_names=tuple(names),
        wheels=indices([names.index(wheel.joint) for wheel in wheels]),
        contacts=contacts,
        wheel_bodies=indices([bodies.index(wheel.body) for wheel in wheels]),
        wheel_links=indices([[*map(bodies.index, w.bodies[:1] * (most - len(w.bodies)) + w.bodies)] for w in wheels]),
        wheel_radius=torch.tensor([wheel.radius for wheel in wheels], device=device),
        wheel_offsets=offsets,
        left=indices([names.index(pair.left) for pair in pairs]),
        right=indices([names.index(pair.right) for pair in pairs]),
        sign=torch.tensor([float(pair.sign) for pair in pairs], device=device),
        groups=groups,
        effort_limit=robot.data.joint_effort_limits.clone(),
        mass=float(model.body_mass[robot.body_ids.tolist()].sum()),
        gravity=float(sum(g * g for g in model.opt.gravity) ** 0.5),
    )
