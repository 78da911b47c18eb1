"""Evaluate a policy or an LQR controller in fixed scenarios, and save the result in ``evaluation/<time>/`` of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from wheelleg_exp.asset.conversion_cache import source_digest
from wheelleg_exp.build import with_robot_file
from wheelleg_exp.config.checking.find_mistakes import check_tree
from wheelleg_exp.config.composing.compose import apply_overrides, compose, placing, require_read
from wheelleg_exp.config.composing.sized_values import robot_sizes
from wheelleg_exp.config.config_errors import raise_all
from wheelleg_exp.config.tree_lookup import section_at
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError, SimulationFailure
from wheelleg_exp.evaluation.evaluation_env import evaluation_options, target_heights
from wheelleg_exp.evaluation.lqr_balancer import Reference
from wheelleg_exp.evaluation.protocol import MakePolicy, Progress, evaluate
from wheelleg_exp.evaluation.protocol_options import EvaluateRoot, Protocol
from wheelleg_exp.evaluation.result import Evaluation
from wheelleg_exp.files import sha256, write_json
from wheelleg_exp.jobs.rollout_files import checkpoint_facts, dated_folder
from wheelleg_exp.jobs.saved_evaluation import (
    EPISODES,
    RESULT,
    read_content,
    read_evaluation,
    write_episodes,
)
from wheelleg_exp.jobs.saved_robot import require_same_robot, saved_mjcf
from wheelleg_exp.jobs.torch_threads import set_threads
from wheelleg_exp.rl.network_loading import load_policy
from wheelleg_exp.rl.options import Learning
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run import run_config
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.sim.options import engine_kind, read_env
from wheelleg_exp.terms.config_sections import plain_section, read_section
from wheelleg_exp.user_exceptions import ending_as

_ALTERNATIVES = {
    "env.num_envs": "the episodes of a test, such as protocol.stand.episodes",
    "env.episode_length_s": "the length of a test, such as protocol.stand.horizon_s",
    "env.scene.terrain": "protocol.ground=own, which evaluates on the task's own ground",
    "env.rewards": "a key that an evaluation reads: rewards are not computed",
    "agent.device": "env.sim.engine and env.sim.device: the policy runs where the simulation does",
    "agent": "agent.torch_threads, agent.clip_actions, or a key of the policy's network",
    "": "a key of what is evaluated: robot, scene, actions, observations, failures, events at startup and reset",
}


def evaluation_settings(
    run: RunDirectory, overrides: Sequence[str], config_dirs: Sequence[Path] = ()
) -> tuple[EvaluateRoot, dict[str, object]]:
    """Return the config of an evaluation, and its section ``protocol`` as plain data, which results contain.

    Overrides of other keys than ``protocol`` and ``seed`` change the run's config.
    """
    mine = [text for text in overrides if _is_of_protocol(text)]
    others = run_overrides(overrides)
    env, agent = run_config.load_params(run)
    composed = compose([*robot_sizes(env), *mine], primary="evaluate", config_dirs=config_dirs)
    recorded = {"env": run_config.on_reference_engine(run_config.upgrade_env_params(env)), "agent": agent}
    tree = {**apply_overrides(recorded, others), **{key: composed.config[key] for key in ("seed", "protocol")}}
    with composed.placing(), placing(others):
        if errors := check_tree(tree, EvaluateRoot):
            raise_all(errors)
        require_same_robot(recorded, tree, "a policy is evaluated on the robot that it was trained on")
        config = read_section(EvaluateRoot, tree, "")
        require_read(recorded, others, lambda changed: _settings_read(changed, config.protocol), _ALTERNATIVES)
        config = replace(config, env=with_robot_file(config.env, composed.asset_roots))
        if engine_kind(config.env.sim.engine).reads_robot_file:
            saved, present = run_config.recorded_robot(run).sources, source_digest(Path(config.env.robot.asset))
            if changed := [name for name, digest in present.items() if saved.get(name) != digest]:
                message = f"{changed[0]} differs from the file that the run was trained with"
                raise ConfigError(message, key="env.robot.asset", expected="the run's robot, or env.sim.engine=mujoco")
    return config, tree["protocol"]


def _settings_read(tree: Mapping[str, object], protocol: Protocol) -> Mapping[str, object]:
    """Return the parts of the config sections ``env`` and ``agent`` that an evaluation uses."""
    env = read_env(section_at(tree, "env"))
    agent = {key: value for key, value in section_at(tree, "agent").items() if key in run_config.POLICY_KEYS}
    used = plain_section(evaluation_options(env, protocol, 0, 0.0, protocol.ground))
    rewards = {} if protocol.target_height is not None else target_heights(env)
    return {"env": {**used, "rewards": rewards}, "agent": agent}


def _noisy_groups(config: EvaluateRoot) -> list[str]:
    """Return the groups of observations of the policy with the noise of its training, which an evaluation leaves on."""
    seen = {name: config.env.observations[name] for name in config.agent.obs_groups[config.agent.roles[0]]}
    return [
        n for n, group in seen.items() if group.enable_corruption and any(t.get("noise") for t in group.terms.values())
    ]


def run_overrides(overrides: Sequence[str]) -> list[str]:
    """Return an evaluation's overrides without those of ``protocol`` and ``seed``, such as ``seed=3``."""
    return [text for text in overrides if not _is_of_protocol(text)]


def _is_of_protocol(override: str) -> bool:
    key = override.lstrip("+~").partition("=")[0]
    return key.split(".")[0].split("@")[0] in ("protocol", "seed")


# ``Draw`` is a function that writes plots of an evaluation into a folder and returns the paths of the plots.
Draw = Callable[[Evaluation, Path], list[Path]]


@dataclass(frozen=True)
class Evaluated:
    """The result of an evaluation, as saved in ``evaluation.json``; ``checkpoint`` is None for an LQR controller.

    ``noisy`` are the groups of the policy's observations with noise.
    """

    run: RunDirectory
    checkpoint: Path | None
    folder: Path
    evaluation: Evaluation
    content: dict[str, Any]
    noisy: Sequence[str] = ()


def evaluate_run(
    run: RunDirectory,
    checkpoint: Path | None,
    overrides: Sequence[str],
    command: Sequence[str],
    progress: Progress | None = None,
    config_dirs: Sequence[Path] = (),
    draw: Draw | None = None,
    *,
    reference: bool = False,
) -> Evaluated:
    """Evaluate the mean action of a checkpoint (default: the last), and save the result in the run directory.

    With ``reference``, evaluate an LQR controller instead; ConfigError means that it cannot balance the robot.
    ``progress`` is called with the name of the current test, the finished steps, and the total steps of this test.
    """
    if checkpoint is None and not reference:
        checkpoint = run.latest_checkpoint()
    config, protocol = evaluation_settings(run, overrides, config_dirs)
    controllers: list[Reference] = []

    def make_controller(env: ManagerBasedRLEnv) -> Reference:
        controllers.append(Reference(env, config.protocol.command))
        return controllers[-1]

    make = make_controller if checkpoint is None else policy_of(checkpoint, config.agent)
    with ending_as(SimulationFailure):
        found = evaluate(config.env, saved_mjcf(run), make, protocol, config.seed, progress=progress)
    content: dict[str, Any] = {"policy": Reference.name, **controllers[0].describe()} if checkpoint is None else {}
    content |= {} if checkpoint is None else checkpoint_facts(run, checkpoint)
    content |= {"overrides": list(overrides), **found.as_dict()}
    with dated_folder(run.evaluation) as folder:
        write_episodes(folder / EPISODES, found.episodes)
        write_json(folder / RESULT, content)
        files = [folder / RESULT, folder / EPISODES, *([] if draw is None else draw(found, folder))]
        keys = ("checkpoint", "checkpoint_sha256", "seed", "scenarios_sha256", "starts_sha256")
        results = {"protocol": found.protocol["name"], **{key: content[key] for key in keys if key in content}}
        results["metrics"] = {name: figure.as_dict()["value"] for name, figure in found.metrics.items()}
        run.manifest().add(Reference.name if checkpoint is None else "evaluation", files, results, command=command)
    return Evaluated(run, checkpoint, folder, found, content, [] if checkpoint is None else _noisy_groups(config))


def policy_of(checkpoint: Path, agent: Learning) -> MakePolicy:
    """Return a function that loads a checkpoint's policy for an environment; the policy gives clipped mean actions."""

    def make(env: ManagerBasedRLEnv) -> Callable[[Mapping[str, object]], torch.Tensor]:
        set_threads(agent, env.scene.sim.nthread)
        clip = agent.clip_actions
        policy = load_policy(checkpoint, RslRlVecEnv(env, clip), agent)
        policy.to(env.device)

        def act(observations: Mapping[str, object]) -> torch.Tensor:
            actions: torch.Tensor = policy(TensorDict(dict(observations), batch_size=[env.num_envs]))
            return actions if clip is None else actions.clamp(-clip, clip)

        return act

    return make


def stored_evaluation(
    run: RunDirectory, checkpoint: Path, overrides: Sequence[str], config_dirs: Sequence[Path] = ()
) -> Evaluated | None:
    """Load the newest evaluation of a checkpoint with equal settings from the run directory, or return None."""
    config, protocol = evaluation_settings(run, overrides, config_dirs)
    asked = (sha256(checkpoint), config.seed, protocol, run_overrides(overrides))
    folders = [path.parent for path in run.evaluation.glob(f"*/{RESULT}")] if run.evaluation.is_dir() else []
    for folder in sorted(folders, reverse=True):
        content = read_content(folder)
        made = tuple(content.get(key) for key in ("checkpoint_sha256", "seed", "protocol"))
        if (*made, run_overrides(content.get("overrides") or [])) == asked:
            return Evaluated(run, checkpoint, folder, read_evaluation(folder), content, _noisy_groups(config))
    return None
