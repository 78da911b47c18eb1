"""The robot: its names, limits, actuators, and the writing of state, targets and wrenches."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import torch

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.actuators import ActuatorBase
from wheelleg_exp.sim.data import RobotData
from wheelleg_exp.sim.names import match_names, require_numbers, values_by_name
from wheelleg_exp.sim.options import RobotOptions
from wheelleg_exp.sim.simulation import Simulation
from wheelleg_exp.sim.state import Kept, cloned, made, same

# Tensors that come from the config and the model, and that an event may change.
_SETTINGS = (
    "default_joint_pos",
    "default_joint_vel",
    "joint_pos_limits",
    "soft_joint_pos_limits",
    "soft_joint_vel_limits",
    "joint_effort_limits",
    "com_b",
)


class Robot(Kept):
    """The robot of the scene: names, limits, actuators, and writing of state, targets and wrenches.

    Args:
        options: the ``env.robot`` section.
        actuators: the actuator groups by name.
        spec: the scene's spec, before compilation; the robot's actuators are added to it.
        root_name: the robot's root body.
    """

    def __init__(
        self,
        options: RobotOptions,
        actuators: Mapping[str, ActuatorBase],
        spec: mujoco.MjSpec,
        root_name: str,
    ) -> None:
        self.options = options
        bodies = _breadth_first(spec.body(root_name))
        self.body_names = [body.name for body in bodies]
        self.floating = any(j.type == mujoco.mjtJoint.mjJNT_FREE for j in bodies[0].joints)
        self._require_base()
        found = [j.name for body in bodies for j in body.joints if j.type != mujoco.mjtJoint.mjJNT_FREE]
        self.joint_names = self._order(found)
        self.actuators = dict(actuators)
        for name, actuator in self.actuators.items():
            actuator.resolve(self.joint_names, f"env.robot.actuators.{name}")
        self._require_disjoint()
        for actuator in self.actuators.values():
            actuator.add_to(spec)
        names = [j for a in self.actuators.values() for j in a.joint_names]
        self.actuator_ids = torch.tensor([self.joint_names.index(j) for j in names], dtype=torch.long)
        self._defaults()
        if not self.floating:  # a fixed base stands where the config says, as a floating one starts there
            bodies[0].pos, bodies[0].quat = options.init_state.pos, options.init_state.rot

    def connect(self, sim: Simulation) -> None:
        """Attach to the running simulations; called once, after the scene has been compiled."""
        self._sim = sim
        model = sim.model
        self._limits(model)
        self.qpos_ids = torch.tensor([int(model.joint(j).qposadr[0]) for j in self.joint_names])
        self.dof_ids = torch.tensor([int(model.joint(j).dofadr[0]) for j in self.joint_names])
        self.body_ids = torch.tensor([int(model.body(b).id) for b in self.body_names])
        self.data = RobotData(self, sim)
        self._ctrl = sim.view("ctrl")
        self._qpos, self._qvel, self._xfrc = sim.view("qpos"), sim.view("qvel"), sim.view("xfrc_applied")
        self._root_qpos, self._root_qvel = self._qpos[:, 0:7], self._qvel[:, 0:6]
        # Force and torque as the two columns of a matrix, (N, 3, 2).
        self._root_xfrc = self._xfrc[:, int(self.body_ids[0])].unflatten(1, (2, 3)).mT
        sim.view("actuator_force")
        self.stale = torch.zeros(sim.num_envs, dtype=torch.bool)
        self._made = self._settings()
        for name, actuator in self.actuators.items():
            made(actuator, f"env.robot.actuators.{name}")
        self._wrench_bodies: torch.Tensor | None = None
        self._wrench = torch.zeros(sim.num_envs, len(self.body_names), 3, 2)

    def find_joints(
        self, expressions: str | list[str], *, key: str, preserve_order: bool = False
    ) -> tuple[list[int], list[str]]:
        """Return indices and names of the joints that match; ConfigError when an expression matches none."""
        return match_names(expressions, self.joint_names, key=key, what="joint", preserve_order=preserve_order)

    def find_bodies(
        self, expressions: str | list[str], *, key: str, preserve_order: bool = False
    ) -> tuple[list[int], list[str]]:
        """Return indices and names of the bodies that match; ConfigError when an expression matches none."""
        return match_names(expressions, self.body_names, key=key, what="body", preserve_order=preserve_order)

    def shape_ids(self, body_ids: torch.Tensor | slice) -> torch.Tensor:
        """Return the model's ids of the colliding geoms of the bodies (indices into ``body_names``)."""
        model = self._sim.model
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        chosen = np.isin(model.geom_bodyid, self.body_ids[body_ids].numpy()) & solid
        return torch.from_numpy(np.flatnonzero(chosen))

    def set_joint_position_target(self, target: torch.Tensor, joint_ids: torch.Tensor | slice) -> None:
        """Set position targets (N, k), rad."""
        self.data.joint_pos_target[:, joint_ids] = target

    def set_joint_velocity_target(self, target: torch.Tensor, joint_ids: torch.Tensor | slice) -> None:
        """Set velocity targets (N, k), rad/s, clipped to the actuators' velocity limits."""
        limit = self.data.soft_joint_vel_limits[joint_ids]
        self.data.joint_vel_target[:, joint_ids] = torch.clamp(target, -limit, limit)

    def set_joint_effort_target(self, target: torch.Tensor, joint_ids: torch.Tensor | slice) -> None:
        """Set feed-forward efforts (N, k), N·m."""
        self.data.joint_effort_target[:, joint_ids] = target

    def set_permanent_wrench(self, ids: torch.Tensor, body_ids: list[int], wrench: torch.Tensor) -> None:
        """Set forces and torques (n, k, 6) at the CoM of the bodies, link axes, until the next reset of ``ids``."""
        self._wrench[ids.unsqueeze(1), torch.tensor(body_ids)] = wrench.view(len(ids), -1, 2, 3).mT
        known = [] if self._wrench_bodies is None else self._wrench_bodies.tolist()
        if not set(body_ids) <= set(known):
            self._wrench_bodies = torch.tensor(sorted({*known, *body_ids}))

    def write_data_to_sim(self) -> None:
        """Run the actuator models on the present state and apply permanent wrenches in world axes."""
        data = self.data
        data.before_step()
        start = 0
        for actuator in self.actuators.values():
            stop = start + len(actuator.joint_names)
            self._ctrl[:, start:stop] = actuator.control(data)
            start = stop
        if self._wrench_bodies is not None:
            self._write_wrenches(self._wrench_bodies)

    def _write_wrenches(self, bodies: torch.Tensor) -> None:
        """Turn permanent wrenches from link axes, as the links stand now, to the world's."""
        if len(bodies) == 1 and bodies[0] == 0:  # the root's rotation is in the state itself
            self._root_xfrc.copy_(torch.bmm(self.data.root_rot_w, self._wrench[:, 0]))
            return
        world = self.data.body_rot_w[:, bodies] @ self._wrench[:, bodies]
        self._xfrc[:, self.body_ids[bodies]] = world.mT.reshape(-1, len(bodies), 6).double()

    def reset(self, ids: torch.Tensor) -> None:
        """Forget wrenches and reported torques of ``ids``; state and targets are left to events and actions."""
        if self._wrench_bodies is not None:
            self._wrench[ids] = 0.0
        self.data.reset(ids)
        self.stale[ids] = True

    def write_root_pose(self, ids: torch.Tensor, pos: torch.Tensor, quat: torch.Tensor) -> None:
        """Set the root link's pose (n, 3), (n, 4) in the world."""
        self._require_floating()
        unit = torch.nn.functional.normalize(quat.double(), dim=-1)
        self._root_qpos[ids] = torch.cat((pos.double(), unit), dim=1)
        self.mark_written(ids)

    def write_root_com_velocity(self, ids: torch.Tensor, lin_vel: torch.Tensor, ang_vel: torch.Tensor) -> None:
        """Set the velocity (n, 3), (n, 3) of the root body's CoM in world axes, at the present orientation."""
        self._require_floating()
        matrix = rotation.quat_to_matrix(self._root_qpos[ids, 3:7])
        angular = rotation.rotate_inverse(matrix, ang_vel.double())
        # v_link = v_com - omega x R c = v_com - R (omega_b x c)
        lever = rotation.rotate(matrix, torch.linalg.cross(angular, self.data.com_b[ids].double()))
        self._root_qvel[ids] = torch.cat((lin_vel.double() - lever, angular), dim=1)
        self.mark_written(ids)

    def write_joint_state(
        self,
        ids: torch.Tensor,
        pos: torch.Tensor,
        vel: torch.Tensor,
        joint_ids: torch.Tensor | slice = slice(None),
    ) -> None:
        """Set joint positions and velocities (n, k); the joints' accelerations count from there."""
        self._qpos[ids.unsqueeze(1), self.qpos_ids[joint_ids]] = pos.double()
        self._qvel[ids.unsqueeze(1), self.dof_ids[joint_ids]] = vel.double()
        self.data.set_velocity_before(ids, joint_ids, vel)
        self.mark_written(ids)

    def mark_written(self, ids: torch.Tensor) -> None:
        """Note that state or model fields of ``ids`` were written: derived quantities are computed anew."""
        self.stale[ids] = True
        self.data.invalidate()

    def _require_base(self) -> None:
        wanted = self.options.base
        if wanted != "auto" and (wanted == "floating") != self.floating:
            raise ConfigError(
                f"is '{wanted}', but the model's base is {'floating' if self.floating else 'fixed'}",
                key="env.robot.base",
                expected="auto, or the base that the model has",
            )

    def _require_floating(self) -> None:
        if not self.floating:
            raise ConfigError(
                "the robot's base is fixed, its root cannot be moved",
                key="env.events",
                expected="events that leave the root alone, or env.robot.base=floating",
            )

    def state_dict(self) -> dict[str, Any]:
        """Return targets, wrenches and reported quantities that the simulation's state does not hold."""
        data = self.data
        bodies = self._wrench_bodies
        return {
            "joint_pos_target": data.joint_pos_target.clone(),
            "joint_vel_target": data.joint_vel_target.clone(),
            "joint_effort_target": data.joint_effort_target.clone(),
            "settings": {n: v for n, v in self._settings().items() if not same(v, self._made[n])},
            "actuators": {name: actuator.state_dict() for name, actuator in self.actuators.items()},
            "motion_before": data._before.clone(),
            "torque_valid": data._torque_valid.clone(),
            "applied_torque": data.applied_torque.clone(),
            "wrench": self._wrench.clone(),
            "wrench_bodies": [] if bodies is None else bodies.tolist(),
            "stale": self.stale.clone(),
        }

    def _settings(self) -> dict[str, torch.Tensor]:
        roots = {"default_root_pos": self.default_root_pos, "default_root_quat": self.default_root_quat}
        return cloned({**{name: getattr(self.data, name) for name in _SETTINGS}, **roots})

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        data = self.data
        data.joint_pos_target.copy_(saved["joint_pos_target"])
        data.joint_vel_target.copy_(saved["joint_vel_target"])
        data.joint_effort_target.copy_(saved["joint_effort_target"])
        for name, value in {**self._made, **saved["settings"]}.items():
            getattr(data if name in _SETTINGS else self, name).copy_(value)
        for name, actuator in self.actuators.items():
            actuator.load_state_dict(saved["actuators"][name])
        data._before.copy_(saved["motion_before"])
        data._torque_valid.copy_(saved["torque_valid"])
        data.applied_torque.copy_(saved["applied_torque"])
        self._wrench.copy_(saved["wrench"])
        bodies = saved["wrench_bodies"]
        self._wrench_bodies = torch.tensor(bodies) if bodies else None
        self.stale.copy_(saved["stale"])
        data.invalidate()

    def _order(self, found: list[str]) -> list[str]:
        wanted = self.options.joint_order
        if wanted is None:
            return found
        for name in wanted:
            if name not in found:
                raise ConfigError(
                    f"the robot has no joint '{name}'",
                    key="env.robot.joint_order",
                    expected="an order of " + ", ".join(found),
                    nearest=nearest_name(name, found),
                )
        missing = [name for name in found if name not in wanted]
        if missing or len(set(wanted)) != len(wanted):
            raise ConfigError(
                "must name each joint once" + (f", '{missing[0]}' is missing" if missing else ""),
                key="env.robot.joint_order",
                expected="an order of " + ", ".join(found),
            )
        return list(wanted)

    def _require_disjoint(self) -> None:
        owner: dict[str, str] = {}
        for group, actuator in self.actuators.items():
            for joint in actuator.joint_names:
                if joint in owner:
                    raise ConfigError(
                        f"joint '{joint}' is driven by both '{owner[joint]}' and '{group}'",
                        key=f"env.robot.actuators.{group}.joint_names_expr",
                        expected="each joint in one actuator group",
                    )
                owner[joint] = group

    def _defaults(self) -> None:
        """Spread the initial state over the joints; a joint that no expression names starts at 0."""
        init, names = self.options.init_state, self.joint_names
        key = "env.robot.init_state"
        require_numbers(init.pos, 3, f"{key}.pos")
        require_numbers(init.rot, 4, f"{key}.rot")
        if not any(init.rot):
            raise ConfigError("is no rotation", key=f"{key}.rot", expected="a quaternion (w, x, y, z)")
        pos = values_by_name(init.joint_pos, names, 0.0, key=f"{key}.joint_pos", what="joint")
        vel = values_by_name(init.joint_vel, names, 0.0, key=f"{key}.joint_vel", what="joint")
        self._default_positions = [float(value) for value in pos]
        self.default_joint_pos = torch.tensor(self._default_positions)
        self.default_joint_vel = torch.tensor(vel, dtype=torch.float32)
        self.default_root_pos = torch.tensor(init.pos, dtype=torch.float32)
        self.default_root_quat = torch.nn.functional.normalize(torch.tensor(init.rot, dtype=torch.float32), dim=0)

    def _limits(self, model: mujoco.MjModel) -> None:
        """Read hard limits from the compiled model, derive soft ones, and hold the defaults against them."""
        ranges = []
        for name, value in zip(self.joint_names, self._default_positions, strict=True):
            index = model.joint(name).id
            low, high = model.jnt_range[index].tolist() if model.jnt_limited[index] else (-torch.inf, torch.inf)
            if not low <= value <= high:
                raise ConfigError(
                    f"the default position {value} of joint '{name}' is outside its limits",
                    key="env.robot.init_state.joint_pos",
                    expected=f"a value in [{low:.6g}, {high:.6g}]",
                )
            ranges.append((low, high))
        limits = torch.tensor(ranges, dtype=torch.float32)
        middle, half = (
            limits.mean(dim=1),
            (limits[:, 1] - limits[:, 0]) / 2 * self.options.soft_joint_pos_limit_factor,
        )
        soft = torch.stack((middle - half, middle + half), dim=1)
        self.joint_pos_limits = limits
        self.soft_joint_pos_limits = torch.where(limits.isfinite(), soft, limits)
        self.velocity_limits = torch.full((len(self.joint_names),), torch.inf)
        self.effort_limits = torch.full((len(self.joint_names),), torch.inf)
        for actuator in self.actuators.values():
            self.velocity_limits[actuator.joint_ids] = actuator.velocity_limit
            self.effort_limits[actuator.joint_ids] = actuator.effort_limit


def _breadth_first(root: Any) -> list[Any]:
    order, queue = [], deque([root])
    while queue:
        body = queue.popleft()
        order.append(body)
        queue.extend(body.bodies)
    return order
