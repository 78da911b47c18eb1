"""Pose commands: a position to drive to, a pose for one body, height and tilt of the base, and a jump."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import torch

from wheelleg_exp.constraints import Broken, Interval, Positive, PositiveInterval, Share, relation
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import CommandTerm, Env, SceneEntityCfg, member
from wheelleg_exp.mdp.commands.command_ranges import RangedCommand, command_of
from wheelleg_exp.mdp.commands.velocity_commands import UniformVelocityTravelCommand
from wheelleg_exp.mdp.root_motion import HeightOverWheels, height_over_ground, roll_pitch
from wheelleg_exp.sim import rotation
from wheelleg_exp.sim.class_members import alias_of
from wheelleg_exp.sim.ids import fill_rows
from wheelleg_exp.sim.timers import may_be_due
from wheelleg_exp.state.stateful import Stateful

_Place = Literal["pos_x", "pos_y", "heading"]
_Pose = Literal["pos_x", "pos_y", "pos_z", "roll", "pitch", "yaw"]
_Bump = Literal["stopped_share", "stopped_s", "wait_s", "back", "run_up", "before_s"]


def _heading_has_a_range(simple_heading: bool, ranges: Mapping[str, object]) -> Iterator[Broken]:
    if not simple_heading and ranges.get("heading") is None:
        yield Broken("ranges.heading", "the range is missing", "[low, high] in radians, or simple_heading: true")


@relation(_heading_has_a_range)
class UniformPose2dCommand(RangedCommand):
    """A position near the environment's origin and a heading, in the base's yaw axes: (x, y, z) in m, rad.

    The position has the root height of the default state. The first ``compute`` after a draw converts the command to
    the base's axes. The metrics are the last errors: distance in the plane, m, and heading, rad.

    Args:
        ranges: ``pos_x`` and ``pos_y``, relative to the environment's origin, m, and ``heading`` in world axes, rad.
        simple_heading: face the position, or away from it, whichever needs the smaller turn; else headings are drawn.
    """

    logs_last_error = True

    def __init__(
        self,
        env: Env,
        ranges: Mapping[_Place, Interval | None],
        resampling_time_range: PositiveInterval,
        simple_heading: bool,
        generator: torch.Generator,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, resampling_time_range, ("error_pos_2d", "error_heading"), generator)
        self.robot = member(env.scene, asset_name, "asset_name")
        self.take_ranges(ranges, get_args(_Place))
        self._simple_heading = simple_heading
        n, device = env.num_envs, env.device
        self.pos_command_w = self.buffer("pos_command_w", torch.zeros(n, 3, device=device))
        self.heading_command_w = self.buffer("heading_command_w", torch.zeros(n, device=device))
        self._command = self.buffer("_command", torch.zeros(n, 4, device=device))

    @property
    def command(self) -> torch.Tensor:
        """The present command (N, 4): vector to the position in the base's yaw axes, m, and remaining turn, rad."""
        return self._command

    @property
    def pos_command_b(self) -> torch.Tensor:
        """Vector from the base to the commanded position, m, (N, 3), in axes that turn with the base's yaw only."""
        return self._command[:, :3]

    @property
    def heading_command_b(self) -> torch.Tensor:
        """The remaining turn, rad, (N,)."""
        return self._command[:, 3]

    def errors(self) -> torch.Tensor:
        """Return the horizontal distance to the commanded position, m, and the absolute heading error, rad, (2, N)."""
        data = self.robot.data
        distance = torch.linalg.vector_norm(self.pos_command_w[:, :2] - data.root_pos_w[:, :2], dim=1)
        return torch.stack((distance, rotation.wrap_to_pi(self.heading_command_w - data.heading_w).abs()))

    def draw(self, env_ids: torch.Tensor) -> None:
        drawn = rotation.uniform(*self.bounds(), len(env_ids), self._generator)
        self.pos_command_w[env_ids] = self._places(env_ids, drawn[:, :2])
        self.pos_command_w[env_ids, 2] += self.robot.data.default_root_state[env_ids, 2]
        heading = drawn[:, 2]
        if self._simple_heading:  # Drive towards or away from the position, whichever needs less turning.
            x, y, _ = (self.pos_command_w[env_ids] - self.robot.data.root_pos_w[env_ids]).unbind(dim=1)
            forth = torch.atan2(y, x)
            back = rotation.wrap_to_pi(forth + torch.pi)
            turns = (rotation.wrap_to_pi(yaw - self.robot.data.heading_w[env_ids]).abs() for yaw in (forth, back))
            heading = torch.where(torch.lt(*turns), forth, back)
        self.heading_command_w[env_ids] = heading

    def post_process(self) -> None:
        data = self.robot.data
        x, y, z = (self.pos_command_w - data.root_pos_w).unbind(dim=1)
        cos, sin = data.heading_w.cos(), data.heading_w.sin()
        turn = rotation.wrap_to_pi(self.heading_command_w - data.heading_w)
        torch.stack((cos * x + sin * y, cos * y - sin * x, z, turn), dim=1, out=self._command)

    def _places(self, env_ids: torch.Tensor, drawn: torch.Tensor) -> torch.Tensor:
        places = self._env.scene.env_origins[env_ids]
        places[:, :2] += drawn
        return places


class TerrainBasedPose2dCommand(UniformPose2dCommand):
    """A ``UniformPose2dCommand`` whose position is a random flat patch (``target``) of the environment's terrain tile.

    Args:
        ranges: ``heading`` in world axes, rad.
    """

    def __init__(
        self,
        env: Env,
        resampling_time_range: PositiveInterval,
        simple_heading: bool,
        generator: torch.Generator,
        ranges: Mapping[Literal["heading"], Interval | None],
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, ranges, resampling_time_range, simple_heading, generator, asset_name)  # type: ignore[arg-type]
        patches = env.scene.terrain.flat_patches
        if "target" not in patches:
            expected = "flat patches 'target' in env.scene.terrain"
            expected += f", which has {', '.join(patches)}" if patches else ""
            message = "the terrain has no flat patches named 'target', which this command needs"
            raise ConfigError(message, expected=expected)
        self._patches = patches["target"]

    def _places(self, env_ids: torch.Tensor, drawn: torch.Tensor) -> torch.Tensor:
        del drawn
        patches, terrain = self._patches, self._env.scene.terrain
        size, device = (len(env_ids),), patches.device
        chosen = torch.randint(patches.shape[2], size, generator=self._generator, device=device)
        return patches[terrain.terrain_levels[env_ids], terrain.terrain_types[env_ids], chosen]


class UniformPoseCommand(RangedCommand):
    """A pose of one body in the root link's frame: (x, y, z) in m and (w, x, y, z), uniform in ranges.

    The metrics are the last errors of the body's pose: distance, m, and angle, rad.

    Args:
        body_name: expression of the one body.
        ranges: ``pos_x``, ``pos_y``, ``pos_z``, m, ``roll``, ``pitch``, ``yaw``, rad; R = Rz(yaw) Ry(pitch) Rx(roll).
        make_quat_unique: choose the quaternion whose w is not negative.
    """

    logs_last_error = True

    def __init__(
        self,
        env: Env,
        body_name: str,
        ranges: Mapping[_Pose, Interval],
        resampling_time_range: PositiveInterval,
        generator: torch.Generator,
        make_quat_unique: bool = False,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, resampling_time_range, ("position_error", "orientation_error"), generator)
        self.robot = member(env.scene, asset_name, "asset_name")
        found, names = self.robot.find_bodies(body_name, key="body_name")
        if len(found) != 1:
            raise ConfigError(f"body_name matches {', '.join(names)}", key="body_name", expected="one body")
        self._body, self.body_name = found[0], names[0]
        self.take_ranges(ranges, get_args(_Pose))
        self._unique = make_quat_unique
        self.pose_command_b = self.buffer("pose_command_b", torch.zeros(env.num_envs, 7, device=env.device))
        self.pose_command_b[:, 3] = 1.0

    @property
    def command(self) -> torch.Tensor:
        """The present command (N, 7): position, m, and orientation (w, x, y, z) in the root link's frame."""
        return self.pose_command_b

    def errors(self) -> torch.Tensor:
        """Return the distance, m, and the angle, rad, between a body's pose and the commanded pose, (2, N)."""
        data, command = self.robot.data, self.pose_command_b
        place = data.root_pos_w + rotation.rotate(rotation.quat_to_matrix(data.root_quat_w), command[:, :3])
        distance = torch.linalg.vector_norm(place - data.body_pos_w[:, self._body], dim=1)
        wanted = rotation.quat_mul(data.root_quat_w, command[:, 3:])
        present = data.body_quat_w[:, self._body]
        # The dot product of two unit quaternions is cos(angle / 2).
        # For small angles, atan2(sin, cos) is more accurate than acos(cos).
        cos = (wanted * present).sum(dim=1).abs()
        sin = torch.linalg.vector_norm(wanted - present * (wanted * present).sum(dim=1, keepdim=True), dim=1)
        return torch.stack((distance, 2.0 * torch.atan2(sin, cos)))

    def draw(self, env_ids: torch.Tensor) -> None:
        drawn = rotation.uniform(*self.bounds(), len(env_ids), self._generator)
        quat = rotation.quat_from_euler_xyz(*drawn[:, 3:].unbind(dim=1))
        if self._unique:
            quat = torch.where(quat[:, :1] < 0.0, -quat, quat)
        self.pose_command_b[env_ids] = torch.cat((drawn[:, :3], quat), dim=1)


_Axis = Literal["height", "roll", "pitch"]


def _height_is_given(ranges: Mapping[str, object]) -> Iterator[Broken]:
    if "height" not in ranges:
        yield Broken("ranges.height", "the range is missing", "[low, high] in metres above the ground")


@relation(_height_is_given)
class UniformBasePoseCommand(RangedCommand):
    """Commands the base's height above the ground (m), roll (rad), and pitch (rad), drawn uniformly from ranges.

    Rewards can compare the command with ``measured``, the base's present height, roll and pitch.

    Args:
        ranges: ``height`` of the root link above the ground, m; ``roll`` and ``pitch``, rad, are 0 if missing.
    """

    def __init__(
        self,
        env: Env,
        ranges: Mapping[_Axis, Interval],
        resampling_time_range: PositiveInterval,
        generator: torch.Generator,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, resampling_time_range, [f"error_{axis}" for axis in get_args(_Axis)], generator)
        self.robot = member(env.scene, asset_name, "asset_name")
        self.take_ranges(ranges, get_args(_Axis))
        self._command = self.buffer("_command", torch.zeros(env.num_envs, 3, device=env.device))

    command = alias_of("_command", "The present command (N, 3): height, m, roll and pitch, rad.")

    def measured(self) -> torch.Tensor:
        """Return the base's current height above the ground (m), roll (rad), and pitch (rad), shape (N, 3)."""
        data = self.robot.data
        tilt = roll_pitch(data.projected_gravity_b)
        return torch.stack((height_over_ground(self._env, data.root_pos_w), *tilt), dim=1)

    def errors(self) -> torch.Tensor:
        """Return the absolute errors of the base's height (m), roll (rad), and pitch (rad), shape (3, N)."""
        return (self._command - self.measured()).abs().T

    def draw(self, env_ids: torch.Tensor) -> None:
        self._command[env_ids] = rotation.uniform(*self.bounds(), len(env_ids), self._generator)


class WheeledBasePoseCommand(UniformBasePoseCommand):
    """A base pose command that also integrates the error of the height that a wheeled robot measures. Not in Isaac Lab.

    A policy that observes the error and its integral (``observations.height_error``) need not infer its height.

    Args:
        wheel_cfg: joints of the wheels that stand on the ground.
        wheel_radius: radius of the wheels, m.
        max_height_error: bound of the integrated error, m·s.

    Attributes:
        integrated_error: integral of the measured minus the commanded height over the episode, m·s, (N,).
    """

    def __init__(
        self,
        env: Env,
        ranges: Mapping[_Axis, Interval],
        resampling_time_range: PositiveInterval,
        generator: torch.Generator,
        wheel_cfg: SceneEntityCfg,
        wheel_radius: Positive,
        max_height_error: Positive,
        asset_name: str = "robot",
    ) -> None:
        super().__init__(env, ranges, resampling_time_range, generator, asset_name)
        wheels = member(env.scene, wheel_cfg.name, "wheel_cfg.name")
        self.height_over_wheels = HeightOverWheels(env.scene.sim.model, wheels, wheel_cfg.joint_ids, wheel_radius)
        self.max_height_error = max_height_error
        self.integrated_error = self.buffer("integrated_error", torch.zeros(env.num_envs, device=env.device))

    def height_error(self) -> torch.Tensor:
        """Return the measured minus the commanded height, m, (N,)."""
        return (self.height_over_wheels() - self._command[:, 0]).float()

    def compute(self, dt: float) -> torch.Tensor:
        most = self.max_height_error
        self.integrated_error.add_(self.height_error() * dt).clamp_(-most, most)
        return super().compute(dt)

    def finish_episode(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        fill_rows(self.integrated_error, env_ids, 0.0)
        return super().finish_episode(env_ids)


_FOLLOW, _BACK, _RUN_UP, _OVER = range(4)  # The phases of ``BumpTrigger``.


@dataclass(frozen=True)
class Bump:
    """How a robot without a scanner jumps onto a step that stopped its wheels.

    Attributes:
        stopped_share: wheels have stopped if they are slower than this share of the commanded speed.
        stopped_s: time for which they must be so slow, s.
        wait_s: time at a constant command, without a jump, before slow wheels count, s.
        back: distance from the step at which the robot turns around, m; more than run_up²/(2a), if a is the limit on
            the command's change. 0.35 m is about one second at 0.3 m/s.
        run_up: speed before the jump, m/s; one at which the policy learned to jump.
        before_s: time between the jump's command and the step, s; depends on the policy.
    """

    stopped_share: float = 0.35
    stopped_s: float = 0.06
    wait_s: float = 1.0
    back: float = 0.35
    run_up: float = 0.3
    before_s: float = 0.11


class BumpTrigger(Stateful):
    """Backs up from a step that stopped the wheels, runs up to it, and asks for a jump.

    The place of the step follows from the rotation of the wheels. Until the jump has ended, the speed of the velocity
    command ``travel`` is replaced; a user who stops or turns around ends the phases.
    """

    def __init__(self, env: Env, travel: str, bump: Bump) -> None:
        self._env, self._name, self._bump = env, travel, bump
        zeros = torch.zeros(env.num_envs, device=env.device)
        self.phase = self.buffer("phase", zeros.long(), fill=_FOLLOW)
        self._way = self.buffer("_way", zeros.clone(), fill=0.0)  # 1 forwards, -1 backwards, 0 standing
        self._waited = self.buffer("_waited", zeros.clone(), fill=0.0)  # s at a constant command
        self._slow = self.buffer("_slow", zeros.clone(), fill=0.0)  # s with slow wheels
        self._ahead = self.buffer("_ahead", zeros.clone(), fill=0.0)  # m to the place of the bump
        self._speed = self.buffer("_speed", zeros.clone(), fill=0.0)  # commanded, m/s

    def start(self) -> None:
        """Follow the user from the present command on."""
        self.reset_rows(torch.arange(len(self._speed), device=self._speed.device))
        self._speed.copy_(self._env.command_manager.get_command(self._name)[:, 0])

    def step(self, is_jumping: torch.Tensor) -> torch.Tensor:
        """Set the commanded speed, and return a mask of the robots that must start a jump, (N,)."""
        bump, phase, dt = self._bump, self.phase, self._env.step_dt
        skill = "measure how far the wheels roll"
        travel = command_of(self._env, self._name, UniformVelocityTravelCommand, skill, "velocity_command")
        asked, rolled = travel.asked[:, 0], travel.rolled
        way = asked.sign()
        phase.masked_fill_((way != self._way) | ((phase == _OVER) & ~is_jumping), _FOLLOW)
        self._way.copy_(way)
        self._ahead.sub_(way * rolled * dt)
        # Wheels that follow a changing command, or that are in the air, are slow, too.
        is_steady = ((self._wanted(asked) - self._speed).abs() < 1e-6) & ~is_jumping & (way != 0.0)
        self._waited.add_(dt).masked_fill_(~is_steady, 0.0)
        is_slow = (self._speed.sign() * rolled < bump.stopped_share * self._speed.abs()) & (self._waited > bump.wait_s)
        self._slow.add_(dt).masked_fill_(~is_slow, 0.0)
        bumped = self._slow >= bump.stopped_s
        self._waited.masked_fill_(bumped, 0.0)
        self._ahead.masked_fill_(bumped & (phase != _BACK), 0.0)
        is_far = (phase == _BACK) & (bumped | (self._ahead >= bump.back))  # or something is behind the robot
        phase.masked_fill_(bumped, _BACK)
        phase.masked_fill_(is_far, _RUN_UP)
        jumps = (phase == _RUN_UP) & (self._ahead <= bump.before_s * bump.run_up) & ~is_jumping
        phase.masked_fill_(jumps, _OVER)
        self._speed.add_((self._wanted(asked) - self._speed).clamp(-travel.fastest, travel.fastest))
        travel.command[:, 0] = self._speed
        travel.command[:, 2].masked_fill_(phase != _FOLLOW, 0.0)  # straight back, and straight to the step
        return jumps

    def _wanted(self, asked: torch.Tensor) -> torch.Tensor:
        """Return the speed of the present phase, m/s, (N,); ``asked`` is the speed that the user commands."""
        run_up = asked.sign() * self._bump.run_up
        return torch.where(self.phase == _FOLLOW, asked, torch.where(self.phase == _BACK, -run_up, run_up))


def _is_possible(
    window_s: float, resampling_time_range: PositiveInterval, trigger: str, velocity_command: str | None
) -> Iterator[Broken]:
    shortest = resampling_time_range[0]
    if window_s >= shortest:
        yield Broken("window_s", "the robot would have to jump all the time", f"less than {shortest:g} s")
    if trigger == "bump" and velocity_command is None:
        message = "a robot that jumps after a bump must drive back and run up"
        yield Broken("velocity_command", message, "the name of a velocity command")


@relation(_is_possible)
class JumpCommand(CommandTerm):
    """Commands a jump in the last ``window_s`` seconds before the next draw, and before steps up. Not in Isaac Lab.

    A jump before a step starts if the terrain rises by more than ``rise`` from the base to the point that the base
    reaches after ``ahead_s`` seconds at the commanded speed, also on a slope. With ``trigger: bump``, the robot does
    not know the terrain: a step stops its wheels, and the robot then jumps onto it.

    Args:
        window_s: time in which the robot must jump, s.
        heights: range of the commanded clearance of the wheels, m. A jump before a step, or one that a user starts, has
            the largest value. null: no height is commanded.
        rel_jumping_envs: share of draws with a jump.
        velocity_command: name of a velocity command before this one; null means no jumps before steps.
        ahead_s: time until the base reaches the point ahead, s.
        rise: smallest rise of the ground before which a jump is commanded, m.
        trigger: ``step``: the terrain ahead starts a jump; ``bump``: stopped wheels.
        bump: settings of the trigger ``bump``; missing ones are those of ``Bump``.

    Attributes:
        share: present share of draws with a jump; can be changed during a run.
        heights: clearance that the next or present jump must reach, m, (N, 1), or (N, 0) without commanded heights.
        highest: largest height of ``heights``, m, 0 without heights.
        trigger: what starts jumps at present; ``select_trigger`` changes it.
        bump_settings: settings of the trigger ``bump``, also if ``trigger`` is ``step``.
    """

    def __init__(
        self,
        env: Env,
        resampling_time_range: PositiveInterval,
        generator: torch.Generator,
        window_s: Positive,
        rel_jumping_envs: Share = 1.0,
        velocity_command: str | None = None,
        ahead_s: Positive = 0.22,
        rise: Positive = 0.004,
        trigger: Literal["step", "bump"] = "step",
        bump: Mapping[_Bump, Positive] | None = None,
        heights: PositiveInterval | None = None,
    ) -> None:
        super().__init__(env, resampling_time_range, (), generator)
        self.window_s, self.share = window_s, rel_jumping_envs
        self.bump_settings = Bump(**{str(key): value for key, value in (bump or {}).items()})
        self.velocity_command, self._ahead_s, self._rise = velocity_command, ahead_s, rise
        self.trigger = self.setting("trigger", trigger)
        self.bump = self.child("bump", self._bump_trigger() if trigger == "bump" else None)
        is_jumping_env = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        self.is_jumping_env = self.buffer("is_jumping_env", is_jumping_env)
        width = 0 if heights is None else 1
        self._lowest, self.highest = heights or (0.0, 0.0)
        self.heights = self.buffer("heights", torch.zeros(env.num_envs, width, device=env.device))
        self._command = self.buffer("_command", torch.zeros(env.num_envs, 1 + width, device=env.device))

    @property
    def command(self) -> torch.Tensor:
        """The remaining share of the time to jump, and the height of the jump, m; 0 outside the window.

        The shape is (N, 2), or (N, 1) without commanded heights. The share is 1 at the start of the window.
        """
        return self._command

    def errors(self) -> torch.Tensor:
        return self.error_sums

    def draw(self, env_ids: torch.Tensor) -> None:
        u = torch.rand(len(env_ids), generator=self._generator, device=self._command.device)
        self.is_jumping_env[env_ids] = u < self.share
        size = (len(env_ids), self.heights.shape[1])
        u = torch.rand(size, generator=self._generator, device=self._command.device)
        self.heights[env_ids] = self._lowest + (self.highest - self._lowest) * u
        self._command.index_fill_(0, env_ids, 0.0)

    def _bump_trigger(self) -> BumpTrigger:
        return BumpTrigger(self._env, self.velocity_command or "", self.bump_settings)

    def select_trigger(self, trigger: Literal["step", "bump"]) -> None:
        """Change what starts jumps; the commanded speed continues from its present value."""
        if trigger == "bump":
            self.bump = self.child("bump", self.bump or self._bump_trigger())
            self.bump.start()
        self.trigger = trigger

    def start(self, where: torch.Tensor) -> None:
        """Start a jump in the environments of the mask ``where``, (N,)."""
        self.is_jumping_env.logical_or_(where)
        self.time_left.masked_fill_(where, self.window_s)
        self.heights.masked_fill_(where.unsqueeze(1), self.highest)
        self._show()

    def finish_episode(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        if self.bump is not None:
            self.bump.reset_rows(env_ids)
        return super().finish_episode(env_ids)

    def may_expire(self, dt: float) -> bool:
        return may_be_due(self.time_left, self.window_s, dt)

    def post_process(self) -> None:
        if self.trigger == "bump" and self.bump is not None:
            self.start(self.bump.step(self._command[:, 0] > 0.0))
        elif self.velocity_command is not None:
            data, height_at = self._env.scene["robot"].data, self._env.scene.terrain.height_at
            way = self._env.command_manager.get_command(self.velocity_command)[:, :1] * self._ahead_s
            forwards = torch.stack((torch.cos(data.heading_w), torch.sin(data.heading_w)), dim=1)
            here = data.root_pos_w[:, :2]
            is_before_step = height_at(here + forwards * way) - height_at(here) > self._rise
            self.start(is_before_step & (self._command[:, 0] == 0.0))
        self._show()

    def _show(self) -> None:
        """Compute the command from the time that is left and the height."""
        left = (self.time_left / self.window_s).clamp(min=0.0)
        self._command[:, 0] = left.masked_fill(~self.is_jumping_env | (left > 1.0), 0.0)
        self._command[:, 1:] = self.heights * (self._command[:, :1] > 0.0)
