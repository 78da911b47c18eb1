"""Actions of one number that choose between two targets."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from wheelleg_exp.constraints import Bounds, Names
from wheelleg_exp.managers import Env
from wheelleg_exp.mdp.actions.joint import JointTerm
from wheelleg_exp.sim.names import valueless_errors


class BinaryJointAction(JointTerm):
    """One number for all joints: below 0 they close, else they open.

    Args:
        env: the environment.
        joint_names: expressions of the driven joints.
        open_command_expr: target of each joint when open, by joint expression.
        close_command_expr: target of each joint when closed, by joint expression.
        clip: bounds of the targets by joint expression.
        preserve_order: order of the expressions (True) or of the robot (False).
        asset_name: the member of the scene that has the joints.

    Raises:
        ConfigError: a joint lacks one of its two targets.
    """

    settings = (*JointTerm.settings, "_open", "_close")

    def __init__(
        self,
        env: Env,
        joint_names: Names,
        open_command_expr: Mapping[str, float],
        close_command_expr: Mapping[str, float],
        clip: Mapping[str, Bounds] | None = None,
        preserve_order: bool = False,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, joint_names, clip, preserve_order, asset_name, width=1)
        self._open = self._command(open_command_expr, "open_command_expr")
        self._close = self._command(close_command_expr, "close_command_expr")

    def process_actions(self, actions: torch.Tensor) -> None:
        """Choose the targets by raw actions (N, 1)."""
        self.raw_actions.copy_(actions)
        torch.where(self.opens(actions), self._open, self._close, out=self.processed_actions)
        self._clip()

    def opens(self, actions: torch.Tensor) -> torch.Tensor:
        """Return which raw actions (N, 1) open."""
        return ~(actions < 0.0)

    def _command(self, values: Mapping[str, float], key: str) -> torch.Tensor:
        for error in valueless_errors(values, self.joint_names, key):
            raise error
        return self._spread(values, 0.0, key)


class BinaryJointPositionAction(BinaryJointAction):
    """One of two position targets, rad: below 0 the joints close, else they open."""

    drives = "position"

    def apply_actions(self) -> None:
        """Set the position targets."""
        self._robot.set_joint_position_target(self.processed_actions, self._ids)


class BinaryJointVelocityAction(BinaryJointAction):
    """One of two velocity targets, rad/s: below 0 the joints close, else they open."""

    drives = "velocity"

    def apply_actions(self) -> None:
        """Set the velocity targets."""
        self._robot.set_joint_velocity_target(self.processed_actions, self._ids)


class AbsBinaryJointPositionAction(BinaryJointPositionAction):
    """One of two position targets, rad, by a threshold.

    Args:
        env: the environment.
        joint_names: expressions of the driven joints.
        open_command_expr: target of each joint when open, rad, by joint expression.
        close_command_expr: target of each joint when closed, rad, by joint expression.
        threshold: raw action at which the choice changes.
        positive_threshold: whether it opens above the threshold (True) or below it (False).
        clip: bounds of the targets by joint expression, rad.
        preserve_order: order of the expressions (True) or of the robot (False).
        asset_name: the member of the scene that has the joints.
    """

    def __init__(
        self,
        env: Env,
        joint_names: Names,
        open_command_expr: Mapping[str, float],
        close_command_expr: Mapping[str, float],
        threshold: float = 0.5,
        positive_threshold: bool = True,
        clip: Mapping[str, Bounds] | None = None,
        preserve_order: bool = False,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, joint_names, open_command_expr, close_command_expr, clip, preserve_order, asset_name)
        self._threshold, self._positive = threshold, positive_threshold

    def opens(self, actions: torch.Tensor) -> torch.Tensor:
        """Return which raw actions (N, 1) open."""
        return actions > self._threshold if self._positive else actions < self._threshold
