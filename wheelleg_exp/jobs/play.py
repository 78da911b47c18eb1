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
from wheelleg_exp.config.amend import amend
from wheelleg_exp.config.check import check_tree
from wheelleg_exp.config.compose import compose
from wheelleg_exp.config.problems import raise_all
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.assets import kept_mjcf, kept_model_digest
from wheelleg_exp.jobs.display import Display
from wheelleg_exp.jobs.documents import command_document, config_document, json_document, run_documents
from wheelleg_exp.jobs.episode_recording import EpisodeRecording
from wheelleg_exp.jobs.figures import StandFigures, StandMeter
from wheelleg_exp.jobs.threads import set_threads
from wheelleg_exp.recording.recorder import require_env_ids
from wheelleg_exp.rl.policy import load_policy
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run.directory import RunDirectory, create_exclusively
from wheelleg_exp.run.files import sha256, write_json
from wheelleg_exp.run.params import load_params
from wheelleg_exp.run.snapshot import refuse_secrets


@dataclass(frozen=True)
class Played:
    """What a play made.

    Attributes:
        run: the run whose policy it was.
        checkpoint: the checkpoint.
        folder: what was written, below the run.
        recording: the recording, or None.
        figures: how the policy stood.
    """

    run: RunDirectory
    checkpoint: Path
    folder: Path
    recording: Path | None
    figures: StandFigures


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
    kept = {**_own_settings(), "env": env_params, "agent": agent}
    tree = amend(kept, overrides)
    refuse_secrets(command, {"the overrides": "\n".join(overrides)}, tree, kept)
    _require_playable(kept, tree)
    env = ManagerBasedRLEnv(tree["env"], kept_mjcf(run), tree["seed"])
    set_threads(tree["agent"], env.scene.sim.nthread)
    if tree["env"] == kept["env"] and env.scene.model_digest() != kept_model_digest(run):
        display.note("note: the compiled model is not the one of the training; is this another MuJoCo version?")
    adapter = RslRlVecEnv(env, tree["agent"].get("clip_actions"))
    policy = load_policy(checkpoint, adapter, tree["agent"])
    meter = StandMeter(env, float(tree["play"]["settle_s"]))
    own = checkpoint.resolve().is_relative_to(run.path)  # a run may be moved
    name = checkpoint.resolve().relative_to(run.path) if own else checkpoint.resolve()
    about = {"checkpoint": str(name), "checkpoint_sha256": sha256(checkpoint)}
    content = {**about, "seed": tree["seed"], "overrides": list(overrides)}
    folder = create_exclusively(run.play, datetime.now().strftime("%Y-%m-%d_%H-%M-%S"))
    try:
        recording = _recording(env, folder, tree, run, about, command) if tree["recording"]["enabled"] else None
        if recording is not None:
            recording.warn(display.note)
        with recording or nullcontext():
            _roll(env, adapter, policy, meter, display)
            content |= meter.figures().as_dict()
            if recording is not None:
                recording.figures(content)
    except BaseException:  # an interrupted play leaves nothing that looks like one
        shutil.rmtree(folder, ignore_errors=True)
        raise
    write_json(folder / "figures.json", content)
    files = [folder / "figures.json", *([recording.path] if recording else [])]
    run.manifest().add("play", files, content, command=command)
    return Played(run, checkpoint, folder, recording.path if recording else None, meter.figures())


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
    require_env_ids(tree["recording"]["env_ids"], tree["env"]["num_envs"])


@torch.inference_mode()
def _roll(env: ManagerBasedRLEnv, adapter: RslRlVecEnv, policy: Any, meter: StandMeter, display: Display) -> None:
    """Step until every environment has finished its first episode."""
    env.observers.append(meter.observe)
    for step in range(env.max_episode_length):
        adapter.step(policy(adapter.get_observations()))
        display.steps(step + 1, env.max_episode_length)
        if not meter.running.any():
            break
