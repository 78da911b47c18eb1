"""From a task, a policy and a protocol to an evaluation: test by test, each in an environment of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.evaluation import motors, scenarios, standing, stepping, walking
from wheelleg_exp.evaluation.metrics import Array, figure, metrics_of
from wheelleg_exp.evaluation.options import Protocol
from wheelleg_exp.evaluation.over_time import Trajectories
from wheelleg_exp.evaluation.result import Evaluation, Figure
from wheelleg_exp.evaluation.robot_parts import RobotParts
from wheelleg_exp.evaluation.rollout import Policy, Rollout
from wheelleg_exp.evaluation.scenarios import Scenarios, combined_digest
from wheelleg_exp.evaluation.task import build, evaluation_cfg, target_height
from wheelleg_exp.terms.sections import read_section

MakePolicy = Callable[[ManagerBasedRLEnv], Policy]
Tell = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Subject:
    """What is evaluated, and how.

    Attributes:
        env_cfg: the composed ``env`` section, plain.
        mjcf: the robot's MJCF file.
        make_policy: makes the policy for an environment.
        protocol: the protocol.
        seed: of the starts.
        tell: told the test, and how many of its steps are done of how many.
    """

    env_cfg: Mapping[str, Any]
    mjcf: Path
    make_policy: MakePolicy
    protocol: Protocol
    seed: int
    tell: Tell | None = None

    @property
    def target(self) -> float | None:
        """The base height that is asked for, m."""
        return target_height(self.env_cfg, self.protocol)


def evaluate(
    env_cfg: Mapping[str, Any],
    mjcf: Path,
    make_policy: MakePolicy,
    protocol: Mapping[str, Any],
    seed: int | None = None,
    tell: Tell | None = None,
) -> Evaluation:
    """Roll a policy through the scenarios of a protocol and measure it.

    Args:
        env_cfg: the composed ``env`` section, plain.
        mjcf: the robot's MJCF file.
        make_policy: makes, for an environment, a callable from observations by group to raw actions (N, A); if it has
            a ``reset``, that is called before each rollout.
        protocol: the composed ``protocol``, plain.
        seed: of the scenarios; the protocol's by default.
        tell: told the test, and how many of its steps are done of how many.

    Raises:
        ConfigError: the protocol or the task is wrong.
    """
    options = read_section(Protocol, protocol, "protocol")
    seed = options.seed if seed is None else seed
    subject = Subject(env_cfg, mjcf, make_policy, options, seed, tell)
    tables = list(_tables(options))
    parts = [_run(subject, table) for table in tables]
    found: dict[str, Figure] = {}
    for part in parts:
        band = options.walk.band if options.walk is not None else 0.1
        for metric in metrics_of(part.test, list(part.columns), band):
            found[metric.name] = figure(metric, part.columns, seed, options.resamples)
    return Evaluation(
        protocol=dict(protocol),
        seed=seed,
        scenarios_sha256=combined_digest(tables, seed),
        starts_sha256={part.test: part.starts for part in parts},
        episodes=joined([part.columns for part in parts]),
        metrics=found,
        about=parts[0].about if parts else {},
    )


@dataclass(frozen=True)
class Part:
    """What one test found.

    Attributes:
        test: its name.
        starts: sha256 of where its episodes began.
        columns: of its episodes.
        about: the robot and its engine.
    """

    test: str
    starts: str
    columns: dict[str, Array]
    about: dict[str, Any]


def _tables(options: Protocol) -> Iterator[Scenarios]:
    if options.stand is not None:
        yield scenarios.standing(options.stand)
    if options.walk is not None:
        yield scenarios.walking(options.walk)
    if options.steps is not None:
        yield scenarios.stepping(options.steps)


def rollout_of(subject: Subject, table: Scenarios, cfg: Mapping[str, Any] | None = None) -> Rollout:
    """Build the environment of a table's episodes."""
    options = subject.protocol
    made = cfg or evaluation_cfg(subject.env_cfg, options, table.size, table.horizon_s, options.ground)
    return Rollout(
        build(made, subject.mjcf, subject.seed),
        table,
        command=options.command,
        fall_tilt=options.fall_tilt,
        contact_force=options.contact_force,
        saturation=options.saturation,
    )


def _run(subject: Subject, table: Scenarios) -> Part:
    rollout = rollout_of(subject, table)
    policy = subject.make_policy(rollout.env)
    tell = None if subject.tell is None else lambda done, of: subject.tell(table.test, done, of)  # type: ignore[misc]
    made = rollout.roll(policy, subject.seed, tell)
    columns = {**identity(table, rollout, made), **_columns(subject, table, made, rollout.parts)}
    rollout.start(subject.seed)
    return Part(table.test, rollout.starts_digest(), columns, about(rollout))


def _columns(subject: Subject, table: Scenarios, made: Trajectories, parts: RobotParts) -> dict[str, Array]:
    options, settle = subject.protocol, subject.protocol.settle_s
    moments = options.stand.survival_s if table.test == "stand" and options.stand is not None else []
    columns = standing.survival(made, moments) | standing.posture(made, settle, subject.target)
    columns |= standing.drift(made, settle) | standing.stance(made, parts, settle)
    columns |= motors.effort(made, parts, settle, options.torque_deadband)
    columns |= motors.energy(made, parts, settle) | motors.smoothness(made, parts, settle)
    if table.test == "walk" and options.walk is not None:
        columns |= walking.tracking(made, settle, options.walk)
        columns |= walking.within_band(made, columns, options.walk)
    if table.test == "steps" and options.steps is not None:
        columns |= stepping.responses(made, options.steps)
    return {name: column.double().cpu().numpy() for name, column in columns.items()}


def identity(table: Scenarios, rollout: Rollout, made: Trajectories) -> dict[str, Array]:
    """Return the columns that say which episode a row is, what it was told, and how it ended."""
    cell = table.cell_of()
    told = table.commands()[:, min(1, len(table.times) - 1)].double().numpy()  # of steps, the one after standing
    endings = np.array([*rollout.endings, ""])
    return {
        "test": np.full(table.size, table.test),
        "cell": cell.double().numpy(),
        "cell_name": np.array(table.names)[cell.numpy()],
        "episode": torch.arange(table.size).remainder(table.episodes).double().numpy(),
        "command_vx": told[:, 0],
        "command_wz": told[:, 2],
        "ended_by": endings[made.ended_by.cpu().numpy()],
    }


def about(rollout: Rollout) -> dict[str, Any]:
    """Return what results must name: the robot's profile and drives, the time steps, the engine."""
    env, parts = rollout.env, rollout.parts
    robot = env.cfg["robot"]
    armature = env.scene.robot.data.joint_armature[0].tolist()
    limits = parts.effort_limit[0].tolist()
    names = parts.joint_names
    return {
        "profile": robot.get("profile"),
        "armature_kg_m2": dict(zip(names, armature, strict=True)),
        "effort_limit_nm": dict(zip(names, limits, strict=True)),
        "wheels": [names[index] for index in parts.wheels.tolist()],
        "mass_kg": parts.mass,
        "physics_dt_s": env.physics_dt,
        "step_dt_s": env.step_dt,
        "engine": env.cfg["sim"].get("engine"),
        "device": str(env.device),
        "model_sha256": env.scene.model_digest(),
    }


def joined(parts: list[dict[str, Array]]) -> dict[str, Array]:
    """Return the rows of several tests in one table; NaN, or an empty text, where a test has no such column."""
    names = list(dict.fromkeys(name for part in parts for name in part))
    found = {}
    for name in names:
        texts = any(part[name].dtype.kind in "US" for part in parts if name in part)
        blank: Any = "" if texts else np.nan
        found[name] = np.concatenate([part.get(name, np.full(len(part["test"]), blank)) for part in parts])
    return found
