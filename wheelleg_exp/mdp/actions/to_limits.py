"""Position targets between the soft limits of the joints."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from wheelleg_exp.constraints import Bounds, Names, Share
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env
from wheelleg_exp.mdp.actions.joint import JointTerm


class JointPositionToLimitsAction(JointTerm):
    """Position targets: ``raw * scale``, clipped, and then [-1, 1] spread over the joints' soft limits.

    Unlike Isaac Lab's, a term of all joints keeps the order of its expressions when asked to.

    Args:
        env: the environment.
        joint_names: expressions of the driven joints.
        scale: factor on the raw action; a number, or one by joint expression.
        clip: bounds of the scaled action by joint expression, before it is spread.
        rescale_to_limits: spread [-1, 1] over the soft limits, beyond which it is cut; else the scaled action is the
            target, rad.
        preserve_order: order of the expressions (True) or of the robot (False).
        asset_name: the member of the scene that has the joints.

    Raises:
        ConfigError: actions are to be spread over the limits of a joint that has none.
    """

    drives = "position"
    settings = (*JointTerm.settings, "_scale")

    def __init__(
        self,
        env: Env,
        joint_names: Names,
        scale: float | Mapping[str, float] = 1.0,
        clip: Mapping[str, Bounds] | None = None,
        rescale_to_limits: bool = True,
        preserve_order: bool = False,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, joint_names, clip, preserve_order, asset_name)
        self._scale = self._spread(scale, 1.0, "scale")
        self._rescale = rescale_to_limits
        if rescale_to_limits and not torch.stack(self._limits()).isfinite().all():
            finite = torch.stack(self._limits()).isfinite().reshape(-1, self.action_dim).all(dim=0)
            free = [name for name, limited in zip(self.joint_names, finite.tolist(), strict=True) if not limited]
            raise ConfigError(
                f"{', '.join(free)} has no limits to spread actions over",
                key="joint_names",
                expected="joints with limits, or rescale_to_limits: false",
            )

    def process_actions(self, actions: torch.Tensor) -> None:
        """Scale, clip and spread raw actions (N, J)."""
        self.raw_actions.copy_(actions)
        torch.mul(actions, self._scale, out=self.processed_actions)
        self._clip()
        if self._rescale:
            low, high = self._limits()
            share = self.processed_actions.clamp(-1.0, 1.0)
            torch.addcmul((low + high) / 2, share, (high - low) / 2, out=self.processed_actions)

    def apply_actions(self) -> None:
        """Set the position targets."""
        self._robot.set_joint_position_target(self.processed_actions, self._ids)

    def _limits(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the present soft limits, rad, (N, J) each."""
        low, high = self._robot.data.soft_joint_pos_limits[..., self._ids, :].unbind(dim=-1)
        return low, high


class EMAJointPositionToLimitsAction(JointPositionToLimitsAction):
    """The same as a moving average: ``target = alpha * now + (1 - alpha) * last target``, within the soft limits.

    The last target of a new episode is the joints' position that it begins with.

    Args:
        env: the environment.
        joint_names: expressions of the driven joints.
        alpha: weight of the newest action, or one by joint expression; joints that no expression names have 1.
        scale: factor on the raw action; a number, or one by joint expression.
        clip: bounds of the scaled action by joint expression, before it is spread.
        rescale_to_limits: spread [-1, 1] over the soft limits; else the scaled action is the target, rad.
        preserve_order: order of the expressions (True) or of the robot (False).
        asset_name: the member of the scene that has the joints.
    """

    settings = (*JointPositionToLimitsAction.settings, "_alpha")

    def __init__(
        self,
        env: Env,
        joint_names: Names,
        alpha: Share | Mapping[str, Share] = 1.0,
        scale: float | Mapping[str, float] = 1.0,
        clip: Mapping[str, Bounds] | None = None,
        rescale_to_limits: bool = True,
        preserve_order: bool = False,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, joint_names, scale, clip, rescale_to_limits, preserve_order, asset_name)
        self._alpha = self._spread(alpha, 1.0, "alpha")
        self._last = torch.zeros_like(self.processed_actions)

    def process_actions(self, actions: torch.Tensor) -> None:
        """Scale, clip, spread and average raw actions (N, J)."""
        super().process_actions(actions)
        average = torch.lerp(self._last, self.processed_actions, self._alpha)
        torch.clamp(average, *self._limits(), out=self.processed_actions)
        self._last.copy_(self.processed_actions)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Begin the average of ``env_ids`` at their joints' positions."""
        super().reset(env_ids)
        self._last[env_ids] = self._robot.data.joint_pos_measured[env_ids][:, self._ids]
