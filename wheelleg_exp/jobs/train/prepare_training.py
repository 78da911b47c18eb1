"""Prepare a training: find every mistake of the input, build environment and networks, and create the run directory.

Every rank builds the environment and the networks; only rank 0 creates the run directory. ``prepare`` calls, in order:

1. ``find_inputs``: check that the config can be recorded, find the networks of other runs, convert the robot.
2. ``build_trainer``: build the environment, set the threads, build the networks and the trainer.
3. ``prepare_recipe``: create the run directory, and write robot, configs, source snapshot, and manifest into it.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from wheelleg_exp.asset import CachedConversion
from wheelleg_exp.build import prepare_asset
from wheelleg_exp.config.checking.check_terms import require_recorded
from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.config.schema import Experiment
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.evaluation.lqr_balancer import NoBalance, Reference
from wheelleg_exp.files import sync_folder
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.saved_robot import save_robot
from wheelleg_exp.jobs.torch_threads import dependent_products, set_threads, thread_notes
from wheelleg_exp.jobs.train.initial_networks import find_teacher, initial_file, saved_initial
from wheelleg_exp.jobs.train.source_roots import loaded_outside, module_digests, source_roots
from wheelleg_exp.jobs.train.training_recording import require_graphics
from wheelleg_exp.paths import TEACHER
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.determinism import no_global_draws
from wheelleg_exp.rl.options import Agent, DistillationAgent, Learning, Matmul
from wheelleg_exp.rl.ranks import ALONE, Ranks
from wheelleg_exp.rl.trainer import Trainer
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.iteration_log import LogLine
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_lock import RunLock
from wheelleg_exp.run.source_changes import source_lines
from wheelleg_exp.run.source_restore import load_source
from wheelleg_exp.run.start_run import start_run
from wheelleg_exp.terms.config_sections import read_section


@dataclass(frozen=True)
class Recipe:
    """The inputs of a training. ``config`` is the composed config as plain data, which the run directory stores."""

    config: dict[str, Any]
    hydra_files: Mapping[str, str]
    source_roots: Sequence[Path]  # the source folders to record; the folder of this package comes first
    asset: CachedConversion
    config_dirs: Sequence[Path] = ()
    initial_run: Mapping[str, object] = field(default_factory=dict)
    matmul: Matmul | None = None  # the matrix product precision of a resumed run; None for a new run

    @cached_property
    def experiment(self) -> Experiment:
        """The config of the training as options."""
        return read_section(Experiment, self.config, "")


@dataclass(frozen=True)
class Training:
    """A prepared training, with its environment, networks, and run directory."""

    recipe: Recipe
    trainer: Trainer
    directory: RunDirectory
    manifest: Manifest
    lock: RunLock  # acquired in a resume
    earlier: Sequence[LogLine] = ()  # the log lines of the iterations that finished before the resume
    recomputed: Callable[[int, Mapping[str, str]], None] = lambda _iteration, _digests: None


def prepare(composed: Composed, command: Sequence[str], display: Display, ranks: Ranks = ALONE) -> Training:
    """Prepare a training in rank 0. If a setting is wrong, raise WheellegError and create no run directory."""
    with composed.placing():
        with ranks.agreed():
            recipe = find_inputs(composed, display)
        return prepare_recipe(recipe, command, display, ranks)


def prepare_other_rank(composed: Composed, ranks: Ranks) -> tuple[Trainer, Learning]:
    """Prepare a training in a rank above 0; return the trainer and the agent's options. Rank 0 reports errors."""
    with ranks.agreed():
        recipe = find_inputs(composed, Display())
    with ranks.agreed():
        trainer, _ = build_trainer(recipe, ranks)
    ranks.facts(recipe.experiment.seed, recipe.experiment.agent.device)
    return trainer, recipe.experiment.agent


def prepare_recipe(recipe: Recipe, command: Sequence[str], display: Display, ranks: Ranks = ALONE) -> Training:
    """Build a training from its inputs, and create its run directory with a snapshot of config and source code."""
    with ranks.agreed():
        trainer, threads = build_trainer(recipe, ranks)
    rank_facts = ranks.facts(recipe.experiment.seed, recipe.experiment.agent.device)
    config, env = recipe.experiment, trainer.env.env
    directory = RunDirectory.create(config.run.root, config.task.name, config.seed, config.run.name)
    try:
        display.environment(env.describe())
        save_robot(directory, recipe.asset, config.env.robot.asset, env.scene.model_digest())
        manifest = start_run(
            directory,
            command=command,
            params={"env": recipe.config["env"], "agent": recipe.config["agent"]},
            hydra_files=recipe.hydra_files,
            source_roots=[*recipe.source_roots, *loaded_outside(recipe.source_roots)],
            seed=config.seed,
            task=config.task.name,
            threads=threads,
            max_patch_mb=config.run.max_patch_mb,
        )
        folders = [str(folder) for folder in recipe.config_dirs]
        manifest.record(engine=env.scene.sim.promise(), modules=module_digests(), config_dirs=folders)
        if rank_facts is not None:
            manifest.record(ranks=rank_facts)
        if (initial := saved_initial(config.init_from, recipe.asset)) is not None:
            manifest.record(init_from={**recipe.initial_run, **initial.facts})
            source = recipe.initial_run.get("run") or initial.facts["named"]
            display.note(f"starts with the {initial.facts['what']} of {source}, {initial.facts['checkpoint']}")
        sync_folder(directory.path)
    except BaseException:
        if not (directory.path / MANIFEST_NAME).exists():  # A run directory without a manifest is useless: remove it.
            shutil.rmtree(directory.path, ignore_errors=True)
        raise
    for line in [*source_lines(load_source(directory)), *thread_notes(threads), *trainer.notes]:
        display.note(line)
    return Training(recipe, trainer, directory, manifest, RunLock(directory))


def find_inputs(composed: Composed, display: Display) -> Recipe:
    """Return the inputs of a training: the robot and the networks that a composed config names."""
    config = composed.config
    require_recorded(config)
    if lacking := composed.terms_without_role:
        display.note(f"left out, because the robot lists no joints or links for them: {', '.join(lacking)}")
    with initial_file(config, display.note) as (initial, initial_run):
        asset = prepare_asset(config, composed.asset_roots, find_teacher(config) | initial)
    roots, folders = source_roots(composed), composed.config_dirs
    return Recipe(config, composed.hydra_files(), roots, asset, folders, initial_run)


def build_trainer(recipe: Recipe, ranks: Ranks = ALONE) -> tuple[Trainer, dict[str, object]]:
    """Build the environment and the networks; return the trainer, and facts about threads for the run's manifest."""
    experiment = recipe.experiment
    agent, seed = ranks.agent(experiment.agent), experiment.seed
    if recipe.matmul is not None and agent.matmul == "auto":
        agent = replace(agent, matmul=recipe.matmul)
    if agent.logger == "wandb" and find_spec("wandb") is None:
        message, expected = "the package wandb is not installed", "pip install wheelleg_exp[wandb], or tensorboard"
        raise ConfigError(message, key="agent.logger", expected=expected)
    with no_global_draws():
        env = ManagerBasedRLEnv(ranks.env(experiment.env), recipe.asset.output, ranks.seed(seed))
    require_graphics(env, experiment.recording)
    samples = env.num_envs * agent.num_steps_per_env
    engine = env.scene.sim
    threads = set_threads(agent, engine.nthread, samples=samples, physics_device=str(engine.device))
    path = recipe.asset.output.parent / TEACHER
    teacher = checkpoint.load(path) if isinstance(agent, DistillationAgent) and path.is_file() else None
    initial = saved_initial(experiment.init_from, recipe.asset)
    imitates = isinstance(agent, Agent) and agent.warm_start > 0 and initial is None
    controller, notes = None, []
    try:
        controller = Reference(env) if imitates else None
    except NoBalance as error:
        notes.append(f"no warm start: {error.message}")
    except ConfigError as error:
        error.expected = f"{error.expected}; or agent.warm_start=0"
        raise
    trainer = Trainer(RslRlVecEnv(env, agent.clip_actions), agent, seed, teacher, initial, ranks, controller)
    if isinstance(agent, Agent) and agent.symmetry is not None and trainer.env.mirror is None:
        notes.append("the robot has no joint_pairs, so the policy learns without mirror images")
    trainer.notes = notes
    return trainer, threads | dependent_products(trainer.networks(), agent, samples, threads)
