"""Define how each kind of observation changes when the base's x-z plane is a mirror."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError, not_one_of
from wheelleg_exp.managers.observation_term import ObservationTerm
from wheelleg_exp.managers.term_interface import Ids, SceneEntityCfg
from wheelleg_exp.rl.mirror_pairs import MIRROR, BodyImages
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.sensors import Imu, RayCaster

RULES_KEY = "agent.symmetry.terms"
# ``SIGNS`` contains left-right mirror rules for observations with a fixed number of values: one sign per value.
SIGNS: Mapping[str, tuple[float, ...]] = {
    "vector": (1, -1, 1),  # velocity, acceleration, force, gravity
    "pseudovector": (-1, 1, -1),  # angular velocity, torque
    "planar_velocity": (1, -1, -1),  # vx, vy, yaw rate
    "quaternion": (1, -1, 1, -1),
    "roll_pitch": (-1, 1),
    "travel": (1, -1),  # forwards, rotation
    "place": (1, -1, 1, -1),  # displacement and rotation
    "base_pose": (1, -1, 1),  # height, roll, pitch
    "pose": (1, -1, 1, 1, -1, 1, -1),  # position and quaternion
}
# ``FREE_WIDTH_RULES`` names the mirror rules that fit observations with any number of values.
FREE_WIDTH_RULES = ("invariant", "joints", "joints_sin_cos", "actions", "phases", "rays")
# Each rule in ``BODY_RULES`` mirrors an observation of bodies, with one sign for each number of a body.
# An entry of ``BODY_RULES`` is (signs, parameter that selects bodies, whether bodies need mirrored axes).
BODY_RULES: Mapping[str, tuple[tuple[float, ...], str, bool]] = {
    "sensed_bodies": ((1,), "sensor_cfg", False),
    "sensed_body_vectors": ((1, -1, 1), "sensor_cfg", False),
    "bodies": ((1,), "asset_cfg", False),
    "body_vectors": ((1, -1, 1), "asset_cfg", True),
    "body_poses": ((1, -1, 1, 1, -1, 1, -1), "asset_cfg", True),
}
# ``IMU_RULES`` contains left-right mirror rules for measurements of an IMU, expressed in the IMU's axes.
IMU_RULES = {f"imu_{kind}": kind for kind in ("vector", "pseudovector", "quaternion")}
COMMAND_RULE = "command"  # The rule ``command`` mirrors an observed command by the mirror rule of its class.
RULE_NAMES = (*SIGNS, *FREE_WIDTH_RULES, *BODY_RULES, *IMU_RULES)

OBSERVATIONS = "wheelleg_exp.mdp.observations"
# For each mirror rule, ``_NAMES_BY_RULE`` lists the built-in observations to which the rule applies.
_NAMES_BY_RULE = {
    "vector": ("base_lin_vel", "root_link_lin_vel", "projected_gravity", "root_pos_w", "root_lin_vel_w"),
    "pseudovector": ("base_ang_vel", "root_ang_vel_w"),
    "quaternion": ("root_quat_w",),
    "roll_pitch": ("base_roll_pitch",),
    "invariant": ("base_pos_z", "base_height", "height_error", "current_time_s", "remaining_time_s"),
    "joints": (
        *("joint_pos", "joint_pos_rel", "joint_pos_limit_normalized", "joint_vel", "joint_vel_rel", "joint_acc"),
        *("joint_effort", "joint_effort_commanded"),
    ),
    "joints_sin_cos": ("joint_pos_sin_cos",),
    "actions": ("last_action",),
    COMMAND_RULE: ("generated_commands",),
    "travel": ("travel_error",),
    "phases": ("gait_phase",),
    "rays": ("height_scan",),
    "imu_quaternion": ("imu_orientation",),
    "imu_vector": ("imu_projected_gravity", "imu_lin_acc"),
    "imu_pseudovector": ("imu_ang_vel",),
    "sensed_bodies": ("body_contacts", "body_air_time"),
    "sensed_body_vectors": ("body_contact_forces",),
    "body_poses": ("body_pose_w",),
    "body_vectors": ("body_projected_gravity_b",),
}
TERM_RULES: Mapping[str, str] = {name: rule for rule, names in _NAMES_BY_RULE.items() for name in names}
# ``COMMAND_RULES`` maps each class of built-in commands to the rule for a command's left-right mirror image.
COMMAND_RULES: Mapping[str, str] = {
    "UniformVelocityCommand": "planar_velocity",
    "UniformVelocityTravelCommand": "planar_velocity",
    "NormalVelocityCommand": "planar_velocity",
    "UniformPose2dCommand": "place",
    "UniformBasePoseCommand": "base_pose",
    "WheeledBasePoseCommand": "base_pose",
    "UniformPoseCommand": "pose",
    "JumpCommand": "invariant",
    "NullCommand": "invariant",
}


def unknown_rule_error(rule: str, term: str) -> ConfigError:
    """Return the error for an unknown name of a mirror rule in ``agent.symmetry.terms``."""
    return not_one_of(f"'{rule}' is not a mirror rule", rule, RULE_NAMES, key=f"{RULES_KEY}.{term}")


SignedSources = list[tuple[int, float]]
_Item = TypeVar("_Item")
_MAX_OFFSET = 1e-4  # m
_MAX_SIGN_ERROR = 1e-3


def mirror_rays(sensor: object, bodies: BodyImages, path: str) -> SignedSources:
    """Return the image of each ray: from the mirrored position in the mirrored direction, or raise ConfigError."""
    if not isinstance(sensor, RayCaster):
        raise ConfigError("the sensor is not a ray caster", key=f"{path}.sensor_cfg.name", expected="a RayCaster")
    _require_own_image(sensor.body_names[0], bodies, f"{sensor.key}.body_name")
    flip = torch.tensor([1.0, -1.0, 1.0], device=sensor.device)
    found = torch.cat([part.expand(sensor.num_rays, 3) for part in sensor.rays], dim=1)
    distance, source = torch.cdist(found * flip.repeat(2), found).min(dim=1)
    if float(distance.max()) > _MAX_OFFSET:
        expected = "an offset on the base's middle, and a pattern with a ray to the right for each to the left"
        raise ConfigError("the sensor's rays are not left-right symmetric", key=sensor.key, expected=expected)
    return [(int(number), 1.0) for number in source]


def mirror_imu(sensor: object, kind: str, bodies: BodyImages, path: str) -> SignedSources:
    """Return the left-right mirror rule of an IMU's measurement, which is a vector, pseudovector, or quaternion.

    The mirror M turns a measured vector v into R^T M R v, and a pseudovector v into -R^T M R v; R rotates the IMU's
    axes to its body's axes. The matrix R^T M R must contain only -1, 0, and 1, so that a mirror only swaps or negates
    measured numbers. ``mirror_imu`` raises ConfigError unless ``sensor`` is an IMU in the robot's plane of symmetry.
    """
    if not isinstance(sensor, Imu):
        raise ConfigError("the observed sensor is not an IMU", key=f"{path}.asset_cfg.name", expected="an Imu")
    _require_own_image(sensor.body_names[0], bodies, f"{sensor.key}.body_name")
    pos, quat = sensor.offset_pose
    turn = rotation.quat_to_matrix(quat.unsqueeze(0))[0].double().cpu().numpy()
    if abs(float(pos[1])) > _MAX_OFFSET:
        raise ConfigError("the IMU is not in the base's x-z plane", key=f"{sensor.key}.offset.pos", expected="y = 0")
    mirrored = turn.T @ MIRROR @ turn
    signs = np.round(mirrored)
    if np.abs(mirrored - signs).max() > _MAX_SIGN_ERROR or (kind == "quaternion" and np.abs(signs - MIRROR).max() > 0):
        expected = "axes along the body's" if kind != "quaternion" else "a turn about y, or none"
        message = "the IMU's axes are not their own mirror image"
        raise ConfigError(message, key=f"{sensor.key}.offset.rot", expected=expected)
    if kind == "quaternion":
        return [(0, 1.0), (1, -1.0), (2, 1.0), (3, -1.0)]
    sign = -1.0 if kind == "pseudovector" else 1.0
    sources = np.abs(signs).argmax(axis=1)
    return [(int(source), sign * float(signs[i, source])) for i, source in enumerate(sources)]


def _require_own_image(name: str, bodies: BodyImages, key: str) -> None:
    image = bodies.image(name, key, with_axes=True)
    if image != name:
        message = f"the sensor is mounted on '{name}', whose image is '{image}'"
        raise ConfigError(message, key=key, expected="a body in the middle of the robot")


Rule = str | Sequence[float]
_MAX_PHASE_ERROR = 1e-6  # of a cycle
_OFFSETS = (
    "offsets of both sides, such as [0.0, 0.5]; or agent.symmetry.terms with 'invariant' for legs that move together, "
    "or a list of a sign for each number"
)


class TermMirror:
    """Applies mirror rules (how an observation term changes in a mirror image) to observation terms.

    ``joint_images`` and ``joint_signs`` contain the index of each joint's image, and -1 if its position changes the
    sign, else 1. If ``action[i]`` is ``(j, sign)``, the mirrored action i is ``sign`` times the action j.
    """

    def __init__(
        self, env: ManagerBasedRLEnv, joint_images: Sequence[int], joint_signs: Sequence[float], action: SignedSources
    ) -> None:
        self._env, self._images, self._signs, self._action = env, list(joint_images), list(joint_signs), action
        robot = env.scene.robot
        self._bodies = BodyImages(env.scene.model, robot.body_names, robot.joint_names, joint_images)

    def frame(self, rule: Rule, term: ObservationTerm) -> SignedSources:
        """Return ``(source, sign)`` for each mirrored value of an observation: ``sign`` times the value ``source``."""
        path = term.term.path
        if not isinstance(rule, str) or rule in SIGNS:
            return [(i, float(sign)) for i, sign in enumerate(SIGNS[rule] if isinstance(rule, str) else rule)]
        if rule == "invariant":
            return [(i, 1.0) for i in range(term.width)]
        if rule == "phases":
            # In an alternating gait, a mirror shifts the phase by half a cycle, which negates sine and cosine.
            offsets = [float(offset) % 1.0 for offset in term.term.params.get("offsets", (0.0,))]
            for offset in offsets:
                if min(abs((offset + 0.5 - o + 0.5) % 1.0 - 0.5) for o in offsets) > _MAX_PHASE_ERROR:
                    message = f"the clock at {offset:g} of the cycle has no counterpart half a cycle later"
                    raise ConfigError(message, key=f"{path}.offsets", expected=_OFFSETS)
            return [(i, -1.0) for i in range(term.width)]
        if rule == "actions":
            manager, name = self._env.action_manager, term.term.params.get("action_name")
            if name is None:
                return self._action
            start = sum(manager.action_term_dim[: manager.active_terms.index(name)])
            part = self._action[start : start + manager.get_term(name).action_dim]
            return [(source - start, sign) for source, sign in part]
        if rule in BODY_RULES:
            return self._bodies_of(rule, term, path)
        if rule == "rays":
            return mirror_rays(self._env.scene[self._entity(term, "sensor_cfg").name], self._bodies, path)
        if rule in IMU_RULES:
            sensor = self._env.scene[self._entity(term, "asset_cfg").name]
            return mirror_imu(sensor, IMU_RULES[rule], self._bodies, path)
        entity = term.term.params.get("asset_cfg")
        names = self._env.scene.robot.joint_names
        ids = _chosen(getattr(entity, "joint_ids", slice(None)), list(range(len(names))))
        for joint in ids:
            if self._images[joint] not in ids:
                message = f"'{names[joint]}' is observed, and its image '{names[self._images[joint]]}' is not"
                raise ConfigError(message, key=path, expected="joints of both sides")
        joints = [(ids.index(self._images[joint]), self._signs[joint]) for joint in ids]
        return joints + [(len(ids) + source, 1.0) for source, _ in joints if rule == "joints_sin_cos"]

    def command(self, term: ObservationTerm) -> str | None:
        """Return the mirror rule (change in a mirror image) of the command that an observation term returns."""
        found: Any = self._env.command_manager.get_term(str(term.term.params["command_name"]))
        if hasattr(found, "body_name"):
            key = f"env.commands.{term.term.params['command_name']}.body_name"
            image = self._bodies.image(found.body_name, key, with_axes=True)
            if image != found.body_name:
                message = f"the image of a pose of '{found.body_name}' is one of '{image}'"
                raise ConfigError(message, key=key, expected="a body in the middle of the robot")
        names = (kind.__name__ for kind in type(found).__mro__)
        return next((COMMAND_RULES[name] for name in names if name in COMMAND_RULES), None)

    def _entity(self, term: ObservationTerm, parameter: str) -> SceneEntityCfg:
        found: SceneEntityCfg | None = term.term.params.get(parameter)
        if found is None:
            message = f"the observation has no {parameter}"
            raise ConfigError(message, key=term.term.path, expected="a parameter that names the sensor")
        return found

    def _bodies_of(self, rule: str, term: ObservationTerm, path: str) -> SignedSources:
        signs, parameter, with_axes = BODY_RULES[rule]
        entity = self._entity(term, parameter)
        names = _chosen(entity.body_ids, self._env.scene[entity.name].body_names)
        found: SignedSources = []
        for name in names:
            image = self._bodies.image(name, path, with_axes=with_axes)
            if image not in names:
                message = f"'{name}' is observed, and its image '{image}' is not"
                raise ConfigError(message, key=path, expected="bodies of both sides")
            first = names.index(image) * len(signs)
            found += [(first + i, float(sign)) for i, sign in enumerate(signs)]
        return found


def _chosen(ids: Ids, every: list[_Item]) -> list[_Item]:
    return every[ids] if isinstance(ids, slice) else [every[int(i)] for i in ids]
