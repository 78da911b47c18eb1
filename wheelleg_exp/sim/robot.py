"""The robot of the scene, under the names of Isaac Lab's ``Articulation``: its actuators, state, and parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any

import mujoco
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.actuators import ONE_GROUP, ActuatorBase, ImplicitActuator
from wheelleg_exp.sim.articulation_data import ArticulationData
from wheelleg_exp.sim.class_members import alias_of, declare_unsupported
from wheelleg_exp.sim.engine import WRENCHES, Engine
from wheelleg_exp.sim.ids import Ids, chosen, columns, ids_where
from wheelleg_exp.sim.names import match_names, shared_errors
from wheelleg_exp.sim.options import RobotOptions
from wheelleg_exp.sim.robot_model import JointTargets, RobotLayout, soft_limits
from wheelleg_exp.state import Stateful
from wheelleg_exp.terms.term_errors import blamed

ACTUATORS_KEY = "env.robot.actuators"
_PHYSX = "MuJoCo has no PhysX view; read from data, write with write_..._to_sim, env.scene.sim is the engine"
_TENDONS = "a robot's tendons are not driven here"
_STRONGEST = 1e10  # A drive without a torque limit gets MuJoCo's largest number as its limit, N·m.
Values = torch.Tensor | float
_TENDON_PARTS = ("stiffness", "damping", "limit_stiffness", "offset")


@declare_unsupported(
    {"root_physx_view": _PHYSX, "write_joint_dynamic_friction_coefficient_to_sim": "MuJoCo has one friction of a joint"}
    | {f"set_{kind}_tendon_{part}": _TENDONS for kind in ("fixed", "spatial") for part in _TENDON_PARTS}
    | {f"set_fixed_tendon_{part}": _TENDONS for part in ("position_limit", "rest_length", "limit")}
    | {f"write_{kind}_tendon_properties_to_sim": _TENDONS for kind in ("fixed", "spatial")}
)
class Robot(Stateful):
    """The robot of the scene; its constructor adds the robot's actuators to the MuJoCo spec ``spec``.

    Indices are tensors, lists or slices; None means all. Poses and velocities are in world axes: a pose is a position,
    m, and a quaternion (w, x, y, z); a velocity is linear, m/s, then angular, rad/s; a root state is a pose followed by
    a velocity. Joint parameters are a tensor (n, k) for n environments and k joints, or one number. Actuator gains and
    limits have no effect on a joint without an actuator.
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
        self.num_joints, self.num_bodies = len(self.joint_names), len(self.body_names)
        self.is_fixed_base = not self.layout.floating
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
    default_root_pos = alias_of("layout.default_root_pos", "Root link in its environment at a reset, m, (3,).")
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
        data = ArticulationData(sim, layout, targets, self._computed_torque, self._gains)
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

    def _computed_torque(self, data: ArticulationData) -> torch.Tensor:
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

    permanent_wrench = alias_of("_wrench", "Forces and torques on the bodies' CoM, link axes: columns of (N, B, 3, 2).")

    def begin_control_step(self) -> None:
        """Start a control step: its first physics step passes all targets to the actuators."""
        self.data.motion_at_start.copy_(self._sim.motion)  # for failure reports
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
        bodies = self._wrench_bodies
        if bodies == (0,):  # The root link's rotation is part of qpos, so this case needs no forward kinematics.
            self._root_xfrc.copy_((data.root_rot_w.permute(1, 2, 0) * self._root_wrench).sum(dim=2))
        elif bodies:
            # A CUDA graph cannot contain a list of indices, because it would have to be copied to the GPU.
            ids = torch.cat([self.all_body_ids[body : body + 1] for body in bodies])
            world = data.body_rot_w[:, ids] @ self._wrench[:, ids]
            self._xfrc[:, self.body_ids[ids]] = world.mT.reshape(-1, len(bodies), 6).to(self._sim.dtype)

    def reset(self, env_ids: Ids = None) -> None:
        """Clear the external wrenches and the reported torques of the environments ``env_ids``."""
        ids = self._rows(env_ids)
        if self._wrench_bodies:
            self._wrench.index_fill_(0, ids, 0.0)
        self.data.reset(ids)
        for name, actuator in self.actuators.items():
            with self._blamed(name, has_worked=True):
                actuator.begin(ids)
        self.mark_written(ids)

    def mark_written(self, ids: torch.Tensor) -> None:
        """Mark the state or parameters of the robot in the environments ``ids`` as written, which clears caches."""
        if not any(ids is known for known in self._stale):
            self._stale.append(ids)
        self.data.invalidate()

    def take_stale(self) -> torch.Tensor | None:
        """Return ids (n,) of the environments whose robot state was written since the last call, or None."""
        if not self._stale:
            return None
        ids = self._stale[0] if len(self._stale) == 1 else ids_where(self._stale_rows())
        self._stale = []
        return ids

    def _stale_rows(self) -> torch.Tensor:
        rows = torch.zeros(self._sim.num_envs, dtype=torch.bool, device=self._sim.device)
        for ids in self._stale:
            rows.index_fill_(0, ids, True)
        return rows

    def state_dict(self) -> dict[str, object]:
        return {**super().state_dict(), "stale": self._stale_rows()}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        super().load_state_dict(saved)
        self._has_new_targets = True
        ids = ids_where(saved["stale"])
        self._stale = [ids] if len(ids) else []

    body_names = alias_of("layout.body_names", "Names of the bodies, breadth first.")
    joint_names = alias_of("layout.joint_names", "Names of the joints in the order that terms see.")
    num_instances = alias_of("_sim.num_envs", "Number of environments, N.")
    device = alias_of("_sim.device", "Device of the robot's tensors.")

    @property
    def is_initialized(self) -> bool:
        """Whether the simulations are running."""
        return hasattr(self, "data")

    def find_joints(
        self,
        name_keys: str | Sequence[str],
        joint_subset: Sequence[str] | None = None,
        preserve_order: bool = False,
        *,
        key: str | None = None,
    ) -> tuple[list[int], list[str]]:
        """Return indices and names of matching joints; raise ConfigError if a regular expression matches no joint.

        Indices refer to ``joint_subset`` if given. With ``preserve_order``, the order is that of the expressions. Error
        messages contain ``key``, the config key of the expressions.
        """
        names = self.joint_names if joint_subset is None else joint_subset
        return match_names(name_keys, names, key=key, what="joint", preserve_order=preserve_order)

    def find_bodies(
        self, name_keys: str | Sequence[str], preserve_order: bool = False, *, key: str | None = None
    ) -> tuple[list[int], list[str]]:
        """Return indices and names of matching bodies; raise ConfigError if a regular expression matches no body."""
        return match_names(name_keys, self.body_names, key=key, what="body", preserve_order=preserve_order)

    def write_root_pose_to_sim(self, root_pose: torch.Tensor, env_ids: Ids = None) -> None:
        """Set the pose (n, 7) of the root link."""
        self.require_floating()
        ids, dtype = self._rows(env_ids), self._sim.dtype
        pose = root_pose.to(dtype)
        unit = pose[:, 3:7] / torch.linalg.vector_norm(pose[:, 3:7], dim=1, keepdim=True).clamp_(min=1e-12)
        self._root_qpos.index_copy_(0, ids, torch.cat((pose[:, 0:3], unit), dim=1).expand(ids.shape[0], -1))
        self.mark_written(ids)

    write_root_link_pose_to_sim = write_root_pose_to_sim

    def write_root_com_pose_to_sim(self, root_pose: torch.Tensor, env_ids: Ids = None) -> None:
        """Set the root's pose (n, 7), given as the pose of the root body's centre of mass and principal axes."""
        ids = self._rows(env_ids)
        axes = self.data.body_com_quat_b[ids, 0]
        quat = rotation.quat_mul(root_pose[:, 3:7], axes * axes.new_tensor([1.0, -1.0, -1.0, -1.0]))
        position = root_pose[:, 0:3] - rotation.rotate(rotation.quat_to_matrix(quat), self.data.com_b[ids])
        self.write_root_pose_to_sim(torch.cat((position, quat), dim=1), ids)

    def write_root_velocity_to_sim(self, root_velocity: torch.Tensor, env_ids: Ids = None) -> None:
        """Set the velocity (n, 6) of the root body's centre of mass, given the root's present orientation."""
        self.require_floating()
        ids, dtype = self._rows(env_ids), self._sim.dtype
        velocity = root_velocity.to(dtype)
        matrix = rotation.quat_to_matrix(self._root_qpos.index_select(0, ids)[:, 3:7])
        angular = rotation.rotate_inverse(matrix, velocity[:, 3:6])
        # The link origin's velocity is the CoM's velocity minus R (omega x c), with the CoM at c in the link frame.
        lever = rotation.rotate(matrix, torch.linalg.cross(angular, self.data.com_b.index_select(0, ids).to(dtype)))
        self._write_velocity(ids, velocity[:, 0:3] - lever, angular)

    write_root_com_velocity_to_sim = write_root_velocity_to_sim

    def write_root_link_velocity_to_sim(self, root_velocity: torch.Tensor, env_ids: Ids = None) -> None:
        """Set the velocity (n, 6) of the root link's origin, given the root's present orientation."""
        self.require_floating()
        ids, velocity = self._rows(env_ids), root_velocity.to(self._sim.dtype)
        matrix = rotation.quat_to_matrix(self._root_qpos[ids, 3:7])
        self._write_velocity(ids, velocity[:, 0:3], rotation.rotate_inverse(matrix, velocity[:, 3:6]))

    def _write_velocity(self, ids: torch.Tensor, linear: torch.Tensor, angular: torch.Tensor) -> None:
        """Write the linear velocity of the root link in world axes and its angular velocity in the root link's axes."""
        self._root_qvel.index_copy_(0, ids, torch.cat((linear, angular), dim=1).expand(ids.shape[0], -1))
        self.data.forget_accelerations(ids)
        self.mark_written(ids)

    def write_root_state_to_sim(self, root_state: torch.Tensor, env_ids: Ids = None) -> None:
        """Set the pose of the root link and the velocity of the root body's centre of mass, (n, 13)."""
        self.write_root_pose_to_sim(root_state[:, :7], env_ids)
        self.write_root_velocity_to_sim(root_state[:, 7:], env_ids)

    def write_root_link_state_to_sim(self, root_state: torch.Tensor, env_ids: Ids = None) -> None:
        """Set the pose of the root link and the velocity of the root link's origin, (n, 13)."""
        self.write_root_pose_to_sim(root_state[:, :7], env_ids)
        self.write_root_link_velocity_to_sim(root_state[:, 7:], env_ids)

    def write_root_com_state_to_sim(self, root_state: torch.Tensor, env_ids: Ids = None) -> None:
        """Set the pose and the velocity (n, 13) of the root body's centre of mass."""
        self.write_root_com_pose_to_sim(root_state[:, :7], env_ids)
        self.write_root_velocity_to_sim(root_state[:, 7:], env_ids)

    def write_joint_state_to_sim(
        self, position: torch.Tensor, velocity: torch.Tensor, joint_ids: Ids = None, env_ids: Ids = None
    ) -> None:
        """Set joint positions (n, k), rad, and velocities (n, k), rad/s; reported joint accelerations become 0."""
        self.write_joint_position_to_sim(position, joint_ids, env_ids)
        self.write_joint_velocity_to_sim(velocity, joint_ids, env_ids)

    def write_joint_position_to_sim(self, position: torch.Tensor, joint_ids: Ids = None, env_ids: Ids = None) -> None:
        """Set the positions (n, k) of joints, rad."""
        ids, joints = self._rows(env_ids), columns(joint_ids, self.device)
        self._qpos[ids.unsqueeze(1), self.layout.qpos_ids[joints]] = position.to(self._sim.dtype)
        self.mark_written(ids)

    def write_joint_velocity_to_sim(self, velocity: torch.Tensor, joint_ids: Ids = None, env_ids: Ids = None) -> None:
        """Set joint velocities (n, k), rad/s; the reported accelerations of these joints become 0."""
        ids, joints = self._rows(env_ids), columns(joint_ids, self.device)
        self._qvel[ids.unsqueeze(1), self.layout.dof_ids[joints]] = velocity.to(self._sim.dtype)
        self.data.set_velocity_before(ids, joints, velocity)
        self.data.forget_accelerations(ids)
        self.mark_written(ids)

    def set_joint_position_target(self, target: torch.Tensor, joint_ids: Ids = None, env_ids: Ids = None) -> None:
        """Set the joints' position targets (n, k), rad."""
        self._set_target(self.targets.pos, target, joint_ids, env_ids)

    def set_joint_velocity_target(self, target: torch.Tensor, joint_ids: Ids = None, env_ids: Ids = None) -> None:
        """Set the joints' velocity targets (n, k), rad/s, clipped to the actuators' velocity limits."""
        joints = columns(joint_ids, self.device)
        limit = self.data.soft_joint_vel_limits[:, joints]
        if env_ids is not None:
            limit = limit[self._rows(env_ids)]
        self._set_target(self.targets.vel, torch.clamp(target, -limit, limit), joints, env_ids)

    def set_joint_effort_target(self, target: torch.Tensor, joint_ids: Ids = None, env_ids: Ids = None) -> None:
        """Set the joints' feed-forward efforts (n, k), N·m."""
        self._set_target(self.targets.effort, target, joint_ids, env_ids)

    def _set_target(self, of: torch.Tensor, target: torch.Tensor, joint_ids: Ids, env_ids: Ids) -> None:
        joints = columns(joint_ids, self.device)
        if env_ids is None:
            of[:, joints] = target
        elif isinstance(joints, slice):
            of[self._rows(env_ids), joints] = target
        else:
            of[self._rows(env_ids).unsqueeze(1), joints] = target
        self._has_new_targets = True

    def set_external_force_and_torque(
        self,
        forces: torch.Tensor,
        torques: torch.Tensor,
        positions: torch.Tensor | None = None,
        body_ids: Ids = None,
        env_ids: Ids = None,
        is_global: bool = False,
    ) -> None:
        """Apply forces (n, k, 3), N, and torques (n, k, 3), N·m, to bodies until the next reset of ``env_ids``.

        The forces act at the centres of mass, or at ``positions`` (n, k, 3), m. The arguments are in link frames, or
        with ``is_global`` in world axes; in both cases, forces and torques then rotate with the links.
        """
        if not forces.numel() and not torques.numel():
            forces = torques = torch.zeros(self.num_instances, self.num_bodies, 3, device=self.device)
            body_ids = env_ids = None
        ids = self._rows(env_ids)
        bodies = chosen(body_ids, self.all_body_ids)
        rows = ids.unsqueeze(1)
        if is_global:
            turn = self.data.body_rot_w[rows, bodies].mT
            forces, torques = ((turn @ vector.unsqueeze(-1)).squeeze(-1) for vector in (forces, torques))
            if positions is not None:
                positions = (turn @ (positions - self.data.body_pos_w[rows, bodies]).unsqueeze(-1)).squeeze(-1)
        if positions is not None:
            torques = torques + torch.linalg.cross(positions - self.data.body_com_pos_b[rows, bodies], forces)
        self.set_permanent_wrench(ids, bodies.tolist(), torch.cat((forces, torques), dim=-1))

    def set_permanent_wrench(self, ids: torch.Tensor, body_ids: list[int], wrench: torch.Tensor) -> None:
        """Apply wrenches (n, k, 6) at the bodies' centres of mass, in link axes, until the next reset of ``ids``."""
        columns_of_bodies = wrench.view(ids.shape[0], -1, 2, 3).mT.expand(-1, len(body_ids), -1, -1)
        for body, values in zip(body_ids, columns_of_bodies.unbind(dim=1), strict=True):
            self._wrench[:, body].index_copy_(0, ids, values)
        self._note_wrenches(body_ids)

    def add_wrench(self, body_ids: list[int], wrench: torch.Tensor) -> None:
        """Add forces and torques on bodies: the two columns of (N, k, 3, 2), link axes, at the CoM."""
        self._wrench[:, body_ids] += wrench
        self._note_wrenches(body_ids)

    def _note_wrenches(self, body_ids: list[int]) -> None:
        # Never remove a body from ``_wrench_bodies``, because each change of this tuple needs a new CUDA graph.
        if not set(body_ids) <= set(self._wrench_bodies):
            self._wrench_bodies = tuple(sorted({*self._wrench_bodies, *body_ids}))
        self._sim.asked.add(WRENCHES)

    def update(self, dt: float) -> None:
        """Do nothing, because ``robot.data`` always contains the robot's present state."""
        del dt

    def _rows(self, env_ids: Ids) -> torch.Tensor:
        return chosen(env_ids, self._all_ids)

    def require_floating(self) -> None:
        """Raise ConfigError if the robot has a fixed base."""
        if self.is_fixed_base:
            message = "the robot's base is fixed, so its root cannot be moved"
            raise ConfigError(message, expected="terms that do not move the root, or env.robot.base=floating")

    def write_joint_stiffness_to_sim(self, stiffness: Values, joint_ids: Ids = None, env_ids: Ids = None) -> None:
        """Set the stiffness kp of the joints' actuators, N·m/rad."""
        self._write_gain("stiffness", 1, stiffness, joint_ids, env_ids)

    def write_joint_damping_to_sim(self, damping: Values, joint_ids: Ids = None, env_ids: Ids = None) -> None:
        """Set the damping kd of the joints' actuators, N·m·s/rad."""
        self._write_gain("damping", 2, damping, joint_ids, env_ids)

    def write_joint_effort_limit_to_sim(self, limits: Values, joint_ids: Ids = None, env_ids: Ids = None) -> None:
        """Set the largest torques of the joints' actuators, N·m."""
        ids, joints = self._rows(env_ids), columns(joint_ids, self.device)
        self._assign(self.data.joint_effort_limits, ids, joints, limits)
        for place, values, named in self._write_drives("effort_limit", ids, joints, limits):
            largest = values.clamp(max=_STRONGEST).to(self._sim.dtype)
            field = self._sim.expand("actuator_forcerange")
            both = torch.stack((-largest, largest), dim=2)
            field[ids, place] = torch.where(named.unsqueeze(1), both, field[ids, place])

    def write_joint_velocity_limit_to_sim(self, limits: Values, joint_ids: Ids = None, env_ids: Ids = None) -> None:
        """Set the velocity limits of the joints' actuators, rad/s; velocity targets are clipped to these limits."""
        ids, joints = self._rows(env_ids), columns(joint_ids, self.device)
        self._assign(self.data.soft_joint_vel_limits, ids, joints, limits)
        self._write_drives("velocity_limit", ids, joints, limits)

    def write_joint_armature_to_sim(self, armature: Values, joint_ids: Ids = None, env_ids: Ids = None) -> None:
        """Set reflected rotor inertias, kg·m^2."""
        self._write_dofs("dof_armature", armature, joint_ids, env_ids)
        self._sim.set_const()

    def write_joint_friction_coefficient_to_sim(
        self,
        joint_friction_coeff: Values,
        joint_dynamic_friction_coeff: Values | None = None,
        joint_viscous_friction_coeff: Values | None = None,
        joint_ids: Ids = None,
        env_ids: Ids = None,
    ) -> None:
        """Set joint friction losses, N·m, and viscous frictions, N·m·s/rad; MuJoCo has no separate dynamic friction."""
        del joint_dynamic_friction_coeff
        self._write_dofs("dof_frictionloss", joint_friction_coeff, joint_ids, env_ids)
        if joint_viscous_friction_coeff is not None:
            self.write_joint_viscous_friction_coefficient_to_sim(joint_viscous_friction_coeff, joint_ids, env_ids)

    def write_joint_viscous_friction_coefficient_to_sim(
        self, joint_viscous_friction_coeff: Values, joint_ids: Ids = None, env_ids: Ids = None
    ) -> None:
        """Set passive dampings, N·m·s/rad."""
        self._write_dofs("dof_damping", joint_viscous_friction_coeff, joint_ids, env_ids)

    def write_joint_position_limit_to_sim(
        self, limits: torch.Tensor, joint_ids: Ids = None, env_ids: Ids = None, warn_limit_violation: bool = True
    ) -> None:
        """Set joint limits (n, k, 2), rad, possibly infinite; update the soft limits and clamp default positions."""
        del warn_limit_violation
        ids, joints = self._rows(env_ids), columns(joint_ids, self.device)
        data, sim = self.data, self._sim
        self._assign(data.joint_pos_limits, ids, joints, limits)
        now = data.joint_pos_limits[ids]
        data.soft_joint_pos_limits[ids] = soft_limits(now, self.options.soft_joint_pos_limit_factor)
        data.default_joint_pos[ids] = data.default_joint_pos[ids].clamp(now[..., 0], now[..., 1])
        rows, places = ids.unsqueeze(1), self.layout.joint_ids[joints]
        written = now[:, joints].to(sim.dtype)
        # MuJoCo enables a joint's lower and upper limit together, so a very large number replaces an infinite limit.
        far = 2.0 * math.pi * 1e6
        if sim.may_differ("jnt_limited") or not self.layout.all_limited:
            sim.expand("jnt_limited")[rows, places] = written.isfinite().any(dim=2)
        sim.expand("jnt_range")[rows, places] = written.clamp(-far, far)

    def write_encoder_bias(self, bias: Values, joint_ids: Ids = None, env_ids: Ids = None) -> None:
        """Set the bias of the joints' encoders, which is the reading minus the joint position, rad."""
        self._assign(self.data.encoder_bias, self._rows(env_ids), columns(joint_ids, self.device), bias)
        self._has_new_targets = True
        self.data.invalidate()

    def _write_gain(self, name: str, column: int, values: Values, joint_ids: Ids, env_ids: Ids) -> None:
        ids, joints = self._rows(env_ids), columns(joint_ids, self.device)
        for place, written, named in self._write_drives(name, ids, joints, values):
            field = self._sim.expand("actuator_biasprm")
            field[ids, place, column] = torch.where(named, -written.to(self._sim.dtype), field[ids, place, column])

    def _write_drives(
        self, name: str, ids: torch.Tensor, joints: torch.Tensor | slice, values: Values
    ) -> list[tuple[slice, torch.Tensor, torch.Tensor]]:
        """Set an actuator parameter; return each implicit group's actuators, values (n, k), and mask of joints (k,)."""
        self._has_new_targets = True  # New gains change the MuJoCo controls, even if joint targets are unchanged.
        named = torch.zeros(self.num_joints, dtype=torch.bool, device=self.device)
        named[joints] = True
        spread = torch.zeros(len(ids), self.num_joints, device=self.device)
        spread[:, joints] = values
        start, found = 0, []
        for actuator in self.actuators.values():
            place = slice(start, start := start + len(actuator.joint_names))
            own, theirs, which = getattr(actuator, name), spread[:, actuator.joint_ids], named[actuator.joint_ids]
            own[ids] = torch.where(which, theirs, own[ids])
            if isinstance(actuator, ImplicitActuator):
                found.append((place, theirs, which))
        return found

    def _write_dofs(self, field: str, values: Values, joint_ids: Ids, env_ids: Ids) -> None:
        ids, joints = self._rows(env_ids), columns(joint_ids, self.device)
        if isinstance(values, torch.Tensor):
            values = values.to(self._sim.dtype)
        self._sim.expand(field)[ids.unsqueeze(1), self.layout.dof_ids[joints]] = values

    @staticmethod
    def _assign(of: torch.Tensor, ids: torch.Tensor, joints: torch.Tensor | slice, values: Values) -> None:
        rows = of[ids]
        rows[:, joints] = values
        of[ids] = rows
