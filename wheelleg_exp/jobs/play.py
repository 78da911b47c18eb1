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

from wheelleg_exp.config import schema
from wheelleg_exp.config.checking.check import check_tree
from wheelleg_exp.config.composing.amend import amend, placing
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.problems import raise_all
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError, SimulationFailure
from wheelleg_exp.files import sha256, while_running, write_json
from wheelleg_exp.jobs.dataset import close_dataset
from wheelleg_exp.jobs.display import Display
from wheelleg_exp.jobs.documents import command_document, config_document, json_document, run_documents
from wheelleg_exp.jobs.episode_recording import EpisodeRecording
from wheelleg_exp.jobs.figures import StandFigures, StandMeter
from wheelleg_exp.jobs.kept_robot import kept_mjcf, kept_model_digest
from wheelleg_exp.jobs.motion_figures import MotionFigures, MotionMeter
from wheelleg_exp.jobs.threads import set_threads
from wheelleg_exp.managers.finite import require_finite_actions
from wheelleg_exp.rl.episode_log import FailureCount
from wheelleg_exp.rl.policy import load_policy
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run.begin import refuse_secrets
from wheelleg_exp.run.directory import RunDirectory, create_exclusively
from wheelleg_exp.run.params import load_params, present_form
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
    checkpoint = run.latest_checkpoint() if checkpoint is None else checkpoint
    env_params, agent = load_params(run)
    kept = {**_own_settings(), "env": present_form(env_params), "agent": agent}
    tree = amend(kept, overrides)
    refuse_secrets(command, {"the overrides": "\n".join(overrides)}, tree, kept)
    with placing(overrides):
        _require_playable(kept, tree)
        env = ManagerBasedRLEnv(tree["env"], kept_mjcf(run), tree["seed"])
    set_threads(tree["agent"], env.scene.sim.nthread)
    if tree["env"] == kept["env"] and env.scene.model_digest() != kept_model_digest(run):
        display.note("note: the compiled model is not the one of the training; is this another MuJoCo version?")
    adapter = RslRlVecEnv(env, tree["agent"].get("clip_actions"))
    policy = load_policy(checkpoint, adapter, tree["agent"])
    settle_s = float(tree["play"]["settle_s"])
    meter, motion = StandMeter(env, settle_s), MotionMeter(env, settle_s)
    env.observers += [meter.observe, motion.observe]
    failures = FailureCount(env.num_envs, tree["agent"])
    own = checkpoint.resolve().is_relative_to(run.path)  # a run may be moved
    name = checkpoint.resolve().relative_to(run.path) if own else checkpoint.resolve()
    about = {"checkpoint": str(name), "checkpoint_sha256": sha256(checkpoint)}
    content = {**about, "seed": tree["seed"], "overrides": list(overrides)}
    folder = create_exclusively(run.play, datetime.now().strftime("%Y-%m-%d_%H-%M-%S"))
    try:
        with while_running():
            recording = _recording(env, folder, tree, run, about, command) if tree["recording"]["enabled"] else None
            if recording is not None:
                recording.warn(display.note)
            with recording or nullcontext():
                _roll(adapter, policy, meter, failures, display)
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
    return Played(run, checkpoint, folder, path, meter.figures(), motion.figures(), failures)


def _recording(
    env: ManagerBasedRLEnv,
    folder: Path,
    tree: dict[str, Any],
    run: RunDirectory,
    checkpoint: dict[str, str],
    command: Sequence[str],
) -> EpisodeRecording:
    documents = run_documents(run) | config_document(tree) | command_document(command)
    return EpisodeRecording(
        folder / "recording.rrd",
        env,
        tree["recording"],
        purpose="play",
        name=folder.name,
        about={"run_id": run.id, "task": _task(run), "agent": "policy", **checkpoint},
        documents=documents | json_document("checkpoint", checkpoint),
    )


def _task(run: RunDirectory) -> str | None:
    task = run.manifest().data.get("task")
    return None if task is None else str(task)


def _own_settings() -> dict[str, Any]:
    composed = compose(primary="play").config
    return {key: composed[key] for key in ("seed", "play", "recording")}


def _require_playable(kept: dict[str, Any], tree: dict[str, Any]) -> None:
    """Hold the amended tree against what a play reads, before anything is built or made."""
    errors = check_tree(tree, schema.PlayRoot)
    if errors:
        raise_all(errors)
    for key in ("asset", "base"):
        if tree["env"]["robot"][key] != kept["env"]["robot"][key]:
            raise ConfigError(
                "a play simulates the robot that the run was trained on",
                key=f"env.robot.{key}",
                expected="the run's own value; another robot needs a new run",
            )


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
