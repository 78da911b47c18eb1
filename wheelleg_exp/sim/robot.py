"""The robot: its names, limits, actuators, and the writing of state, targets and wrenches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import mujoco
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.actuators import ONE_GROUP, ActuatorBase
from wheelleg_exp.sim.data import RobotData
from wheelleg_exp.sim.engine import WRENCHES, Engine
from wheelleg_exp.sim.ids import ids_where
from wheelleg_exp.sim.layout import JointTargets, RobotLayout
from wheelleg_exp.sim.names import match_names, shared_errors
from wheelleg_exp.sim.options import RobotOptions
from wheelleg_exp.state import Kept, cloned, made, same

_ACTUATORS = "env.robot.actuators"


class Robot(Kept):
    """The robot of the scene: names, limits, actuators, and writing of state, targets and wrenches.

    Args:
        options: the ``env.robot`` section.
        actuators: the actuator groups by name.
        spec: the scene's spec, before compilation; the robot's actuators are added to it.
        root_name: the robot's root body.
        device: where the tensors are.
    """

    def __init__(
        self,
        options: RobotOptions,
        actuators: Mapping[str, ActuatorBase],
        spec: mujoco.MjSpec,
        root_name: str,
        device: torch.device,
    ) -> None:
        self.options = options
        self.layout = RobotLayout(options, spec, root_name, device)
        self.actuators = dict(actuators)
        for name, actuator in self.actuators.items():
            actuator.resolve(self.joint_names, f"{_ACTUATORS}.{name}", device)
        self._require_disjoint()
        for actuator in self.actuators.values():
            actuator.add_to(spec)

    @property
    def body_names(self) -> list[str]:
        """Names of the bodies, breadth first."""
        return self.layout.body_names

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints in the order that terms see."""
        return self.layout.joint_names

    @property
    def floating(self) -> bool:
        """Whether the base is free."""
        return self.layout.floating

    @property
    def default_root_pos(self) -> torch.Tensor:
        """Where resets place the root link, m, relative to the environment's origin, (3,)."""
        return self.layout.default_root_pos

    @property
    def default_root_quat(self) -> torch.Tensor:
        """The root link's orientation (w, x, y, z) that resets start from, (4,)."""
        return self.layout.default_root_quat

    def connect(self, sim: Engine, stream: Callable[[str], torch.Generator]) -> None:
        """Attach to the running simulations; called once, after the scene has been compiled.

        Args:
            sim: the simulations.
            stream: returns the random stream of a config path.
        """
        self._sim = sim
        layout, n, device = self.layout, sim.num_envs, sim.device
        layout.bind(sim.model)
        shape = (n, len(self.joint_names))
        for name, actuator in self.actuators.items():
            layout.add_drive(actuator.joint_ids, actuator.velocity_limit, actuator.effort_limit)
            key = f"{_ACTUATORS}.{name}"
            actuator.start(shape, float(sim.model.opt.timestep), partial(stream, key))
            made(actuator, key)
        self.body_ids = layout.body_ids
        self.targets = JointTargets(
            layout.default_joint_pos.expand(shape).clone(),
            torch.zeros(shape, device=device),
            torch.zeros(shape, device=device),
        )
        self.data = RobotData(sim, layout, self.targets, self._computed_torque)
        self._ctrl = sim.view("ctrl")
        self._qpos, self._qvel, self._xfrc = sim.view("qpos"), sim.view("qvel"), sim.view("xfrc_applied")
        self._root_qpos, self._root_qvel = self._qpos[:, 0:7], self._qvel[:, 0:6]
        # Force and torque as the two columns of a matrix, (N, 3, 2).
        self._root_xfrc = self._xfrc[:, int(self.body_ids[0])].unflatten(1, (2, 3)).mT
        self._stale: list[torch.Tensor] = []  # environments whose state was written; most often one and the same tensor
        self._made = self._settings()
        self._wrench_bodies: list[int] = []
        self._wrench = torch.zeros(n, len(self.body_names), 3, 2, device=device)

    def _computed_torque(self, data: RobotData) -> torch.Tensor:
        torque = torch.zeros_like(self.targets.pos)
        for actuator in self.actuators.values():
            torque[:, actuator.joint_ids] = actuator.torque_asked(self.targets, data)
        return torque

    def find_joints(
        self, expressions: str | Sequence[str], *, key: str, preserve_order: bool = False
    ) -> tuple[list[int], list[str]]:
        """Return indices and names of the joints that match; ConfigError when an expression matches none."""
        return match_names(expressions, self.joint_names, key=key, what="joint", preserve_order=preserve_order)

    def find_bodies(
        self, expressions: str | Sequence[str], *, key: str, preserve_order: bool = False
    ) -> tuple[list[int], list[str]]:
        """Return indices and names of the bodies that match; ConfigError when an expression matches none."""
        return match_names(expressions, self.body_names, key=key, what="body", preserve_order=preserve_order)

    def shape_ids(self, body_ids: torch.Tensor | slice) -> torch.Tensor:
        """Return the model's ids of the colliding geoms of the bodies (indices into ``body_names``)."""
        model = self._sim.model
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        bodies = set(self.body_ids[body_ids].tolist())
        chosen = [g for g, body in enumerate(model.geom_bodyid.tolist()) if body in bodies and solid[g]]
        return torch.tensor(chosen, dtype=torch.long, device=self._sim.device)

    def set_joint_position_target(self, target: torch.Tensor, joint_ids: torch.Tensor | slice) -> None:
        """Set position targets (N, k), rad."""
        self.targets.pos[:, joint_ids] = target

    def set_joint_velocity_target(self, target: torch.Tensor, joint_ids: torch.Tensor | slice) -> None:
        """Set velocity targets (N, k), rad/s, clipped to the actuators' velocity limits."""
        limit = self.data.soft_joint_vel_limits[:, joint_ids]
        self.targets.vel[:, joint_ids] = torch.clamp(target, -limit, limit)

    def set_joint_effort_target(self, target: torch.Tensor, joint_ids: torch.Tensor | slice) -> None:
        """Set feed-forward efforts (N, k), N·m."""
        self.targets.effort[:, joint_ids] = target

    def set_permanent_wrench(self, ids: torch.Tensor, body_ids: list[int], wrench: torch.Tensor) -> None:
        """Set forces and torques (n, k, 6) at the CoM of the bodies, link axes, until the next reset of ``ids``."""
        self._wrench[ids.unsqueeze(1), torch.tensor(body_ids, device=ids.device)] = wrench.view(len(ids), -1, 2, 3).mT
        self._wrench_bodies = sorted({*self._wrench_bodies, *body_ids})
        self._sim.asked.add(WRENCHES)

    @property
    def permanent_wrench(self) -> torch.Tensor:
        """Forces and torques at the CoM of the bodies, link axes, as the two columns of (N, B, 3, 2)."""
        return self._wrench

    def write_data_to_sim(self) -> None:
        """Run the actuator models on the present state and apply permanent wrenches in world axes."""
        data = self.data
        data.before_step()
        start = 0
        for actuator in self.actuators.values():
            stop = start + len(actuator.joint_names)
            self._ctrl[:, start:stop] = actuator.act(self.targets, data)
            start = stop
        if self._wrench_bodies:
            self._write_wrenches(self._wrench_bodies)

    def _write_wrenches(self, bodies: list[int]) -> None:
        """Turn permanent wrenches from link axes, as the links stand now, to the world's."""
        if bodies == [0]:  # the root's rotation is in the state itself
            self._root_xfrc.copy_(torch.bmm(self.data.root_rot_w, self._wrench[:, 0]))
            return
        world = self.data.body_rot_w[:, bodies] @ self._wrench[:, bodies]
        self._xfrc[:, self.body_ids[bodies]] = world.mT.reshape(-1, len(bodies), 6).to(self._sim.dtype)

    def reset(self, ids: torch.Tensor) -> None:
        """Forget wrenches and reported torques of ``ids``; state and targets are left to events and actions."""
        if self._wrench_bodies:
            self._wrench.index_fill_(0, ids, 0.0)
        self.data.reset(ids)
        for actuator in self.actuators.values():
            actuator.begin(ids)
        self._mark_stale(ids)

    def write_root_pose(self, ids: torch.Tensor, pos: torch.Tensor, quat: torch.Tensor) -> None:
        """Set the root link's pose (n, 3), (n, 4) in the world."""
        self._require_floating()
        dtype = self._sim.dtype
        unit = torch.nn.functional.normalize(quat.to(dtype), dim=-1)
        self._root_qpos[ids] = torch.cat((pos.to(dtype), unit), dim=1)
        self.mark_written(ids)

    def write_root_com_velocity(self, ids: torch.Tensor, lin_vel: torch.Tensor, ang_vel: torch.Tensor) -> None:
        """Set the velocity (n, 3), (n, 3) of the root body's CoM in world axes, at the present orientation."""
        self._require_floating()
        dtype = self._sim.dtype
        matrix = rotation.quat_to_matrix(self._root_qpos[ids, 3:7])
        angular = rotation.rotate_inverse(matrix, ang_vel.to(dtype))
        # v_link = v_com - omega x R c = v_com - R (omega_b x c)
        lever = rotation.rotate(matrix, torch.linalg.cross(angular, self.data.com_b[ids].to(dtype)))
        self._root_qvel[ids] = torch.cat((lin_vel.to(dtype) - lever, angular), dim=1)
        self.mark_written(ids)

    def write_joint_state(
        self,
        ids: torch.Tensor,
        pos: torch.Tensor,
        vel: torch.Tensor,
        joint_ids: torch.Tensor | slice = slice(None),
    ) -> None:
        """Set joint positions and velocities (n, k); the joints' accelerations count from there."""
        self._qpos[ids.unsqueeze(1), self.layout.qpos_ids[joint_ids]] = pos.to(self._sim.dtype)
        self._qvel[ids.unsqueeze(1), self.layout.dof_ids[joint_ids]] = vel.to(self._sim.dtype)
        self.data.set_velocity_before(ids, joint_ids, vel)
        self.mark_written(ids)

    def mark_written(self, ids: torch.Tensor) -> None:
        """Note that state or model fields of ``ids`` were written: derived quantities are computed anew."""
        self._mark_stale(ids)
        self.data.invalidate()

    def _mark_stale(self, ids: torch.Tensor) -> None:
        if not any(ids is known for known in self._stale):
            self._stale.append(ids)

    @property
    def is_stale(self) -> bool:
        """Whether state was written that derived quantities do not show yet."""
        return bool(self._stale)

    def take_stale(self) -> torch.Tensor:
        """Return the environments whose state was written since the last call, (n,)."""
        ids = self._stale[0] if len(self._stale) == 1 else ids_where(self._stale_rows())
        self._stale = []
        return ids

    def _stale_rows(self) -> torch.Tensor:
        rows = torch.zeros(self._sim.num_envs, dtype=torch.bool, device=self._sim.device)
        for ids in self._stale:
            rows.index_fill_(0, ids, True)
        return rows

    def _require_floating(self) -> None:
        if not self.floating:
            raise ConfigError(
                "the robot's base is fixed, its root cannot be moved",
                expected="terms that leave the root alone, or env.robot.base=floating",
            )

    def state_dict(self) -> dict[str, Any]:
        """Return targets, wrenches and reported quantities that the simulation's state does not hold."""
        return {
            **self.targets.state_dict(),
            "settings": {n: v for n, v in self._settings().items() if not same(v, self._made[n])},
            "actuators": {name: actuator.state_dict() for name, actuator in self.actuators.items()},
            **self.data.state_dict(),
            "wrench": self._wrench.clone(),
            "wrench_bodies": list(self._wrench_bodies),
            "stale": self._stale_rows(),
        }

    def _settings(self) -> dict[str, torch.Tensor]:
        return cloned({**self.data.settings(), **self._roots()})

    def _roots(self) -> dict[str, torch.Tensor]:
        return {"default_root_pos": self.default_root_pos, "default_root_quat": self.default_root_quat}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self.targets.load_state_dict(saved)
        present = {**self.data.settings(), **self._roots()}
        for name, value in {**self._made, **saved["settings"]}.items():
            present[name].copy_(value)
        for name, actuator in self.actuators.items():
            actuator.load_state_dict(saved["actuators"][name])
        self.data.load_state_dict(saved)
        self._wrench.copy_(saved["wrench"])
        self._wrench_bodies = list(saved["wrench_bodies"])
        ids = ids_where(saved["stale"])
        self._stale = [ids] if len(ids) else []

    def _require_disjoint(self) -> None:
        keys = {group: f"env.robot.actuators.{group}.joint_names_expr" for group in self.actuators}
        claims = [(group, keys[group], actuator.joint_names) for group, actuator in self.actuators.items()]
        for error in shared_errors(claims, ONE_GROUP):
            raise error
