"""Action terms: the targets that a policy's output sets, scaled, offset, and clipped; ``delay`` is in physics steps."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from wheelleg_exp.constraints import Bounds, Names, Share
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import ActionTerm, Env, member
from wheelleg_exp.sim.ids import narrowed
from wheelleg_exp.sim.names import valueless_errors, values_by_name


class JointTerm(ActionTerm):
    """Base class of joint actions; ``drives`` names the kind of the joint targets: position, velocity, or effort.

    Args:
        joint_names: expressions of the driven joints.
        clip: bounds of the processed action by joint expression, [low, high].
        preserve_order: order of the expressions (true) or of the robot (false).
        asset_name: the member of the scene that has the joints.
        width: number of components of the action; None means one per joint.
    """

    def __init__(
        self,
        env: Env,
        joint_names: Names,
        clip: Mapping[str, Bounds] | None,
        preserve_order: bool,
        asset_name: str,
        width: int | None = None,
    ) -> None:
        self._robot = member(env.scene, asset_name, "asset_name")
        indices, self.joint_names = self._robot.find_joints(joint_names, None, preserve_order, key="joint_names")
        self.action_dim = len(indices) if width is None else width
        self._ids = narrowed(indices, env.device)
        bounds = None if clip is None else self._spread(clip, (-torch.inf, torch.inf), "clip")
        self._low: torch.Tensor | None
        self._high: torch.Tensor | None
        self._low, self._high = (None, None) if bounds is None else (bounds[:, 0], bounds[:, 1])
        raw = torch.zeros(env.num_envs, self.action_dim, device=env.device)
        self.raw_actions = self.buffer("raw_actions", raw, fill=0.0)
        processed = torch.zeros(env.num_envs, len(indices), device=env.device)
        self.processed_actions = self.buffer("processed_actions", processed)

    def reset(self, env_ids: torch.Tensor) -> None:
        """Set the raw actions of ``env_ids`` to zero; as in Isaac Lab, the processed actions do not change."""
        self.reset_rows(env_ids)

    def _set_targets(self) -> None:
        getattr(self._robot, f"set_joint_{self.drives}_target")(self.processed_actions, self._ids)

    def _clip(self) -> None:
        if self._low is not None:
            torch.clamp(self.processed_actions, self._low, self._high, out=self.processed_actions)

    def _spread(self, values: float | Mapping[str, object], default: object, name: str) -> torch.Tensor:
        spread = values_by_name(values, self.joint_names, default, key=name, what="joint")
        return torch.tensor(spread, dtype=torch.float32, device=self._robot.device)


class JointAction(JointTerm):
    """An affine joint action, ``processed = clip(raw * scale + offset)``.

    Args:
        scale: factor on the raw action; a number, or one by joint expression.
        offset: added after scaling; a number, or one by joint expression.
    """

    def __init__(
        self,
        env: Env,
        joint_names: Names,
        scale: float | Mapping[str, float] = 1.0,
        offset: float | Mapping[str, float] = 0.0,
        clip: Mapping[str, Bounds] | None = None,
        preserve_order: bool = False,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, joint_names, clip, preserve_order, asset_name)
        self._scale = self._spread(scale, 1.0, "scale")
        self._offset = self._spread(offset, 0.0, "offset").expand(env.num_envs, -1).clone()

    def process_actions(self, actions: torch.Tensor) -> None:
        self.raw_actions.copy_(actions)
        torch.addcmul(self._offset, actions, self._scale, out=self.processed_actions)
        self._clip()

    def raw_for(self, processed: torch.Tensor) -> torch.Tensor:
        """Return the raw actions (N, action_dim) that would give the processed actions (N, J) without clipping."""
        return (processed - self._offset) / self._scale


class _DefaultOffsetAction(JointAction):
    """An affine joint action whose offset can be the joints' default positions or velocities."""

    @property
    def applies_once(self) -> bool:
        """Whether joint targets are constant during a control step; always False in user-defined subclasses."""
        return type(self).__module__ == __name__

    def __init__(
        self,
        env: Env,
        joint_names: Names,
        scale: float | Mapping[str, float] = 1.0,
        offset: float | Mapping[str, float] = 0.0,
        clip: Mapping[str, Bounds] | None = None,
        preserve_order: bool = False,
        use_default_offset: bool = True,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, joint_names, scale, offset, clip, preserve_order, asset_name)
        if use_default_offset:
            data = self._robot.data
            default = data.default_joint_pos if self.drives == "position" else data.default_joint_vel
            self._offset.copy_(default[:, self._ids])


class JointPositionAction(_DefaultOffsetAction):
    """Position targets, rad.

    Args:
        scale: rad per unit of action.
        offset: rad; ignored with ``use_default_offset``.
        clip: bounds of the target, not of the raw action, by joint expression, rad.
        use_default_offset: use the default joint positions as the offset.
    """

    drives = "position"
    apply_actions = JointTerm._set_targets


class RelativeJointPositionAction(JointAction):
    """Joint position targets relative to the present joint positions, which are read at each physics step.

    Args:
        scale: rad per unit of action.
        offset: rad; ignored with ``use_zero_offset``.
        clip: bounds of the relative target by joint expression, rad.
        use_zero_offset: use no offset.
    """

    drives = "position"

    def __init__(
        self,
        env: Env,
        joint_names: Names,
        scale: float | Mapping[str, float] = 1.0,
        offset: float | Mapping[str, float] = 0.0,
        clip: Mapping[str, Bounds] | None = None,
        preserve_order: bool = False,
        use_zero_offset: bool = True,
        asset_name: str = "robot",
    ) -> None:
        given = 0.0 if use_zero_offset else offset
        super().__init__(env, joint_names, scale, given, clip, preserve_order, asset_name)

    def apply_actions(self) -> None:
        target = self._robot.data.joint_pos_measured[:, self._ids] + self.processed_actions
        self._robot.set_joint_position_target(target, self._ids)


class JointVelocityAction(_DefaultOffsetAction):
    """Velocity targets of joints, rad/s. Joint velocity targets are clipped to the actuators' velocity limits.

    Args:
        scale: rad/s per unit of action.
        offset: rad/s; ignored with ``use_default_offset``.
        clip: bounds of the target, not of the raw action, by joint expression, rad/s.
        use_default_offset: use the default joint velocities as the offset.
    """

    drives = "velocity"
    apply_actions = JointTerm._set_targets


class JointEffortAction(JointAction):
    """Feed-forward efforts, N·m.

    Args:
        scale: N·m per unit of action.
        offset: N·m.
        clip: bounds of the effort by joint expression, N·m.
    """

    drives = "effort"
    apply_actions = JointTerm._set_targets


class JointPositionToLimitsAction(JointTerm):
    """Position targets: the clipped ``raw * scale`` is mapped from [-1, 1] to the joints' soft limits.

    Unlike in Isaac Lab, ``preserve_order`` has an effect even if the term drives all joints.

    Args:
        scale: factor on the raw action; a number, or one by joint expression.
        clip: bounds of the scaled action by joint expression, before the mapping to limits.
        rescale_to_limits: clamp to [-1, 1] and map to the soft limits; else the scaled action is the target, rad.
    """

    drives = "position"
    apply_actions = JointTerm._set_targets

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
            message = f"{', '.join(free)} has no limits to map actions to"
            raise ConfigError(message, key="joint_names", expected="joints with limits, or rescale_to_limits: false")

    def process_actions(self, actions: torch.Tensor) -> None:
        self.raw_actions.copy_(actions)
        torch.mul(actions, self._scale, out=self.processed_actions)
        self._clip()
        if self._rescale:
            low, high = self._limits()
            share = self.processed_actions.clamp(-1.0, 1.0)
            torch.addcmul((low + high) / 2, share, (high - low) / 2, out=self.processed_actions)

    def _limits(self) -> tuple[torch.Tensor, torch.Tensor]:
        low, high = self._robot.data.soft_joint_pos_limits[..., self._ids, :].unbind(dim=-1)
        return low, high


class EMAJointPositionToLimitsAction(JointPositionToLimitsAction):
    """A ``JointPositionToLimitsAction`` with smoothed joint targets, ``target = alpha * new + (1 - alpha) * last``.

    The smoothed targets are clamped to the soft limits. In an episode's first step, ``last`` is the present position.

    Args:
        alpha: weight of the newest action, or one by joint expression; 1 for joints that no expression matches.
    """

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
        self._last = self.buffer("_last", torch.zeros_like(self.processed_actions))

    def process_actions(self, actions: torch.Tensor) -> None:
        super().process_actions(actions)
        average = torch.lerp(self._last, self.processed_actions, self._alpha)
        torch.clamp(average, *self._limits(), out=self.processed_actions)
        self._last.copy_(self.processed_actions)

    def reset(self, env_ids: torch.Tensor) -> None:
        super().reset(env_ids)
        self._last[env_ids] = self._robot.data.joint_pos_measured[env_ids][:, self._ids]


class BinaryJointAction(JointTerm):
    """One number for all joints: the joints close if the number is below 0, otherwise they open.

    Args:
        open_command_expr: target of each joint when open, by joint expression.
        close_command_expr: target of each joint when closed, by joint expression.
    """

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
        for name, values in (("open_command_expr", open_command_expr), ("close_command_expr", close_command_expr)):
            for error in valueless_errors(values, self.joint_names, name):
                raise error
        self._open = self._spread(open_command_expr, 0.0, "open_command_expr")
        self._close = self._spread(close_command_expr, 0.0, "close_command_expr")

    def process_actions(self, actions: torch.Tensor) -> None:
        self.raw_actions.copy_(actions)
        torch.where(self.opens(actions), self._open, self._close, out=self.processed_actions)
        self._clip()

    def opens(self, actions: torch.Tensor) -> torch.Tensor:
        """Return a mask (N, 1) that is True where the raw action (N, 1) selects ``open_command_expr``."""
        return ~(actions < 0.0)


class BinaryJointPositionAction(BinaryJointAction):
    """One of two position targets, rad: the joints close if the action is below 0, otherwise they open."""

    drives = "position"
    apply_actions = JointTerm._set_targets


class BinaryJointVelocityAction(BinaryJointAction):
    """One of two velocity targets, rad/s: the joints close if the action is below 0, otherwise they open."""

    drives = "velocity"
    apply_actions = JointTerm._set_targets


class AbsBinaryJointPositionAction(BinaryJointPositionAction):
    """Select one of two joint position targets, rad, by a threshold on the raw action.

    Args:
        open_command_expr: target of each joint when open, rad, by joint expression.
        close_command_expr: target of each joint when closed, rad, by joint expression.
        threshold: raw action at which the selection changes.
        positive_threshold: whether the joints open above the threshold (True) or below it (False).
        clip: bounds of the targets by joint expression, rad.
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
        return actions > self._threshold if self._positive else actions < self._threshold
