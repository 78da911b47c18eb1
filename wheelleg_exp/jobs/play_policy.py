"""Play a trained policy for one episode, and save the metrics and a recording in the directory of the run.

``run_agent`` runs zero or random actions instead, to inspect a task before training.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from wheelleg_exp.build import build_env
from wheelleg_exp.config.checking.check_terms import require_recorded
from wheelleg_exp.config.checking.find_mistakes import check_tree
from wheelleg_exp.config.composing.compose import Composed, apply_overrides, compose, placing, require_read
from wheelleg_exp.config.composing.sized_values import robot_sizes
from wheelleg_exp.config.config_errors import raise_all
from wheelleg_exp.config.schema import Experiment, PlayRoot
from wheelleg_exp.config.tree_lookup import at, section_at
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.realism import without_disturbances
from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.files import dump_json, while_running, write_json, write_yaml
from wheelleg_exp.jobs import rollout_files
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.rollout_figures import (
    ContactFigures,
    ContactMeter,
    MotionFigures,
    MotionMeter,
    StandFigures,
    StandMeter,
)
from wheelleg_exp.jobs.saved_robot import require_same_robot, saved_mjcf
from wheelleg_exp.jobs.torch_threads import set_threads
from wheelleg_exp.managers.non_finite import require_finite_actions
from wheelleg_exp.rl.network_loading import load_policy
from wheelleg_exp.rl.rollout_log import FailureCount
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run import run_config
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.sim.options import read_env
from wheelleg_exp.sim.sensors import ContactSensor
from wheelleg_exp.terms.config_sections import plain_section, read_section
from wheelleg_exp.user_exceptions import ending_as

Tree = dict[str, Any]

_ALTERNATIVES = {
    **dict.fromkeys(("env.events", "env.observations", "env.realism", "env.curriculum"), "play.conditions=training"),
    "agent.device": "env.sim.engine and env.sim.device: the policy runs where the simulation does",
    "": "agent.torch_threads, agent.clip_actions, agent.max_non_finite, or a key of the policy's network",
}


@dataclass(frozen=True)
class RunPolicy:
    """A trained policy, and an environment in which this policy can act."""

    run: RunDirectory
    checkpoint: Path
    settings: PlayRoot  # of ``configs/play.yaml``, with ``env`` and ``agent`` of the run
    tree: Tree  # ``settings`` as plain data
    adapter: RslRlVecEnv
    policy: Any  # returns the mean action
    about: dict[str, str]  # the file name and the sha256 of the policy's checkpoint

    def recording(self, folder: Path, command: Sequence[str]) -> rollout_files.EpisodeRecording:
        """Return a recording of the environment in which the policy acts."""
        documents = rollout_files.run_documents(self.run) | rollout_files.config_document(self.tree)
        documents |= rollout_files.command_document(command)
        task, path = self.run.manifest().data.get("task"), folder / "recording.rrd"
        about = {"run_id": self.run.id, "task": None if task is None else str(task), "agent": "policy", **self.about}
        options, env = self.settings.recording, self.adapter.env
        documents |= {"checkpoint": rollout_files.fenced(dump_json(self.about), "json")}
        return rollout_files.EpisodeRecording(path, env, options, name=folder.name, about=about, documents=documents)


def prepare_policy(
    run: RunDirectory,
    checkpoint: Path | None,
    overrides: Sequence[str],
    display: Display,
    change: Callable[[Tree], Tree] | None = None,
) -> RunPolicy:
    """Load a policy (default: the last checkpoint), and build its environment; ``change`` modifies the config."""
    checkpoint = run.latest_checkpoint() if checkpoint is None else checkpoint
    env_params, agent = run_config.load_params(run)
    composed = compose(robot_sizes(env_params), primary="play").config
    own = {key: composed[key] for key in ("seed", "play", "drive", "recording")}
    recorded = {**own, "env": run_config.on_reference_engine(run_config.upgrade_env_params(env_params)), "agent": agent}
    tree = apply_overrides(recorded, overrides)
    with placing(overrides):
        tree = tree if change is None else change(tree)
        if errors := check_tree(tree, PlayRoot):
            raise_all(errors)
        require_same_robot(recorded, tree, "a play simulates the robot that the run was trained on")
        require_read({**recorded, "play": tree["play"]}, overrides, _settings_read, _ALTERNATIVES)
        is_changed, tree = tree["env"] != recorded["env"], _in_conditions(tree)
        settings = read_section(PlayRoot, tree, "")
        env = ManagerBasedRLEnv(settings.env, saved_mjcf(run), settings.seed)
    set_threads(settings.agent, env.scene.sim.nthread)
    if not is_changed and env.scene.model_digest() != run_config.recorded_robot(run).model_sha256:
        display.note("note: the compiled model differs from the training's; is this another MuJoCo version?")
    adapter = RslRlVecEnv(env, settings.agent.clip_actions)
    policy = load_policy(checkpoint, adapter, settings.agent)
    if settings.play.conditions != "training":
        display.note("note: no pushes, random forces, or observation noise (play.conditions=training has them)")
    return RunPolicy(run, checkpoint, settings, tree, adapter, policy, rollout_files.checkpoint_facts(run, checkpoint))


def _settings_read(tree: Mapping[str, object]) -> Tree:
    """Return the settings that a play reads: of ``agent``, the policy's network and the number of accepted failures."""
    known = (*run_config.POLICY_KEYS, "max_non_finite")
    agent = {key: value for key, value in section_at(tree, "agent").items() if key in known}
    return {**_in_conditions(tree), "agent": agent}


def _in_conditions(tree: Mapping[str, object]) -> Tree:
    if at(tree, "play.conditions") == "training":
        return {**tree}
    return {**tree, "env": plain_section(without_disturbances(read_env(section_at(tree, "env"))))}


@dataclass(frozen=True)
class Played:
    """The result of a play: its files, how well the policy stood, how it moved, and the failed episodes."""

    run: RunDirectory
    checkpoint: Path
    folder: Path
    recording: Path | None
    figures: StandFigures
    motion: MotionFigures
    failures: FailureCount


def play(
    run: RunDirectory, checkpoint: Path | None, overrides: Sequence[str], command: Sequence[str], display: Display
) -> Played:
    """Apply the mean action of a policy (by default the last checkpoint) for one episode of each environment."""
    prepared = prepare_policy(run, checkpoint, overrides, display)
    settings, env = prepared.settings, prepared.adapter.env
    settle_s = float(settings.play.settle_s)
    meter, motion = StandMeter(env, settle_s), MotionMeter(env, settle_s)
    env.observers += [meter.observe, motion.observe]
    failures = FailureCount(env.num_envs, settings.agent.max_non_finite)
    content = {**prepared.about, **asdict(settings.play), "seed": settings.seed, "overrides": list(overrides)}
    with rollout_files.dated_folder(run.play) as folder:
        recording = prepared.recording(folder, command) if settings.recording.enabled else None
        if recording is not None:
            recording.warn(display.note)
        with recording or nullcontext():
            _roll(prepared, meter, failures, display)
            content |= meter.figures().as_dict() | vars(motion.figures())
            if recording is not None:
                recording.figures(content)
        dataset = rollout_files.close_dataset(folder / "dataset", env)
        write_json(folder / "figures.json", content)
        files = [*dataset, folder / "figures.json", *([recording.path] if recording else [])]
        run.manifest().add("play", files, content, command=command)
    path = recording.path if recording else None
    return Played(run, prepared.checkpoint, folder, path, meter.figures(), motion.figures(), failures)


@ending_as(SimulationFailure)
@torch.inference_mode()
def _roll(prepared: RunPolicy, meter: StandMeter, failures: FailureCount, display: Display) -> None:
    """Step the environments until each environment has finished its first episode."""
    adapter, env = prepared.adapter, prepared.adapter.env
    for step in range(env.max_episode_length):
        actions = prepared.policy(adapter.get_observations())
        require_finite_actions(env, actions)
        *_, extras = adapter.step(actions)
        failures.take(extras)
        display.steps(step + 1, env.max_episode_length)
        if not meter.running.any():
            break


AgentKind = Literal["zero", "random"]

# Contact forces are measured after the robot has landed (a drop of 15 mm takes 0.06 s) and before the robot falls.
SETTLE_S = 0.2
UPRIGHT_RAD = 0.2


@dataclass(frozen=True)
class AgentRun:
    """The result of a rollout with zero or random actions."""

    folder: Path
    recording: Path | None
    contacts: dict[str, list[ContactFigures]]  # maps each contact sensor to the forces on the links of standing robots
    figures: StandFigures  # the duration and termination of the first episode of each environment
    failures: FailureCount  # the episodes that ended because a number was NaN or inf


def run_agent(kind: AgentKind, composed: Composed, steps: int | None, display: Display) -> AgentRun:
    """Run zero or uniform random actions in [-1, 1] for ``steps`` (None: one episode), and record the rollout."""
    with composed.placing():
        experiment = read_section(Experiment, composed.config, "")
        require_recorded(composed.config)
        env = build_env(composed.config, composed.asset_roots)
    display.environment(env.describe())
    run, task = experiment.run, experiment.task.name
    name = "_".join(part for part in (kind, run.name) if part)
    directory = RunDirectory.create(run.root, task, experiment.seed, name=name, section="agents")
    with while_running():
        write_yaml(directory.path / "config.yaml", composed.config)
        sensors = [name for name in env.scene.sensors if isinstance(env.scene[name], ContactSensor)]
        meters = {name: ContactMeter(env, name, SETTLE_S, UPRIGHT_RAD) for name in sensors}
        stand = StandMeter(env, settle_s=0.0)
        failures = FailureCount(env.num_envs, experiment.agent.max_non_finite)
        env.observers += [stand.observe, *(meter.observe for meter in meters.values())]
        options, recording = experiment.recording, None
        if options.enabled:
            about = {"run_id": directory.id, "task": task, "agent": kind}
            title, documents = f"{directory.id} {kind} agent", rollout_files.config_document(composed.config)
            recording = rollout_files.EpisodeRecording(
                directory.recording, env, options, name=title, about=about, documents=documents
            )
            recording.warn(display.note)
        shape = (env.num_envs, env.action_manager.total_action_dim)
        draws = env.streams.get("agent.random") if kind == "random" else None

        def act() -> torch.Tensor:
            return torch.zeros(shape) if draws is None else 2.0 * torch.rand(shape, generator=draws) - 1.0

        with recording or nullcontext():
            _roll_agent(env, act, steps or env.max_episode_length, failures, display)
            contacts = {name: meter.figures() for name, meter in meters.items()}
            content = {"agent": kind, "figures": stand.figures().as_dict()}
            content["contacts"] = {name: [asdict(row) for row in rows] for name, rows in contacts.items()}
            if recording is not None:
                recording.figures(content)
        rollout_files.close_dataset(directory.dataset, env)
        write_json(directory.path / "figures.json", content)
        return AgentRun(directory.path, recording.path if recording else None, contacts, stand.figures(), failures)


@ending_as(SimulationFailure)
@torch.inference_mode()
def _roll_agent(
    env: ManagerBasedRLEnv, actor: Callable[[], torch.Tensor], steps: int, failures: FailureCount, display: Display
) -> None:
    env.reset()
    for step in range(steps):
        *_, extras = env.step(actor())
        failures.take(extras)
        display.steps(step + 1, steps)
