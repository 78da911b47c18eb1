"""Playing a trained policy for one episode: figures and a recording, kept under the run."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import torch

from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.files import while_running, write_json
from wheelleg_exp.jobs.dataset import close_dataset
from wheelleg_exp.jobs.display import Display
from wheelleg_exp.jobs.figures import StandFigures, StandMeter
from wheelleg_exp.jobs.motion_figures import MotionFigures, MotionMeter
from wheelleg_exp.jobs.run_policy import prepare
from wheelleg_exp.managers.finite import require_finite_actions
from wheelleg_exp.rl.episode_log import FailureCount
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run.directory import RunDirectory, create_exclusively
from wheelleg_exp.user_code import ending_as


@dataclass(frozen=True)
class Played:
    """What a play made.

    Attributes:
        run: the run whose policy it was.
        checkpoint: the checkpoint.
        folder: what was written, below the run.
        recording: the recording, or None.
        figures: how the policy stood.
        motion: how it moved, and what its motors bore.
        failures: the episodes that ended because a number was not finite.
    """

    run: RunDirectory
    checkpoint: Path
    folder: Path
    recording: Path | None
    figures: StandFigures
    motion: MotionFigures
    failures: FailureCount


def play(
    run: RunDirectory,
    checkpoint: Path | None,
    overrides: Sequence[str],
    command: Sequence[str],
    display: Display,
) -> Played:
    """Play the mean of a run's policy for one episode of each environment, with the task's own events.

    Args:
        run: the run.
        checkpoint: which of its checkpoints; None is the last.
        overrides: changes to the run's parameters, for this play alone.
        command: the command line, for the manifest.
        display: receives progress.

    Raises:
        WheellegError: the run, the checkpoint or an override is wrong, or one of these holds a key or a token.
    """
    prepared = prepare(run, checkpoint, overrides, command, display)
    tree, adapter, env = prepared.tree, prepared.adapter, prepared.adapter.env
    settle_s = float(tree["play"]["settle_s"])
    meter, motion = StandMeter(env, settle_s), MotionMeter(env, settle_s)
    env.observers += [meter.observe, motion.observe]
    failures = FailureCount(env.num_envs, tree["agent"])
    content = {**prepared.about, "seed": tree["seed"], "overrides": list(overrides)}
    folder = create_exclusively(run.play, datetime.now().strftime("%Y-%m-%d_%H-%M-%S"))
    try:
        with while_running():
            recording = prepared.recording(folder, command) if tree["recording"]["enabled"] else None
            if recording is not None:
                recording.warn(display.note)
            with recording or nullcontext():
                _roll(adapter, prepared.policy, meter, failures, display)
                content |= meter.figures().as_dict() | motion.figures().as_dict()
                if recording is not None:
                    recording.figures(content)
            dataset = close_dataset(folder / "dataset", env)
            write_json(folder / "figures.json", content)
            files = [*dataset, folder / "figures.json", *([recording.path] if recording else [])]
            run.manifest().add("play", files, content, command=command)
    except BaseException:  # an interrupted play leaves nothing that looks like one
        shutil.rmtree(folder, ignore_errors=True)
        raise
    path = recording.path if recording else None
    return Played(run, prepared.checkpoint, folder, path, meter.figures(), motion.figures(), failures)


@ending_as(SimulationFailure)
@torch.inference_mode()
def _roll(adapter: RslRlVecEnv, policy: Any, meter: StandMeter, failures: FailureCount, display: Display) -> None:
    """Step until every environment has finished its first episode."""
    env = adapter.env
    for step in range(env.max_episode_length):
        actions = policy(adapter.get_observations())
        require_finite_actions(env, actions)
        *_, extras = adapter.step(actions)
        failures.take(extras)
        display.steps(step + 1, env.max_episode_length)
        if not meter.running.any():
            break
