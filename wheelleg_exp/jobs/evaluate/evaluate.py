"""Evaluating a run: its policy's mean in the scenarios of a protocol, kept below the run."""

from __future__ import annotations

import csv
import io
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.evaluation.protocol import MakePolicy, Tell, evaluate
from wheelleg_exp.evaluation.reference import Reference
from wheelleg_exp.evaluation.result import Evaluation
from wheelleg_exp.files import sha256, while_running, write_json, write_text
from wheelleg_exp.jobs.evaluate.settings import settings
from wheelleg_exp.jobs.kept_robot import kept_mjcf
from wheelleg_exp.jobs.threads import set_threads
from wheelleg_exp.rl.policy import load_policy
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run.begin import refuse_secrets
from wheelleg_exp.run.directory import RunDirectory, create_exclusively
from wheelleg_exp.user_code import ending_as

Draw = Callable[[Evaluation, Path], list[Path]]  # draws an evaluation into a folder, and returns the files

RESULT, EPISODES = "evaluation.json", "episodes.csv"


@dataclass(frozen=True)
class Evaluated:
    """What an evaluation made.

    Attributes:
        run: the run whose policy it was.
        checkpoint: the checkpoint; None of the reference controller.
        folder: what was written, below the run.
        evaluation: what was found.
        content: what stands in ``evaluation.json``.
    """

    run: RunDirectory
    checkpoint: Path | None
    folder: Path
    evaluation: Evaluation
    content: dict[str, Any]


def evaluate_run(
    run: RunDirectory,
    checkpoint: Path | None,
    overrides: Sequence[str],
    command: Sequence[str],
    tell: Tell | None = None,
    config_dirs: Sequence[Path] = (),
    draw: Draw | None = None,
) -> Evaluated:
    """Evaluate the mean of a run's policy, and keep what was found under the run.

    Args:
        run: the run.
        checkpoint: which of its checkpoints; None is the last.
        overrides: the protocol, changes to it, and changes to the run's parameters.
        command: the command line, for the manifest.
        tell: told the test, and how many of its steps are done of how many.
        config_dirs: folders of the user's own protocols.
        draw: draws what was found.

    Raises:
        WheellegError: the run, the checkpoint or an override is wrong, or one of these holds a key or a token.
    """
    checkpoint = run.latest_checkpoint() if checkpoint is None else checkpoint
    tree = settings(run, overrides, config_dirs)
    refuse_secrets(command, {"the overrides": "\n".join(overrides)}, tree)
    found = _evaluation(tree, kept_mjcf(run), policy_of(checkpoint, tree["agent"]), tell)
    own = checkpoint.resolve().is_relative_to(run.path)  # a run may be moved
    name = checkpoint.resolve().relative_to(run.path) if own else checkpoint.resolve()
    about = {"checkpoint": str(name), "checkpoint_sha256": sha256(checkpoint), "overrides": list(overrides)}
    content = {**about, **found.as_dict()}
    return Evaluated(run, checkpoint, _kept(run, "evaluation", content, found, command, draw), found, content)


def evaluate_reference(
    run: RunDirectory,
    overrides: Sequence[str],
    command: Sequence[str],
    tell: Tell | None = None,
    config_dirs: Sequence[Path] = (),
    draw: Draw | None = None,
) -> Evaluated:
    """Evaluate the reference controller on a run's robot and task, and keep what was found under the run.

    Args:
        run: the run.
        overrides: as for ``evaluate_run``, as are the others.
        command: the command line, for the manifest.
        tell: told how far it is.
        config_dirs: folders of the user's own protocols.
        draw: draws what was found.

    Raises:
        WheellegError: an override is wrong, or the robot or its actions are none that the reference can balance.
    """
    tree = settings(run, overrides, config_dirs)
    refuse_secrets(command, {"the overrides": "\n".join(overrides)}, tree)
    made: list[Reference] = []

    def make(env: ManagerBasedRLEnv) -> Reference:
        made.append(Reference(env, tree["protocol"]["command"]))
        return made[-1]

    found = _evaluation(tree, kept_mjcf(run), make, tell)
    content = {"policy": Reference.name, **made[0].describe(), "overrides": list(overrides), **found.as_dict()}
    return Evaluated(run, None, _kept(run, Reference.name, content, found, command, draw), found, content)


def _kept(
    run: RunDirectory,
    kind: str,
    content: dict[str, Any],
    found: Evaluation,
    command: Sequence[str],
    draw: Draw | None,
) -> Path:
    """Write what was found below the run, whole or not at all, and return the folder."""
    folder = create_exclusively(run.evaluation, datetime.now().strftime("%Y-%m-%d_%H-%M-%S"))
    try:
        with while_running():
            write_text(folder / EPISODES, episodes_text(found.episodes))
            write_json(folder / RESULT, content)
            drawn = [] if draw is None else draw(found, folder)
            run.manifest().add(kind, [folder / RESULT, folder / EPISODES, *drawn], _summary(content), command=command)
    except BaseException:  # an interrupted evaluation leaves nothing that looks like one
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder


@ending_as(SimulationFailure)
def _evaluation(tree: Mapping[str, Any], mjcf: Path, make_policy: MakePolicy, tell: Tell | None) -> Evaluation:
    return evaluate(tree["env"], mjcf, make_policy, tree["protocol"], tree["seed"], tell=tell)


def policy_of(checkpoint: Path, agent: Mapping[str, Any]) -> MakePolicy:
    """Return what makes the policy of a checkpoint for an environment: its mean action, clipped as in training.

    Args:
        checkpoint: the checkpoint.
        agent: the run's ``agent`` section.
    """

    def make(env: ManagerBasedRLEnv) -> Callable[[Mapping[str, Any]], torch.Tensor]:
        set_threads(agent, env.scene.sim.nthread)
        clip = agent.get("clip_actions")
        policy = load_policy(checkpoint, RslRlVecEnv(env, clip), agent)
        policy.to(env.device)

        def act(observations: Mapping[str, Any]) -> torch.Tensor:
            actions = policy(TensorDict(dict(observations), batch_size=[env.num_envs]))
            return actions if clip is None else actions.clamp(-clip, clip)

        return act

    return make


def _summary(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the manifest says of an evaluation: which, of what, and its values."""
    kept = ("checkpoint", "checkpoint_sha256", "seed", "scenarios_sha256", "starts_sha256")
    values = {name: figure["value"] for name, figure in content["metrics"].items()}
    told = {key: content[key] for key in kept if key in content}
    return {"protocol": content["protocol"]["name"], **told, "metrics": values}


def episodes_text(episodes: Mapping[str, Any]) -> str:
    """Return the episodes as CSV, one row each; numbers as Python writes them, so that they are read back exactly."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(episodes)
    for row in zip(*(column.tolist() for column in episodes.values()), strict=True):
        writer.writerow(_cell(value) for value in row)
    return file.getvalue()


def _cell(value: Any) -> str:
    if isinstance(value, str):
        return value
    return "" if math.isnan(value) else repr(int(value) if math.isfinite(value) and value == int(value) else value)
