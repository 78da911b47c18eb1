"""A run's policy in an environment of its own, made from what the run kept: before anything is played or written."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheelleg_exp.config import schema
from wheelleg_exp.config.checking.check import check_tree
from wheelleg_exp.config.composing.amend import amend, placing, require_read
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.problems import raise_all
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.files import sha256
from wheelleg_exp.jobs.display import Display
from wheelleg_exp.jobs.documents import command_document, config_document, json_document, run_documents
from wheelleg_exp.jobs.episode_recording import EpisodeRecording
from wheelleg_exp.jobs.kept_robot import kept_mjcf, kept_model_digest
from wheelleg_exp.jobs.threads import set_threads
from wheelleg_exp.rl.policy import load_policy
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run.begin import refuse_secrets
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.params import OF_A_POLICY, load_params, on_reference_engine, present_form

Tree = dict[str, Any]

_INSTEAD = {
    "agent.device": "env.sim.engine and env.sim.device: the policy runs where the simulation does",
    "": "agent.torch_threads, agent.clip_actions, agent.max_non_finite, or a key of the policy's network",
}


@dataclass(frozen=True)
class RunPolicy:
    """A policy and an environment that fits it.

    Attributes:
        run: the run.
        checkpoint: the checkpoint that the policy is of.
        tree: ``env`` and ``agent`` of the run, and the settings of ``configs/play.yaml``, with the changes.
        adapter: the environment as rsl_rl sees it.
        policy: the policy, which returns its mean action.
        about: the checkpoint's name, as seen from the run, and its sha256.
    """

    run: RunDirectory
    checkpoint: Path
    tree: Tree
    adapter: RslRlVecEnv
    policy: Any
    about: dict[str, str]

    def recording(self, folder: Path, command: Sequence[str]) -> EpisodeRecording:
        """Return the recording of what is to be played, in a folder below the run.

        Args:
            folder: where ``recording.rrd`` goes.
            command: the command line.
        """
        documents = run_documents(self.run) | config_document(self.tree) | command_document(command)
        task = self.run.manifest().data.get("task")
        return EpisodeRecording(
            folder / "recording.rrd",
            self.adapter.env,
            self.tree["recording"],
            purpose="play",
            name=folder.name,
            about={
                "run_id": self.run.id,
                "task": None if task is None else str(task),
                "agent": "policy",
                **self.about,
            },
            documents=documents | json_document("checkpoint", self.about),
        )


def prepare(
    run: RunDirectory,
    checkpoint: Path | None,
    overrides: Sequence[str],
    command: Sequence[str],
    display: Display,
    change: Callable[[Tree], Tree] | None = None,
) -> RunPolicy:
    """Load a run's policy and build an environment for it.

    Args:
        run: the run.
        checkpoint: which of its checkpoints; None is the last.
        overrides: changes to the run's parameters.
        command: the command line, in which no key or token may stand.
        display: is told when the compiled model is another than the training's.
        change: a last change to the tree, after the overrides.

    Raises:
        WheellegError: the run, the checkpoint or an override is wrong, or one of these holds a key or a token.
    """
    checkpoint = run.latest_checkpoint() if checkpoint is None else checkpoint
    env_params, agent = load_params(run)
    kept = {**_own_settings(), "env": on_reference_engine(present_form(env_params)), "agent": agent}
    tree = amend(kept, overrides)
    refuse_secrets(command, {"the overrides": "\n".join(overrides)}, tree, kept)
    with placing(overrides):
        tree = tree if change is None else change(tree)
        _require_playable(kept, tree)
        require_read(kept, overrides, _read, _INSTEAD)
        env = ManagerBasedRLEnv(tree["env"], kept_mjcf(run), tree["seed"])
    set_threads(tree["agent"], env.scene.sim.nthread)
    if tree["env"] == kept["env"] and env.scene.model_digest() != kept_model_digest(run):
        display.note("note: the compiled model is not the one of the training; is this another MuJoCo version?")
    adapter = RslRlVecEnv(env, tree["agent"].get("clip_actions"))
    policy = load_policy(checkpoint, adapter, tree["agent"])
    own = checkpoint.resolve().is_relative_to(run.path)  # a run may be moved
    name = checkpoint.resolve().relative_to(run.path) if own else checkpoint.resolve()
    about = {"checkpoint": str(name), "checkpoint_sha256": sha256(checkpoint)}
    return RunPolicy(run, checkpoint, tree, adapter, policy, about)


def _own_settings() -> Tree:
    composed = compose(primary="play").config
    return {key: composed[key] for key in ("seed", "play", "drive", "recording")}


def _read(tree: Mapping[str, Any]) -> Any:
    """Return what a play reads: of ``agent``, what the policy depends on and how many failures are accepted."""
    agent = {key: value for key, value in tree["agent"].items() if key in (*OF_A_POLICY, "max_non_finite")}
    return {**tree, "agent": agent}


def _require_playable(kept: Tree, tree: Tree) -> None:
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
