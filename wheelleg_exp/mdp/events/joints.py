"""What the joints and their drives are: gains, friction, armatures, limits, and where encoders read zero."""

from __future__ import annotations

import torch

from wheelleg_exp.constraints import Interval, relation
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env, SceneEntityCfg, TermBase
from wheelleg_exp.mdp.events.draws import Distribution, Operation, Pair, all_ids, draw, operate, ranges

_ROBOT = SceneEntityCfg("robot")


@relation(ranges(above_0=["stiffness_distribution_params"], at_least_0=["damping_distribution_params"]))
def randomize_actuator_gains(
    env: Env,
    env_ids: torch.Tensor | None,
    generator: torch.Generator,
    stiffness_distribution_params: Pair | None = None,
    damping_distribution_params: Pair | None = None,
    operation: Operation = "abs",
    distribution: Distribution = "uniform",
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Change stiffness (N·m/rad) and damping (N·m·s/rad) of actuators from what the config gave, joint by joint.

    What would fall below 0 becomes 0. Gains of learned drives, which have none, stay NaN.
    """
    robot, ids = env.scene[asset_cfg.name], all_ids(env, env_ids)
    data, joints = robot.data, asset_cfg.joint_ids
    for params, default, write in (
        (stiffness_distribution_params, data.default_joint_stiffness, robot.write_joint_stiffness_to_sim),
        (damping_distribution_params, data.default_joint_damping, robot.write_joint_damping_to_sim),
    ):
        if params is not None:
            before = default[ids][:, joints]
            drawn = draw(params[0], params[1], before.shape, distribution, generator)
            write(operate(before, drawn, operation).clamp(min=0.0), joints, ids)


@relation(
    ranges(
        at_least_0=["friction_distribution_params", "armature_distribution_params"],
        free=["lower_limit_distribution_params", "upper_limit_distribution_params"],
    )
)
class randomize_joint_parameters(TermBase):
    """Change friction, armature and position limits of joints from what the model has, joint by joint.

    As in Isaac Lab, the range of friction holds for the joint's friction loss (N·m) and, drawn by itself, for its
    viscous friction (N·m·s/rad); what would fall below 0 becomes 0, and so does an armature. With the limits go the
    soft limits, and default positions are clamped to them.

    Args:
        env: the environment.
        generator: the term's random stream.
        friction_distribution_params: of friction loss and viscous friction; null leaves both.
        armature_distribution_params: kg·m^2; null leaves it.
        lower_limit_distribution_params: rad; null leaves it.
        upper_limit_distribution_params: rad; null leaves it.
        operation: what is done with the model's value.
        distribution: ``gaussian`` takes [mean, standard deviation], the others [low, high].
        asset_cfg: the joints.

    Raises:
        ConfigError: a lower limit could be drawn above the upper one.
    """

    def __init__(
        self,
        env: Env,
        generator: torch.Generator,
        friction_distribution_params: Pair | None = None,
        armature_distribution_params: Pair | None = None,
        lower_limit_distribution_params: Pair | None = None,
        upper_limit_distribution_params: Pair | None = None,
        operation: Operation = "abs",
        distribution: Distribution = "uniform",
        asset_cfg: SceneEntityCfg = _ROBOT,
    ) -> None:
        self._robot, self._joints = env.scene[asset_cfg.name], asset_cfg
        self._friction, self._armature = friction_distribution_params, armature_distribution_params
        self._limits = (lower_limit_distribution_params, upper_limit_distribution_params)
        self._operation, self._distribution, self._generator = operation, distribution, generator
        if any(self._limits) and distribution != "gaussian":
            self._require_order()

    def _require_order(self) -> None:
        lower, upper = self._robot.data.default_joint_pos_limits[0, self._joints.joint_ids].unbind(dim=1)
        highest = torch.maximum(*self._ends(lower, self._limits[0]))
        lowest = torch.minimum(*self._ends(upper, self._limits[1]))
        if (highest > lowest).any():
            first = int((highest > lowest).nonzero()[0])
            raise ConfigError(
                f"a lower limit of up to {highest[first]:g} rad could pass an upper one of {lowest[first]:g} rad",
                expected="limits that stay in order, whatever is drawn",
            )

    def _ends(self, default: torch.Tensor, params: Pair | None) -> tuple[torch.Tensor, torch.Tensor]:
        if params is None:
            return default, default
        low, high = (operate(default, torch.full_like(default, end), self._operation) for end in params)
        return low, high

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        """Draw and write."""
        ids, joints, robot = all_ids(env, env_ids), self._joints.joint_ids, self._robot
        data = robot.data
        if self._friction is not None:
            friction = self._drawn(data.default_joint_friction_coeff[ids][:, joints], self._friction).clamp(min=0.0)
            viscous = self._drawn(data.default_joint_viscous_friction_coeff[ids][:, joints], self._friction)
            robot.write_joint_friction_coefficient_to_sim(friction, None, viscous.clamp(min=0.0), joints, ids)
        if self._armature is not None:
            armature = self._drawn(data.default_joint_armature[ids][:, joints], self._armature)
            robot.write_joint_armature_to_sim(armature.clamp(min=0.0), joints, ids)
        if any(self._limits):
            lower, upper = (
                default if params is None else self._drawn(default, params)
                for default, params in zip(
                    data.default_joint_pos_limits[ids][:, joints].unbind(dim=2), self._limits, strict=True
                )
            )
            limits = torch.stack((lower, torch.maximum(lower, upper)), dim=2)
            robot.write_joint_position_limit_to_sim(limits, joints, ids, warn_limit_violation=False)

    def _drawn(self, default: torch.Tensor, params: Pair) -> torch.Tensor:
        drawn = draw(params[0], params[1], default.shape, self._distribution, self._generator)
        return operate(default, drawn, self._operation)


class randomize_encoder_bias(TermBase):
    """Draw by how much each joint's encoder reads too much, rad: what is measured is position + bias.

    The drives hold what they measure at their targets, so that the joint itself ends up short of them by the bias.
    Observations show what is measured (``joint_pos`` and ``joint_pos_rel`` unless ``measured: false``), actions that
    start from the present position begin at the measured one; rewards and terminations see the joint itself.

    Args:
        env: the environment.
        bias_range: [low, high], rad, drawn for each joint.
        generator: the term's random stream.
        asset_cfg: the joints.
    """

    def __init__(
        self, env: Env, bias_range: Interval, generator: torch.Generator, asset_cfg: SceneEntityCfg = _ROBOT
    ) -> None:
        self._robot, self._joints = env.scene[asset_cfg.name], asset_cfg
        self._low, self._high = bias_range
        self._generator = generator
        self._robot.data.has_encoder_bias = True

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        """Draw the biases of ``env_ids``."""
        ids, joints = all_ids(env, env_ids), self._joints.joint_ids
        shape = self._robot.data.encoder_bias[ids][:, joints].shape
        drawn = draw(self._low, self._high, shape, "uniform", self._generator)
        self._robot.write_encoder_bias(drawn, joints, ids)
