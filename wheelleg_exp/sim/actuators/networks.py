"""Learned drives: networks that were trained on what a real drive does.

The network's file lies beside the robot's (``NETWORKS``), to which it is copied from the user's asset folders; a run
keeps it with its robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import torch

from wheelleg_exp.constraints import Names, Natural, NotEmpty, PathBelow, Positive
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.paths import NETWORKS
from wheelleg_exp.sim.actuators.base import Delay, LimitPerJoint, PerJoint, Stream
from wheelleg_exp.sim.actuators.motors import DCMotor
from wheelleg_exp.sim.actuators.network_file import Network
from wheelleg_exp.sim.ids import fill_rows
from wheelleg_exp.sim.layout import JointTargets

if TYPE_CHECKING:
    from wheelleg_exp.sim.data import RobotData


class ActuatorNet(DCMotor):
    """A drive whose torque a network gives, within a motor's torque-speed line; it has no gains, they are NaN."""

    network: Network

    def __init__(
        self,
        joint_names_expr: Names,
        network_file: PathBelow,
        effort_limit: LimitPerJoint,
        velocity_limit: LimitPerJoint,
        saturation_effort: Positive,
        armature: PerJoint | None = None,
        delay: Delay | None = None,
    ) -> None:
        limits = (effort_limit, velocity_limit, saturation_effort)
        super().__init__(joint_names_expr, math.nan, math.nan, *limits, armature, delay)
        self._file = network_file

    def read_files(self, folder: Path, key: str, device: torch.device) -> None:
        """Read the network; ConfigError when it is none."""
        self.network = Network(folder / NETWORKS / self._file, f"{key}.network_file", device)

    def _motion(self, targets: JointTargets, data: RobotData) -> tuple[torch.Tensor, torch.Tensor]:
        """Return how far the joints are from their target positions, rad, and their speeds, rad/s, (N, k)."""
        ids = self.joint_ids
        return targets.pos[:, ids] - data.joint_pos[:, ids], data.joint_vel[:, ids]


class ActuatorNetMLP(ActuatorNet):
    """A perceptron on position errors and speeds of the present and of earlier physics steps (Hwangbo et al., 2019).

    The network gets (rows, 2 len(input_idx)) numbers, a row a joint, and gives one. Before the first step of an episode
    errors and speeds were 0. Target speeds and feed-forward efforts do not act.

    Args:
        joint_names_expr: expressions of the joints in the group.
        network_file: the TorchScript file, below an asset folder.
        effort_limit: largest torque at any speed, N·m.
        velocity_limit: speed at which the motor has no torque left, rad/s.
        saturation_effort: torque at standstill that the motor's line starts from, N·m.
        pos_scale: factor on position errors.
        vel_scale: factor on speeds.
        torque_scale: factor on what the network gives, N·m.
        input_order: errors before speeds, or speeds before errors.
        input_idx: which physics steps the network sees; 0 is the present one, 1 the one before.
        armature: reflected rotor inertia, kg·m^2; null keeps the asset's.
        delay: fewest and most physics steps by which the targets come late; null is none.
    """

    settings = (*ActuatorNet.settings, "_steps")

    def __init__(
        self,
        joint_names_expr: Names,
        network_file: PathBelow,
        effort_limit: LimitPerJoint,
        velocity_limit: LimitPerJoint,
        saturation_effort: Positive,
        pos_scale: float,
        vel_scale: float,
        torque_scale: float,
        input_order: Literal["pos_vel", "vel_pos"],
        input_idx: Annotated[Sequence[Natural], NotEmpty()],
        armature: PerJoint | None = None,
        delay: Delay | None = None,
    ) -> None:
        limits = (effort_limit, velocity_limit, saturation_effort)
        super().__init__(joint_names_expr, network_file, *limits, armature, delay)
        self._scales = (pos_scale, vel_scale, torque_scale)
        self._swapped = input_order == "vel_pos"
        self._input_idx = list(input_idx)

    def connect(self, num_envs: int, dt: float, stream: Stream) -> None:
        """Allocate the past, and try the network."""
        super().connect(num_envs, dt, stream)
        device, width = self.joint_ids.device, len(self._input_idx)
        self._steps = torch.tensor(self._input_idx, device=device)
        self._past = torch.zeros(num_envs, max(self._input_idx) + 1, 2, len(self.joint_names), device=device)
        self.network.tried(torch.zeros(2, 2 * width, device=device), count=2)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forget the past of ``env_ids``."""
        fill_rows(self._past, env_ids, 0.0)

    def _torque(self, targets: JointTargets, data: RobotData) -> torch.Tensor:
        """Return what the network gives, N·m."""
        error, speed = self._motion(targets, data)
        now = torch.stack((error, speed), dim=1).unsqueeze(1)
        self._past.copy_(torch.cat((now, self._past[:, :-1]), dim=1))
        seen = self._past[:, self._steps].permute(0, 3, 2, 1)  # (N, k, error or speed, steps)
        pos, vel = seen[:, :, 0] * self._scales[0], seen[:, :, 1] * self._scales[1]
        inputs = torch.cat((vel, pos) if self._swapped else (pos, vel), dim=2)
        return self.network(inputs.flatten(0, 1)).view_as(error) * self._scales[2]


class ActuatorNetLSTM(ActuatorNet):
    """An LSTM on position errors and speeds, whose memory stands for what was before (Rudin et al., 2022).

    The network has an LSTM named ``lstm``, batch first; it gets (rows, 1, 2) numbers, a row a joint, and its memory,
    and gives one number, N·m, and the memory. Memories are 0 at the beginning of an episode. Target speeds and
    feed-forward efforts do not act.

    Args:
        joint_names_expr: expressions of the joints in the group.
        network_file: the TorchScript file, below an asset folder.
        effort_limit: largest torque at any speed, N·m.
        velocity_limit: speed at which the motor has no torque left, rad/s.
        saturation_effort: torque at standstill that the motor's line starts from, N·m.
        armature: reflected rotor inertia, kg·m^2; null keeps the asset's.
        delay: fewest and most physics steps by which the targets come late; null is none.
    """

    def read_files(self, folder: Path, key: str, device: torch.device) -> None:
        """Read the network; ConfigError when it is none, or has no LSTM."""
        super().read_files(folder, key, device)
        layers = [value for name, value in self.network.weights().items() if name.startswith("lstm.weight_hh_l")]
        if not layers:
            raise ConfigError(
                "the network has no LSTM that is named 'lstm'",
                key=f"{key}.network_file",
                expected="one, batch first, whose memory goes in and out",
            )
        self._layers, self._width = len(layers), int(layers[0].shape[1])

    def connect(self, num_envs: int, dt: float, stream: Stream) -> None:
        """Allocate the memory, and try the network."""
        super().connect(num_envs, dt, stream)
        device, count = self.joint_ids.device, len(self.joint_names)
        self._rows = (self._layers, num_envs, count, self._width)
        self._hidden = torch.zeros(self._layers, num_envs * count, self._width, device=device)
        self._cell = torch.zeros_like(self._hidden)
        few = torch.zeros(2, self._layers, 2, self._width, device=device)
        self.network.tried(torch.zeros(2, 1, 2, device=device), (few[0], few[1]), count=2)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Forget what was before in ``env_ids``."""
        for memory in (self._hidden, self._cell):
            fill_rows(memory.view(self._rows).transpose(0, 1), env_ids, 0.0)

    def _torque(self, targets: JointTargets, data: RobotData) -> torch.Tensor:
        """Return what the network gives, N·m."""
        error, speed = self._motion(targets, data)
        inputs = torch.stack((error.flatten(), speed.flatten()), dim=1).unsqueeze(1)
        torque, (hidden, cell) = self.network(inputs, (self._hidden, self._cell))
        self._hidden.copy_(hidden)
        self._cell.copy_(cell)
        return torque.view_as(error)
