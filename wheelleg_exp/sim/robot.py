"""The robot of the scene: it runs its actuators, and tracks which environments' state was written."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import mujoco
import torch

from wheelleg_exp.sim.actuators import ONE_GROUP, ActuatorBase, ImplicitActuator
from wheelleg_exp.sim.articulation_data import ArticulationData
from wheelleg_exp.sim.class_members import alias_of
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.ids import Ids, ids_where
from wheelleg_exp.sim.names import shared_errors
from wheelleg_exp.sim.options import RobotOptions
from wheelleg_exp.sim.robot_data import RobotData
from wheelleg_exp.sim.robot_model import JointTargets, RobotLayout
from wheelleg_exp.sim.robot_writers import RobotWriters
from wheelleg_exp.terms.term_errors import blamed

ACTUATORS_KEY = "env.robot.actuators"


class Robot(RobotWriters):
    """The scene's robot, whose constructor adds the robot's actuators to the MuJoCo spec ``spec``."""

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
        self.actuators = self.child("actuators", dict(actuators))
        for name, actuator in self.actuators.items():
            with self._blamed(name):
                actuator.resolve(self.joint_names, f"{ACTUATORS_KEY}.{name}", device)
        claims = [(n, f"{ACTUATORS_KEY}.{n}.joint_names_expr", a.joint_names) for n, a in self.actuators.items()]
        for error in shared_errors(claims, ONE_GROUP):
            raise error
        for name, actuator in self.actuators.items():
            with self._blamed(name):
                actuator.add_to(spec)

    def _blamed(self, group: str, *, has_worked: bool = False) -> AbstractContextManager[None]:
        return blamed(f"{ACTUATORS_KEY}.{group}", self.actuators[group], has_worked=has_worked)

    floating = alias_of("layout.floating", "Whether the base moves freely.")
    default_root_pos = alias_of(
        "layout.default_root_pos", "Root link at a reset, m, from the environment's origin, (3,)."
    )
    default_root_quat = alias_of("layout.default_root_quat", "Orientation of the root link at a reset, wxyz, (4,).")

    def connect(self, sim: Engine, stream: Callable[[str], torch.Generator]) -> None:
        """Connect the robot to the running simulations; the scene calls this method once, after compiling the model."""
        self._sim = sim
        layout, n, device = self.layout, sim.num_envs, sim.device
        layout.bind(sim.model)
        shape = (n, len(self.joint_names))
        for name, actuator in self.actuators.items():
            layout.actuated_ids = torch.cat((layout.actuated_ids, actuator.joint_ids))
            layout.velocity_limits[actuator.joint_ids] = actuator.velocity_limit
            layout.effort_limits[actuator.joint_ids] = actuator.effort_limit
            key = f"{ACTUATORS_KEY}.{name}"
            with self._blamed(name):
                actuator.start(shape, float(sim.model.opt.timestep), partial(stream, key))
        self.body_ids = layout.body_ids
        pos = layout.default_joint_pos.expand(shape).clone()
        targets = JointTargets(pos, torch.zeros(shape, device=device), torch.zeros(shape, device=device))
        self.targets = self.child("targets", targets)
        data = ArticulationData(sim, layout, targets, self._computed_torque, gains=self._gains)
        self.data = self.child("data", data)
        self._ctrl = sim.view("ctrl")
        self._has_new_targets = self.number("_has_new_targets", True, saved=False)
        self._qpos, self._qvel, self._xfrc = sim.view("qpos"), sim.view("qvel"), sim.view("xfrc_applied")
        self._root_qpos, self._root_qvel = self._qpos[:, 0:7], self._qvel[:, 0:6]
        # ``_root_xfrc`` is a view (2, 3, N) of the external force and torque on the root links of N environments.
        self._root_xfrc = self._xfrc[:, int(self.body_ids[0])].T.unflatten(0, (2, 3))
        # ``_stale`` lists the environments whose robot state was written since the last call of ``take_stale``.
        # Most writes of a reset use the same index tensor, which ``_stale`` stores once, so no mask must be computed.
        self._stale: list[torch.Tensor] = []
        self._all_ids = torch.arange(n, device=device)
        self.all_body_ids = torch.arange(len(self.body_names), device=device)
        self._wrench_bodies: tuple[int, ...] = self.number("_wrench_bodies", ())
        # In memory, the environments are the last dimension of ``_wrench``, which makes rotating the wrenches fast.
        wrench = torch.zeros(len(self.body_names), 2, 3, n, device=device).permute(3, 0, 2, 1)
        self._wrench = self.buffer("_wrench", wrench)
        self._root_wrench = self._wrench[:, 0].permute(2, 1, 0).unsqueeze(1)

    def _computed_torque(self, data: RobotData) -> torch.Tensor:
        torque, targets = torch.zeros_like(self.targets.pos), self._targets_of_joints()
        for name, actuator in self.actuators.items():
            with self._blamed(name, has_worked=True):
                torque[:, actuator.joint_ids] = actuator.torque_asked(targets, data)
        return torque

    def _targets_of_joints(self) -> JointTargets:
        """Return joint targets minus the encoder bias, because a drive moves the encoder's reading to the target."""
        if not self.data.has_encoder_bias:
            return self.targets
        return JointTargets(self.targets.pos - self.data.encoder_bias, self.targets.vel, self.targets.effort)

    def _gains(self, name: str, in_solver: bool) -> torch.Tensor:
        """Return a gain of each joint's actuator, (N, J); with ``in_solver``, 0 for actuators outside of the solver."""
        found = torch.zeros_like(self.targets.pos)
        for actuator in self.actuators.values():
            if isinstance(actuator, ImplicitActuator) or not in_solver:
                found[:, actuator.joint_ids] = getattr(actuator, name)
        return found

    def shape_ids(self, body_ids: torch.Tensor | slice) -> torch.Tensor:
        """Return the MuJoCo ids of those geoms of ``bodies`` (indices into ``body_names``) that can collide."""
        model = self._sim.model
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        bodies = set(self.body_ids[body_ids].tolist())
        chosen = [g for g, body in enumerate(model.geom_bodyid.tolist()) if body in bodies and solid[g]]
        return torch.tensor(chosen, dtype=torch.long, device=self._sim.device)

    permanent_wrench = alias_of(
        "_wrench", "Forces and torques at the CoM of the bodies, link axes, as the two columns of (N, B, 3, 2)."
    )

    def begin_control_step(self) -> None:
        """Start a control step: its first physics step passes all targets to the actuators."""
        self.data.begin_control_step()
        self._has_new_targets = True

    def write_data_to_sim(self) -> None:
        """Compute the MuJoCo controls with the actuator models; write the bodies' external wrenches, in world axes."""
        data = self.data
        data.before_step()
        start, targets = 0, self._targets_of_joints()
        for name, actuator in self.actuators.items():
            stop = start + len(actuator.joint_names)
            if self._has_new_targets or actuator.reads_state or actuator.delay is not None:
                with self._blamed(name, has_worked=True):
                    self._ctrl[:, start:stop] = actuator.act(targets, data)
            start = stop
        self._has_new_targets = False
        bodies = list(self._wrench_bodies)
        if bodies == [0]:  # The root link's rotation is part of qpos, so this case needs no forward kinematics.
            self._root_xfrc.copy_((data.root_rot_w.permute(1, 2, 0) * self._root_wrench).sum(dim=2))
        elif bodies:
            world = data.body_rot_w[:, bodies] @ self._wrench[:, bodies]
            self._xfrc[:, self.body_ids[bodies]] = world.mT.reshape(-1, len(bodies), 6).to(self._sim.dtype)

    def reset(self, env_ids: Ids = None) -> None:
        """Clear the external wrenches and the reported torques of the environments ``env_ids``."""
        ids = self._rows(env_ids)
        if self._wrench_bodies:
            self._wrench.index_fill_(0, ids, 0.0)
        self.data.reset(ids)
        for name, actuator in self.actuators.items():
            with self._blamed(name, has_worked=True):
                actuator.begin(ids)
        self._mark_stale(ids)

    def mark_written(self, ids: torch.Tensor) -> None:
        self._mark_stale(ids)
        self.data.invalidate()

    def _mark_stale(self, ids: torch.Tensor) -> None:
        if not any(ids is known for known in self._stale):
            self._stale.append(ids)

    @property
    def is_stale(self) -> bool:
        """Whether the robot's state was written after quantities such as link poses were last computed."""
        return bool(self._stale)

    def take_stale(self) -> torch.Tensor:
        """Return ids (n,) of the environments whose robot state was written since the last call of ``take_stale``."""
        ids = self._stale[0] if len(self._stale) == 1 else ids_where(self._stale_rows())
        self._stale = []
        return ids

    def _stale_rows(self) -> torch.Tensor:
        rows = torch.zeros(self._sim.num_envs, dtype=torch.bool, device=self._sim.device)
        for ids in self._stale:
            rows.index_fill_(0, ids, True)
        return rows

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "stale": self._stale_rows()}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        super().load_state_dict(saved)
        self._has_new_targets = True
        ids = ids_where(saved["stale"])
        self._stale = [ids] if len(ids) else []
