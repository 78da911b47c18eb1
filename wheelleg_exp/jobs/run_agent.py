"""Run an agent without a policy: zero or random actions, to inspect a task before training."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import torch

from wheelleg_exp.build import build_env
from wheelleg_exp.config.checking.check_terms import require_recorded
from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.config.schema import Experiment
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.files import while_running, write_json, write_yaml
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.rollout_figures import ContactFigures, ContactMeter, StandFigures, StandMeter
from wheelleg_exp.jobs.rollout_files import EpisodeRecording, close_dataset, config_document
from wheelleg_exp.rl.rollout_log import FailureCount
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.sim.sensors import ContactSensor
from wheelleg_exp.terms.config_sections import read_section
from wheelleg_exp.user_exceptions import ending_as

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
            title, documents = f"{directory.id} {kind} agent", config_document(composed.config)
            recording = EpisodeRecording(
                directory.recording, env, options, name=title, about=about, documents=documents
            )
            recording.warn(display.note)
        shape = (env.num_envs, env.action_manager.total_action_dim)
        draws = env.streams.get("agent.random") if kind == "random" else None

        def act() -> torch.Tensor:
            return torch.zeros(shape) if draws is None else 2.0 * torch.rand(shape, generator=draws) - 1.0

        with recording or nullcontext():
            _roll(env, act, steps or env.max_episode_length, failures, display)
            contacts = {name: meter.figures() for name, meter in meters.items()}
            content = {"agent": kind, "figures": stand.figures().as_dict()}
            content["contacts"] = {name: [asdict(row) for row in rows] for name, rows in contacts.items()}
            if recording is not None:
                recording.figures(content)
        close_dataset(directory.dataset, env)
        write_json(directory.path / "figures.json", content)
        return AgentRun(directory.path, recording.path if recording else None, contacts, stand.figures(), failures)


@ending_as(SimulationFailure)
@torch.inference_mode()
def _roll(
    env: ManagerBasedRLEnv, actor: Callable[[], torch.Tensor], steps: int, failures: FailureCount, display: Display
) -> None:
    env.reset()
    for step in range(steps):
        *_, extras = env.step(actor())
        failures.take(extras)
        display.steps(step + 1, steps)
