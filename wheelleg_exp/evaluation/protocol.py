"""Evaluate a policy in all tests of an evaluation protocol, each test in its own environment."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.evaluation import disturbance_tests, motion_columns, protocol_options, scenarios
from wheelleg_exp.evaluation.evaluation_env import build, evaluation_options, on_ground, target_heights
from wheelleg_exp.evaluation.metric_catalogue import POSTURE, Array, figure, measured, metrics_of
from wheelleg_exp.evaluation.motion_columns import Columns, Motion
from wheelleg_exp.evaluation.policy_rollout import Policy, Rollout
from wheelleg_exp.evaluation.policy_rollout import Progress as RolloutProgress
from wheelleg_exp.evaluation.result import Evaluation, Figure
from wheelleg_exp.evaluation.scenarios import Scenarios
from wheelleg_exp.evaluation.trajectories import Trajectories
from wheelleg_exp.sim.options import EnvOptions, read_env
from wheelleg_exp.terms.config_sections import read_section

_UNMEASURED = Figure(math.nan, math.nan, math.nan, 0, better="higher")
MakePolicy = Callable[[ManagerBasedRLEnv], Policy]
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Subject:
    """The inputs of an evaluation: a policy, its task, the evaluation protocol, and the seed of the start states."""

    env: EnvOptions
    mjcf: Path
    make_policy: MakePolicy
    protocol: protocol_options.Protocol
    seed: int
    progress: Progress | None = None

    def options(self, table: Scenarios) -> EnvOptions:
        """Return the environment's options with one environment for each episode of a table of test scenarios."""
        protocol, env = self.protocol, self.env
        if table.test == "bump":
            jump = {**env.commands["jump"], "trigger": "bump", "velocity_command": protocol.command}
            env = replace(env, commands={**env.commands, "jump": jump})
        return evaluation_options(env, protocol, table.size, table.horizon_s, protocol.ground)

    def skips(self, table: Scenarios) -> bool:
        """Return whether a test is left out, because the task lacks the jump or travel command that it needs."""
        wanted = {"jump": ".JumpCommand", self.protocol.command: ".UniformVelocityTravelCommand"}
        nodes = {name: self.env.commands.get(name) or {} for name in wanted}
        return table.test == "bump" and not all(
            str(node.get("_target_")).endswith(wanted[name]) for name, node in nodes.items()
        )

    def rollout(self, table: Scenarios, env: EnvOptions) -> Rollout:
        """Build an environment that simulates all episodes of a table of test scenarios in parallel."""
        return Rollout(build(env, self.mjcf, self.seed), table, self.protocol)

    def progress_of(self, test: str) -> RolloutProgress | None:
        """Return the progress callback for one test of an evaluation protocol."""
        progress = self.progress
        return None if progress is None else lambda done, of: progress(test, done, of)

    @property
    def target(self) -> float | None:
        """The target height of the base, m: the protocol's, else that of the first reward with one, else None."""
        heights = [node["target_height"] for node in target_heights(self.env).values()]
        found = heights[0] if self.protocol.target_height is None and heights else self.protocol.target_height
        return None if found is None else float(found)


def evaluate(
    env_cfg: EnvOptions | Mapping[str, object],
    mjcf: Path,
    make_policy: MakePolicy,
    protocol: Mapping[str, object],
    seed: int | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Run a policy in the scenarios of an evaluation protocol and compute the protocol's metrics.

    ``env_cfg`` and ``protocol`` are config sections. ``make_policy`` takes an environment and returns a policy, which
    maps observations by group to raw actions (N, A), and whose method ``reset`` is called before each rollout if it
    exists. ``progress`` is called with the name of a test, the number of finished control steps, and that of all steps.
    """
    options = read_section(protocol_options.Protocol, protocol, "protocol")
    seed = options.seed if seed is None else seed
    subject = Subject(read_env(env_cfg), mjcf, make_policy, options, seed, progress)
    tables = _tables(options)
    parts = [_run(subject, table) for table in tables if not subject.skips(table)]
    if not parts:
        raise ConfigError("the task has no jump command", key="env.commands", expected="a JumpCommand named jump")
    found = {f"{table.test}/success": _UNMEASURED for table in tables if subject.skips(table)}
    for part in parts:
        for metric in metrics_of(part.test, part.columns, protocol):
            found[metric.name] = figure(metric, part.columns, seed, options.resamples)
    starts, episodes = {part.test: part.starts for part in parts}, joined([part.columns for part in parts])
    odd = list(dict.fromkeys(text for part in parts for text in part.robot_differences))
    about_robot = parts[0].about | ({"robot_differences": odd} if odd else {})
    digest = hashlib.sha256("".join(table.digest(seed) for table in tables).encode()).hexdigest()
    return Evaluation(dict(protocol), seed, digest, starts, episodes, found, about_robot)


def metric_names(env: Mapping[str, object], mjcf: Path, protocol: Mapping[str, object]) -> list[str]:
    """Return the names of the metrics of ``evaluate`` without a simulation; ConfigError if the task lacks a command."""
    options, found = read_section(protocol_options.Protocol, protocol, "protocol"), list[str]()
    subject = Subject(read_env(env), mjcf, lambda _: lambda _: torch.empty(0), options, options.seed)
    for table in _tables(options):
        if subject.skips(table):
            found.append(f"{table.test}/success")
            continue
        rollout = _placed(subject, replace(table, episodes=1))
        width = rollout.env.action_manager.total_action_dim
        made = Trajectories.empty(rollout.steps, rollout.env.num_envs, rollout.parts, width, rollout.env)
        columns = identity(rollout, made)
        if table.test == "push":
            columns |= dict.fromkeys(disturbance_tests.PUSH_COLUMNS, np.zeros(1))
        else:
            columns |= _numbers(_columns(subject, rollout, made))
        if table.test in _IN_CHANGED_WORLDS:
            changed, margins = _worlds(subject, table)
            columns |= dict.fromkeys(["world", *(f"margin_{name}" for name in margins)], np.zeros(1))
            columns |= {"sweep": np.array([w.sweep for w in changed]), "value": np.array([w.value for w in changed])}
        found += [metric.name for metric in metrics_of(table.test, columns, protocol)]
    return found


@dataclass(frozen=True)
class Part:
    """The result of one test: the sha256 of its starts, the columns of its episodes, and the robot and its engine."""

    test: str
    starts: str
    columns: dict[str, Array]
    about: dict[str, object]
    robot_differences: Sequence[str]


_SCENARIOS: dict[str, Callable[[Any], Scenarios]] = {
    "stand": scenarios.standing,
    "walk": scenarios.walking,
    "steps": scenarios.stepping,
    "height": scenarios.at_heights,
    "push": scenarios.pushing,
    "jump": scenarios.jumping,
    "get_up": scenarios.getting_up,
    "terrain": scenarios.on_terrain,
    "bump": lambda options: replace(scenarios.on_terrain(options), test="bump"),
    "strip": scenarios.over_strips,
    "robust": scenarios.in_changed_world,
}


_IN_CHANGED_WORLDS = ("jump", "robust")


def _tables(options: protocol_options.Protocol) -> list[Scenarios]:
    chosen = {test: getattr(options, test) for test in _SCENARIOS}
    return [_SCENARIOS[test](test_options) for test, test_options in chosen.items() if test_options is not None]


def _run(subject: Subject, table: Scenarios) -> Part:
    if table.test in _IN_CHANGED_WORLDS:
        return _in_changed_worlds(subject, table)
    rollout = _placed(subject, table)
    policy, progress = subject.make_policy(rollout.env), subject.progress_of(table.test)
    if table.test == "push" and (push := subject.protocol.push) is not None:
        columns, made = disturbance_tests.push_columns(rollout, policy, push, subject.seed, subject.target, progress)
        columns |= motion_columns.survival(made, [])
    else:
        ramp = subject.protocol.get_up.ramp_s if table.test == "get_up" and subject.protocol.get_up else 0.0
        disturb = disturbance_tests.gain_ramp(rollout, ramp) if ramp else None
        made = rollout.roll(policy, subject.seed, progress, disturb)
        columns = _columns(subject, rollout, made)
    columns_of_all = identity(rollout, made) | _numbers(columns)
    return Part(table.test, rollout.starts, columns_of_all, about(rollout), rollout.env.scene.sim.robot_differences())


def _placed(subject: Subject, table: Scenarios) -> Rollout:
    env, options = subject.options(table), subject.protocol
    if isinstance(ground := getattr(options, table.test), protocol_options.Terrain):
        rollout = subject.rollout(table, on_ground(env, disturbance_tests.tiles(ground, subject.seed)))
        disturbance_tests.place_on_tiles(rollout, ground)
        return rollout
    if table.test == "strip" and options.strip is not None:
        ground = disturbance_tests.strip_ground(options.strip, env.scene.terrain, subject.seed)
        rollout = subject.rollout(table, on_ground(env, ground))
        disturbance_tests.place_before_strip(rollout, options.strip)
        return rollout
    if table.test == "get_up" and options.get_up is not None:
        target = "wheelleg_exp.mdp.events.reset_to_resting_pose"
        lying = {"_target_": target, "mode": "reset", "by_side": True, "num_poses": options.get_up.num_poses}
        env = replace(env, events={**env.events, "evaluation_lying": lying}, terminations={})
    return subject.rollout(table, env)


def _worlds(subject: Subject, table: Scenarios) -> tuple[Sequence[disturbance_tests.World], Mapping[str, float]]:
    """Return the worlds of a test, and the largest changes between which ``margin`` searches."""
    env, options = subject.options(table), getattr(subject.protocol, table.test)
    if isinstance(options, protocol_options.Robust):
        return list(disturbance_tests.worlds(env, options)), options.margins or {}
    own = replace(subject, protocol=replace(subject.protocol, realism="own"))
    return disturbance_tests.jump_worlds(env, own.options(table), options), {}


def _in_changed_worlds(subject: Subject, table: Scenarios) -> Part:
    options = getattr(subject.protocol, table.test)
    env, found, starts = subject.options(table), list[dict[str, Array]](), list[str]()
    each, margins = _worlds(subject, table)
    progress = subject.progress_of(table.test)
    for number, changed in enumerate(each):
        rollout, made = _rolled(subject, table, changed)
        names = {"sweep": np.full(table.size, changed.sweep), "value": np.full(table.size, changed.value)}
        names["world"] = np.full(table.size, float(number))
        found.append(identity(rollout, made) | names | _numbers(_columns(subject, rollout, made)))
        starts.append(rollout.starts)
        if progress is not None:
            progress(number + 1, len(each) + len(margins))
    for number, (name, highest) in enumerate(margins.items()):

        def survival(value: float, name: str = name) -> float:
            _, made = _rolled(subject, table, disturbance_tests.world(env, options, name, value))
            return 1.0 - float(made.fell.double().mean())

        # The margins are properties of the policy, so each episode of the unchanged simulation has the same value.
        step = env.sim.dt if name.endswith("_s") else 0.0  # Delays are rounded to physics steps.
        found[0][f"margin_{name}"] = np.full(table.size, disturbance_tests.margin(survival, highest, options, step))
        if progress is not None:
            progress(len(each) + number + 1, len(each) + len(margins))
    digest = hashlib.sha256("".join(starts).encode()).hexdigest()
    return Part(table.test, digest, joined(found), about(rollout), rollout.env.scene.sim.robot_differences())


def _rolled(subject: Subject, table: Scenarios, changed: disturbance_tests.World) -> tuple[Rollout, Trajectories]:
    rollout = subject.rollout(table, changed.env)
    disturb = disturbance_tests.disturbances(rollout, changed)
    return rollout, rollout.roll(subject.make_policy(rollout.env), subject.seed, disturb=disturb)


def _columns(subject: Subject, rollout: Rollout, made: Trajectories) -> Columns:
    settle, parts, table = subject.protocol.settle_s, rollout.parts, rollout.scenarios
    options = getattr(subject.protocol, table.test)
    target = table.height_of().to(made.height.device) if table.heights else subject.target
    motion = Motion(made, parts, settle, target)
    if isinstance(options, protocol_options.Robust):
        return motion_columns.survival(made, []) | measured(motion, POSTURE) | motion_columns.errors(made, settle)
    moments = options.survival_s if isinstance(options, protocol_options.Stand) else []
    columns = motion_columns.survival(made, moments) | motion_columns.drift(made, settle)
    columns |= motion_columns.group_effort(motion) | measured(motion) | {"distance_m": motion.distance}
    if isinstance(options, protocol_options.Walk):
        columns |= motion_columns.tracking(made, settle, options) | motion_columns.wheel_error(made, parts, settle)
        columns |= motion_columns.within_band(made, columns, options)
    if isinstance(options, protocol_options.Steps):
        columns |= motion_columns.responses(made, options, table.commands()[:, 1].to(made.command.device))
    if isinstance(options, protocol_options.Height):
        columns |= motion_columns.errors(made, settle)
    if isinstance(options, (protocol_options.Jump, protocol_options.GetUp)):
        height = motion.mean(made.height) if subject.target is None else made.height.new_tensor(subject.target)
        columns |= disturbance_tests.recovery(made, options, height) | motion_columns.impact(motion, options.at_s)
    if isinstance(options, protocol_options.Jump):
        columns |= motion_columns.jump(motion, options)
    if isinstance(options, protocol_options.GetUp):
        columns |= motion_columns.resting_sides(made)
    if isinstance(options, protocol_options.Terrain):
        columns |= motion_columns.errors(made, settle) | disturbance_tests.ways(made, rollout, options)
    if isinstance(options, protocol_options.Strip):
        columns |= disturbance_tests.crossing(made, options, settle)
    return columns


def _numbers(columns: Columns) -> dict[str, Array]:
    return {name: column.double().cpu().numpy() for name, column in columns.items()}


def identity(rollout: Rollout, made: Trajectories) -> dict[str, Array]:
    """Return columns that contain each episode's test, scenario, number in the scenario, command, and failure cause."""
    table = rollout.scenarios
    cell = table.cell_of()
    # In the test ``steps``, the first velocity command is zero, so store the second command.
    commands = table.commands()[:, min(1, len(table.times) - 1)].double().cpu().numpy()
    endings = np.array([*rollout.endings, ""])
    return {
        "test": np.full(table.size, table.test),
        "cell": cell.double().cpu().numpy(),
        "cell_name": np.array(table.names)[cell.cpu().numpy()],
        "episode": torch.arange(table.size).remainder(table.episodes).double().cpu().numpy(),
        "command_vx": commands[:, 0],
        "command_wz": commands[:, 2],
        "ended_by": endings[made.ended_by.cpu().numpy()],
    }


def about(rollout: Rollout) -> dict[str, object]:
    """Return the facts of every result: the robot's profile and drives, time steps, engine, and contact model."""
    env, parts = rollout.env, rollout.parts
    armature, limits = env.scene.robot.data.joint_armature[0].tolist(), parts.effort_limit[0].tolist()
    names, promise = parts.joint_names, env.scene.sim.promise()
    return {
        "profile": env.options.robot.profile,
        "armature_kg_m2": dict(zip(names, armature, strict=True)),
        "effort_limit_nm": dict(zip(names, limits, strict=True)),
        "wheels": [names[index] for index in parts.wheels.tolist()],
        "mass_kg": parts.mass,
        "physics_dt_s": env.physics_dt,
        "step_dt_s": env.step_dt,
        "engine": env.scene.sim.name,
        "mujoco": mujoco.mj_versionString(),
        "contacts": f"{env.options.sim.cone} cones, impratio {env.options.sim.impratio:g}",
        "device": str(env.device),
        "model_sha256": env.scene.model_digest(),
        **({} if promise["exact"] else {"promise": promise}),
    }


def joined(parts: list[dict[str, Array]]) -> dict[str, Array]:
    """Join the tables of several tests to one table; a missing number becomes NaN, and a missing text empty."""
    found = {}
    for name in dict.fromkeys(name for part in parts for name in part):
        texts = any(part[name].dtype.kind in "US" for part in parts if name in part)
        blank: str | float = "" if texts else np.nan
        found[name] = np.concatenate([part.get(name, np.full(len(part["test"]), blank)) for part in parts])
    return found
