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
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.sim.ids import EnvIds, ids_where
from wheelleg_exp.sim.names import shared_errors
from wheelleg_exp.sim.options import RobotOptions
from wheelleg_exp.sim.robot_data import RobotData
from wheelleg_exp.sim.robot_model import JointTargets, RobotLayout
from wheelleg_exp.sim.robot_writers import RobotParameterWriters
from wheelleg_exp.state import cloned, made, same
from wheelleg_exp.terms.term_errors import blamed

ACTUATORS_KEY = "env.robot.actuators"


class Robot(RobotParameterWriters):
    """The robot of the scene; ``RobotWriters`` has the members that terms use.

    Args:
        options: the ``env.robot`` section.
        actuators: the actuator groups by name.
        spec: the scene's spec, before compilation; the robot's actuators are added to it.
        root_name: the robot's root body.
        device: device of the tensors.
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
            with self._blamed(name):
                actuator.resolve(self.joint_names, f"{ACTUATORS_KEY}.{name}", device)
        self._require_disjoint()
        for name, actuator in self.actuators.items():
            with self._blamed(name):
                actuator.add_to(spec)

    def _blamed(self, group: str, *, has_worked: bool = False) -> AbstractContextManager[None]:
        return blamed(f"{ACTUATORS_KEY}.{group}", self.actuators[group], has_worked=has_worked)

    @property
    def floating(self) -> bool:
        """Whether the base moves freely."""
        return self.layout.floating

    @property
    def default_root_pos(self) -> torch.Tensor:
        """Position of the root link at a reset, m, relative to the environment's origin, (3,)."""
        return self.layout.default_root_pos

    @property
    def default_root_quat(self) -> torch.Tensor:
        """Orientation of the root link at a reset, (w, x, y, z), (4,)."""
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
            key = f"{ACTUATORS_KEY}.{name}"
            with self._blamed(name):
                actuator.start(shape, float(sim.model.opt.timestep), partial(stream, key))
                made(actuator, key)
        self.body_ids = layout.body_ids
        self.targets = JointTargets(
            layout.default_joint_pos.expand(shape).clone(),
            torch.zeros(shape, device=device),
            torch.zeros(shape, device=device),
        )
        self.data = ArticulationData(sim, layout, self.targets, self._computed_torque, gains=self._gains)
        self._ctrl = sim.view("ctrl")
        self._has_new_targets = True
        self._qpos, self._qvel, self._xfrc = sim.view("qpos"), sim.view("qvel"), sim.view("xfrc_applied")
        self._root_qpos, self._root_qvel = self._qpos[:, 0:7], self._qvel[:, 0:6]
        # Force and torque on the root, components first, (2, 3, N).
        self._root_xfrc = self._xfrc[:, int(self.body_ids[0])].T.unflatten(0, (2, 3))
        # Environments whose state was written since the last refresh. A reset writes several times with one and the
        # same tensor, so a list with an identity check is cheaper than a mask.
        self._stale: list[torch.Tensor] = []
        self._all_ids = torch.arange(n, device=device)
        self.all_body_ids = torch.arange(len(self.body_names), device=device)
        self._made = self._settings()
        self._wrench_bodies: tuple[int, ...] = ()
        # The components are the first dimensions in memory: the product with rotations of the same layout is fastest.
        self._wrench = torch.zeros(len(self.body_names), 2, 3, n, device=device).permute(3, 0, 2, 1)
        self._root_wrench = self._wrench[:, 0].permute(2, 1, 0).unsqueeze(1)

    def _computed_torque(self, data: RobotData) -> torch.Tensor:
        torque, targets = torch.zeros_like(self.targets.pos), self._targets_of_joints()
        for name, actuator in self.actuators.items():
            with self._blamed(name, has_worked=True):
                torque[:, actuator.joint_ids] = actuator.torque_asked(targets, data)
        return torque

    def _targets_of_joints(self) -> JointTargets:
        """Return the targets minus the encoder bias: a drive controls the encoder's reading, not the true position."""
        if not self.data.has_encoder_bias:
            return self.targets
        return JointTargets(self.targets.pos - self.data.encoder_bias, self.targets.vel, self.targets.effort)

    def _gains(self, name: str, in_solver: bool) -> torch.Tensor:
        """Return a gain of the actuators by its name for each joint (N, J); with ``in_solver`` 0 for explicit ones."""
        found = torch.zeros_like(self.targets.pos)
        for actuator in self.actuators.values():
            if isinstance(actuator, ImplicitActuator) or not in_solver:
                found[:, actuator.joint_ids] = getattr(actuator, name)
        return found

    def shape_ids(self, body_ids: torch.Tensor | slice) -> torch.Tensor:
        """Return the model's ids of the colliding geoms of the bodies (indices into ``body_names``)."""
        model = self._sim.model
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        bodies = set(self.body_ids[body_ids].tolist())
        chosen = [g for g, body in enumerate(model.geom_bodyid.tolist()) if body in bodies and solid[g]]
        return torch.tensor(chosen, dtype=torch.long, device=self._sim.device)

    @property
    def permanent_wrench(self) -> torch.Tensor:
        """Forces and torques at the CoM of the bodies, link axes, as the two columns of (N, B, 3, 2)."""
        return self._wrench

    def begin_control_step(self) -> None:
        """Start a control step: its first physics step passes all targets to the actuators."""
        self.data.begin_control_step()
        self._has_new_targets = True

    def write_data_to_sim(self) -> None:
        """Run the actuator models on the present state and apply permanent wrenches in world axes."""
        data = self.data
        data.before_step()
        start, targets = 0, self._targets_of_joints()
        for name, actuator in self.actuators.items():
            stop = start + len(actuator.joint_names)
            if self._has_new_targets or not actuator.follows_targets:
                with self._blamed(name, has_worked=True):
                    self._ctrl[:, start:stop] = actuator.act(targets, data)
            start = stop
        self._has_new_targets = False
        if self._wrench_bodies:
            self._write_wrenches(self._wrench_bodies)

    def _write_wrenches(self, pushed: tuple[int, ...]) -> None:
        """Rotate permanent wrenches from the present link axes to world axes, and apply them."""
        if pushed == (0,):  # the root's rotation is part of the state, and needs no forward kinematics
            turn = self.data.root_rot_w.permute(1, 2, 0)
            self._root_xfrc.copy_((turn * self._root_wrench).sum(dim=2))
            return
        bodies = list(pushed)  # torch treats a tuple as an index of several dimensions
        world = self.data.body_rot_w[:, bodies] @ self._wrench[:, bodies]
        self._xfrc[:, self.body_ids[bodies]] = world.mT.reshape(-1, len(bodies), 6).to(self._sim.dtype)

    def reset(self, env_ids: EnvIds = None) -> None:
        """Clear wrenches and reported torques of ``env_ids``; events and actions set the state and the targets."""
        ids = self._rows(env_ids)
        if self._wrench_bodies:
            self._wrench.index_fill_(0, ids, 0.0)
        self.data.reset(ids)
        for name, actuator in self.actuators.items():
            with self._blamed(name, has_worked=True):
                actuator.begin(ids)
        self._mark_stale(ids)

    def mark_written(self, ids: torch.Tensor) -> None:
        """Mark ``ids`` as written (state or model fields), so that derived quantities are recomputed."""
        self._mark_stale(ids)
        self.data.invalidate()

    def _mark_stale(self, ids: torch.Tensor) -> None:
        if not any(ids is known for known in self._stale):
            self._stale.append(ids)

    @property
    def is_stale(self) -> bool:
        """Whether state was written since derived quantities were last computed."""
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

    def state_dict(self) -> dict[str, Any]:
        """Return the state that is not in the engine: targets, wrenches, actuators, changed settings."""
        return {
            **self.targets.state_dict(),
            "settings": {n: v for n, v in self._settings().items() if not same(v, self._made[n])},
            "actuators": {name: actuator.state_dict() for name, actuator in self.actuators.items()},
            **self.data.state_dict(),
            "wrench": self._wrench.clone(memory_format=torch.contiguous_format),
            "wrench_bodies": list(self._wrench_bodies),
            "stale": self._stale_rows(),
        }

    def _settings(self) -> dict[str, torch.Tensor]:
        return cloned(self.data.settings())

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self.targets.load_state_dict(saved)
        self._has_new_targets = True
        present = self.data.settings()
        for name, value in {**self._made, **saved["settings"]}.items():
            present[name].copy_(value)
        for name, actuator in self.actuators.items():
            actuator.load_state_dict(saved["actuators"][name])
        self.data.load_state_dict(saved)
        self._wrench.copy_(saved["wrench"])
        self._wrench_bodies = tuple(saved["wrench_bodies"])
        ids = ids_where(saved["stale"])
        self._stale = [ids] if len(ids) else []

    def _require_disjoint(self) -> None:
        keys = {group: f"env.robot.actuators.{group}.joint_names_expr" for group in self.actuators}
        claims = [(group, keys[group], actuator.joint_names) for group, actuator in self.actuators.items()]
        for error in shared_errors(claims, ONE_GROUP):
            raise error
