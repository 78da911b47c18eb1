"""The robot's state in Isaac Lab's terms: names, frames and freshness."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch

from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.simulation import Simulation
from wheelleg_exp.sim.state import Kept

if TYPE_CHECKING:
    from wheelleg_exp.sim.robot import Robot


def _derived(compute: Callable[[RobotData], torch.Tensor]) -> property:
    """Make a property that is computed at most once between two changes of the state."""
    name = compute.__name__

    def get(self: RobotData) -> torch.Tensor:
        value = self._cache.get(name)
        if value is None:
            value = self._cache[name] = compute(self)
        return value

    return property(get, doc=compute.__doc__)


class RobotData(Kept):
    """The robot's state: float32, N environments, joints and bodies in the robot's order; always fresh.

    ``_w`` is world axes, ``_b`` axes of the root link. Root linear velocities are of the root body's centre of
    mass unless the name says ``link``; poses are of link frames.
    """

    def __init__(self, robot: Robot, sim: Simulation) -> None:
        model, n, joints = sim.model, sim.num_envs, len(robot.joint_names)
        self._sim = sim
        self._cache: dict[str, torch.Tensor] = {}
        root = model.body(robot.body_names[0])
        self._root_id = int(root.id)
        self._floating = robot.floating
        self._nq = model.nq
        # Positions and velocities stand side by side in a state row.
        start = sim.column("qpos")
        self._motion = sim.state[:, start : start + model.nq + model.nv]
        self._qpos_ids, self._dof_ids = robot.qpos_ids, robot.dof_ids
        self._before = torch.zeros_like(self._motion)
        self._body_ids = torch.tensor([int(model.body(b).id) for b in robot.body_names])
        self._actuators = robot.actuators
        self._actuated = robot.actuator_ids
        self._dt = float(model.opt.timestep)
        self.com_b = torch.from_numpy(root.ipos.copy()).float().expand(n, 3).clone()
        self.default_joint_pos = robot.default_joint_pos.expand(n, joints).clone()
        self.default_joint_vel = robot.default_joint_vel.expand(n, joints).clone()
        self.joint_pos_limits = robot.joint_pos_limits
        self.soft_joint_pos_limits = robot.soft_joint_pos_limits
        self.soft_joint_vel_limits = robot.velocity_limits
        self.joint_effort_limits = robot.effort_limits
        gravity = torch.from_numpy(model.opt.gravity.copy()).float()
        self._gravity_dir = torch.nn.functional.normalize(gravity, dim=0)
        self.joint_pos_target = self.default_joint_pos.clone()
        self.joint_vel_target = torch.zeros(n, joints)
        self.joint_effort_target = torch.zeros(n, joints)
        self._torque_valid = torch.zeros(n, 1)
        self._applied_torque = torch.zeros(n, joints)

    def invalidate(self) -> None:
        """Forget derived quantities; called whenever the state has changed."""
        self._cache.clear()

    def before_step(self) -> None:
        """Keep the motion state that the coming physics step starts from."""
        self._before.copy_(self._motion)

    def set_velocity_before(self, ids: torch.Tensor, joint_ids: torch.Tensor | slice, vel: torch.Tensor) -> None:
        """Let the accelerations (n, k) of written joint velocities count from them."""
        self._before[ids.unsqueeze(1), self._nq + self._dof_ids[joint_ids]] = vel.double()

    def mark_stepped(self) -> None:
        """Note that the last solve belongs to every environment's present episode."""
        self._torque_valid.fill_(1.0)
        self._applied_torque[:, self._actuated] = self._sim.view("actuator_force").float()
        self._cache.clear()

    def reset(self, ids: torch.Tensor) -> None:
        """Report zero torque and acceleration for ``ids`` until their next physics step."""
        self._torque_valid[ids] = 0.0
        self._applied_torque[ids] = 0.0
        self._cache.clear()

    @_derived
    def _state(self) -> torch.Tensor:
        """Return positions and velocities in MuJoCo's order, float32, (N, nq + nv)."""
        return self._motion.float()

    @_derived
    def root_pos_w(self) -> torch.Tensor:
        """Position of the root link, m, (N, 3)."""
        return self._state[:, 0:3] if self._floating else self.body_pos_w[:, 0]

    @_derived
    def root_quat_w(self) -> torch.Tensor:
        """Orientation of the root link (w, x, y, z), (N, 4)."""
        # MuJoCo keeps it a unit quaternion.
        return self._state[:, 3:7] if self._floating else self.body_quat_w[:, 0]

    @_derived
    def root_rot_w(self) -> torch.Tensor:
        """Rotation matrix of the root link, (N, 3, 3)."""
        return rotation.quat_to_matrix(self.root_quat_w)

    @_derived
    def root_link_lin_vel_w(self) -> torch.Tensor:
        """Velocity of the root link's origin, m/s, (N, 3)."""
        if not self._floating:
            return torch.zeros(self._sim.num_envs, 3)
        return self._state[:, self._nq : self._nq + 3]

    @_derived
    def root_ang_vel_b(self) -> torch.Tensor:
        """Angular velocity of the root link in its own axes, rad/s, (N, 3)."""
        if not self._floating:
            return torch.zeros(self._sim.num_envs, 3)
        return self._state[:, self._nq + 3 : self._nq + 6]

    @_derived
    def root_ang_vel_w(self) -> torch.Tensor:
        """Angular velocity of the root link in world axes, rad/s, (N, 3)."""
        return rotation.rotate(self.root_rot_w, self.root_ang_vel_b)

    @_derived
    def root_link_lin_vel_b(self) -> torch.Tensor:
        """Velocity of the root link's origin in link axes, m/s, (N, 3)."""
        return rotation.rotate_inverse(self.root_rot_w, self.root_link_lin_vel_w)

    @_derived
    def root_lin_vel_b(self) -> torch.Tensor:
        """Velocity of the root body's centre of mass in link axes, m/s, (N, 3): v_link + omega x c."""
        return self.root_link_lin_vel_b + torch.linalg.cross(self.root_ang_vel_b, self.com_b)

    @_derived
    def root_lin_vel_w(self) -> torch.Tensor:
        """Velocity of the root body's centre of mass in world axes, m/s, (N, 3)."""
        return rotation.rotate(self.root_rot_w, self.root_lin_vel_b)

    @_derived
    def projected_gravity_b(self) -> torch.Tensor:
        """Unit gravity direction in link axes, (N, 3); upright is (0, 0, -1)."""
        return torch.matmul(self._gravity_dir, self.root_rot_w)

    @_derived
    def heading_w(self) -> torch.Tensor:
        """Yaw of the root link's x axis, rad, (N,)."""
        return torch.atan2(self.root_rot_w[:, 1, 0], self.root_rot_w[:, 0, 0])

    @_derived
    def joint_pos(self) -> torch.Tensor:
        """Joint positions, rad, (N, J)."""
        return self._state.index_select(1, self._qpos_ids)

    @_derived
    def joint_vel(self) -> torch.Tensor:
        """Joint velocities, rad/s, (N, J)."""
        return self._state.index_select(1, self._nq + self._dof_ids)

    @_derived
    def joint_acc(self) -> torch.Tensor:
        """Joint accelerations, rad/s^2, (N, J): finite difference over the last physics step."""
        before = self._before.index_select(1, self._nq + self._dof_ids).float()
        return (self.joint_vel - before) / self._dt * self._torque_valid

    @property
    def applied_torque(self) -> torch.Tensor:
        """Clipped actuator torque at the start of the last physics step, N·m, (N, J); 0 after a reset."""
        return self._applied_torque

    @_derived
    def computed_torque(self) -> torch.Tensor:
        """Unclipped actuator torque at the start of the last physics step, N·m, (N, J); 0 after a reset."""
        before = self._before.float()
        before_pos = before.index_select(1, self._qpos_ids)
        before_vel = before.index_select(1, self._nq + self._dof_ids)
        torque = torch.zeros_like(before_pos)
        for actuator in self._actuators.values():
            ids = actuator.joint_ids
            torque[:, ids] = actuator.computed_torque(self, before_pos[:, ids], before_vel[:, ids])
        return torque * self._torque_valid

    @_derived
    def body_pos_w(self) -> torch.Tensor:
        """Positions of the link frames, m, (N, B, 3)."""
        return self._sim.derived("xpos")[:, self._body_ids].float()

    @_derived
    def body_quat_w(self) -> torch.Tensor:
        """Orientations of the link frames (w, x, y, z), (N, B, 4)."""
        return self._sim.derived("xquat")[:, self._body_ids].float()

    @_derived
    def body_rot_w(self) -> torch.Tensor:
        """Rotation matrices of the links, (N, B, 3, 3)."""
        return self._sim.derived("xmat")[:, self._body_ids].unflatten(-1, (3, 3)).float()

    @_derived
    def body_ang_vel_w(self) -> torch.Tensor:
        """Angular velocities of the links, rad/s, (N, B, 3)."""
        return self._sim.derived("cvel")[:, self._body_ids, 0:3].float()

    @_derived
    def body_lin_vel_w(self) -> torch.Tensor:
        """Velocities of the links' centres of mass, m/s, (N, B, 3).

        MuJoCo's ``cvel`` is referenced to the centre of mass of the kinematic tree; it is shifted here.
        """
        velocity = self._sim.derived("cvel")[:, self._body_ids]
        tree_com = self._sim.derived("subtree_com")[:, self._root_id].unsqueeze(1)
        offset = self._sim.derived("xipos")[:, self._body_ids] - tree_com
        return (velocity[..., 3:6] + torch.linalg.cross(velocity[..., 0:3], offset)).float()
