"""Run a policy in N parallel episodes without resets; metrics ignore the steps after the end of an episode."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping

import torch

from wheelleg_exp.env import ManagerBasedRLEnv, Observations
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.evaluation.evaluation_env import parts_of
from wheelleg_exp.evaluation.protocol_options import Jump, Protocol
from wheelleg_exp.evaluation.scenarios import Scenarios
from wheelleg_exp.evaluation.trajectories import EffortMeter, Trajectories
from wheelleg_exp.managers import Env
from wheelleg_exp.mdp.commands import JumpCommand, UniformBasePoseCommand, UniformVelocityCommand


class HeldCommand:
    """Replaces the random draws of a velocity command by fixed values; raises ConfigError for other commands."""

    def __init__(self, env: Env, name: str) -> None:
        term = env.command_manager.get_term(name)
        if not isinstance(term, UniformVelocityCommand):
            expected = "a wheelleg_exp.mdp.commands.UniformVelocityCommand, or a subclass"
            raise ConfigError(f"'{name}' is not a velocity command term", key=f"env.commands.{name}", expected=expected)
        self._term = term
        self._held = torch.zeros(env.num_envs, 3, device=env.device)
        setattr(term, "draw", self._draw)  # noqa: B010

    @property
    def command(self) -> torch.Tensor:
        """The commanded velocities v_x, v_y in m/s and w_z in rad/s, (N, 3), before the command's rate limit."""
        return self._term.asked

    def hold(self, command: torch.Tensor) -> None:
        """Set the commanded velocities (N, 3), which a reset of the environment does not change."""
        self._held.copy_(command)
        self._draw(torch.arange(len(command), device=command.device))

    def _draw(self, env_ids: torch.Tensor) -> None:
        self._term.asked[env_ids] = self._held[env_ids]
        self._term.is_standing_env[env_ids] = (self._held[env_ids] == 0.0).all(dim=1)


def hold_heights_and_jumps(env: Env, scenarios: Scenarios, options: Jump | None) -> None:
    """Replace the random draws of commanded base poses and jumps by the values of a test.

    The default pose is the middle of the task's range. Without ``options``, the robot does not jump. A missing command
    raises ConfigError.
    """
    terms = [env.command_manager.get_term(name) for name in env.command_manager.active_terms]
    poses = [term for term in terms if isinstance(term, UniformBasePoseCommand)]
    jumps = [term for term in terms if isinstance(term, JumpCommand)]
    for test, found, kind in (("height", poses, "UniformBasePoseCommand"), ("jump", jumps, "JumpCommand")):
        if scenarios.test == test and not found:
            raise ConfigError(f"the task commands no {test}", key="env.commands", expected=f"a {kind}")
    for pose in poses:
        low, high = pose.bounds()
        held = ((low + high) / 2).repeat(env.num_envs, 1)
        if scenarios.heights:
            held[:, 0] = scenarios.height_of().to(held.device)

        def draw_pose(env_ids: torch.Tensor, pose: UniformBasePoseCommand = pose, held: torch.Tensor = held) -> None:
            pose.command[env_ids] = held[env_ids]

        setattr(pose, "draw", draw_pose)  # noqa: B010
    for jump in jumps:

        def draw_jump(env_ids: torch.Tensor, jump: JumpCommand = jump) -> None:
            jump.time_left.index_fill_(0, env_ids, options.at_s + jump.window_s if options else math.inf)
            jump.heights[env_ids] = options.height if options else 0.0
            jump.is_jumping_env[env_ids] = jump.command_counter[env_ids] == 0
            jump.command.index_fill_(0, env_ids, 0.0)

        setattr(jump, "draw", draw_jump)  # noqa: B010


Policy = Callable[[Mapping[str, object]], torch.Tensor]
Progress = Callable[[int, int], None]
Disturb = Callable[[int], None]

# An evaluation ends an episode if the robot tilts too far, or if a state or an action is not finite.
FALLEN, NOT_FINITE, NOT_FINITE_ACTION = "tilt", "not finite", "action not finite"


class Rollout:
    """Runs policies in fixed scenarios, always from the same start states.

    ``endings`` names the causes that can end an episode: the task's terminations, then those that the rollout adds.
    ``starts`` is the sha256 of the start states and the randomised values in the last rollout.
    """

    def __init__(self, env: ManagerBasedRLEnv, scenarios: Scenarios, protocol: Protocol) -> None:
        self.env, self.scenarios, self.parts, self.starts = env, scenarios, parts_of(env), ""
        self._held = HeldCommand(env, protocol.command)
        hold_heights_and_jumps(env, scenarios, protocol.jump if scenarios.test == "jump" else None)
        # A robot that gets up starts with any tilt, and may fall back.
        self._fall_tilt = math.inf if scenarios.test == "get_up" else protocol.fall_tilt
        self._force = protocol.contact_force
        self._meter = EffortMeter(env, protocol.saturation, protocol.torque_deadband, env.physics_dt)
        self._settle_steps = round(protocol.settle_s / env.step_dt)
        self._commands = scenarios.commands().to(env.device)
        self._begins = [round(moment / env.step_dt) for moment in scenarios.times]
        self.steps = max(1, round(scenarios.horizon_s / env.step_dt))
        self.endings = (*env.termination_manager.active_terms, FALLEN, NOT_FINITE, NOT_FINITE_ACTION)

    def start(self, seed: int) -> Observations:
        """Reset every environment with the random streams of ``seed``, and return the first observations."""
        self._held.hold(self._commands[:, 0])
        observations, _ = self.env.reset(seed)
        self._meter.start()
        sim = self.env.scene.sim
        digest = hashlib.sha256(sim.motion.cpu().numpy().tobytes())
        wrench = self.env.scene.robot.permanent_wrench
        for name, value in (*sorted(sim.expanded.items()), ("wrench", wrench)):
            digest.update(name.encode() + b"\0" + value.cpu().contiguous().numpy().tobytes())
        self.starts = digest.hexdigest()
        return observations

    @torch.inference_mode()
    def roll(
        self, policy: Policy, seed: int, progress: Progress | None = None, disturb: Disturb | None = None
    ) -> Trajectories:
        """Run a policy from the start states of ``seed`` until the scenarios' end, or until every episode has ended.

        The policy maps observations by group to raw actions (N, A). ``progress`` is called with the numbers of finished
        and of all steps after each control step, and ``disturb`` with the number of the step before it. A push acts at
        the end of the previous step, as Isaac Lab's interval events do in training. The next observation and the
        previous step's stored state therefore show the push, and the policy's next action can react to it.
        """
        env = self.env
        observations = self.start(seed)
        if hasattr(policy, "reset"):
            policy.reset()
        made = Trajectories.empty(self.steps, env.num_envs, self.parts, env.action_manager.total_action_dim, env)
        alive = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
        segment, observers = 0, env.observers
        if disturb is not None:
            disturb(0)
            env.observers = [*observers, lambda: disturb(step + 1)]
        for step in range(self.steps):
            actions = policy(observations)
            numbers = torch.isfinite(actions).all(dim=1)
            # Robots with an ended episode or NaN actions get zero actions, because their simulation continues.
            actions = torch.where((alive & numbers).unsqueeze(1), actions, 0.0)
            command = self._held.command.clone()
            if segment + 1 < len(self._begins) and step + 1 >= self._begins[segment + 1]:
                segment += 1
                # Change the velocity command before a control step, so that its observation contains the new command.
                self._held.hold(self._commands[:, segment])
            self._meter.begin(step > self._settle_steps)
            observations, *_ = env.step(actions)
            failed, why = self._failed(numbers)
            alive = alive & ~failed
            made.alive[step], made.command[step], made.action[step] = alive, command, actions
            self._store_motion(made, step)
            first = failed & (made.fell_at == 0)  # Ignore later failures of the same episode.
            made.ended_by = torch.where(first, why, made.ended_by)
            made.fell_at = torch.where(first, step + 1, made.fell_at)
            if progress is not None:
                progress(step + 1, self.steps)
            if not bool(alive.any()):
                break
        env.observers = observers
        return made

    def _store_motion(self, made: Trajectories, step: int) -> None:
        """Store the states of all robots after one control step."""
        scene, parts, meter = self.env.scene, self.parts, self._meter
        data = scene.robot.data
        pos, gravity = data.root_pos_w, data.projected_gravity_b
        made.pos[step] = pos - scene.env_origins
        made.height[step] = pos[:, 2] - scene.terrain.height_at(pos[:, :2])
        made.roll[step] = torch.atan2(-gravity[:, 1], -gravity[:, 2])
        made.pitch[step] = torch.asin(gravity[:, 0].clamp(-1.0, 1.0))
        made.yaw[step] = data.heading_w
        made.vel[step], made.ang[step] = data.root_lin_vel_b, data.root_ang_vel_b
        made.joint_pos[step], made.joint_vel[step] = data.joint_pos, data.joint_vel
        made.torque[step], made.torque_rms[step] = data.applied_torque, meter.torque_rms()
        made.sign_changes[step] = meter.sign_changes[:, parts.wheels]
        forces = scene[parts.contacts].data.net_forces_w[:, parts.wheel_links]
        axles = data.body_pos_w[:, parts.wheel_bodies]
        made.clearance[step] = axles[..., 2] - scene.terrain.height_at(axles[..., :2]) - parts.wheel_radius
        made.down[step] = (torch.linalg.vector_norm(forces, dim=-1) > self._force).any(dim=-1)
        made.work[step] = torch.stack((meter.gross, meter.net, meter.positive, meter.peak), dim=1)
        made.saturated[step] = meter.shares()

    def _failed(self, numbers: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the mask of the episodes that failed in the last step, and the causes as indices in ``endings``."""
        env, manager = self.env, self.env.termination_manager
        tilted = torch.acos((-env.scene.robot.data.projected_gravity_b[:, 2]).clamp(-1.0, 1.0)) > self._fall_tilt
        # If a simulation state is NaN or inf, the termination manager ends the episode without a termination term.
        not_finite = manager.terminated & ~manager.fired.any(dim=0)
        not_finite = not_finite | env.scene.unstable()
        failed = manager.terminated | tilted | not_finite | ~numbers
        fired = torch.cat((manager.fired, torch.stack((tilted, not_finite, ~numbers))))
        return failed, fired.long().argmax(dim=0)
