"""Prepare a training: find every mistake of the input, build environment and networks, and create the run directory.

``prepare`` calls these steps in order. Every rank calls the first two; rank 0 alone calls the last.

1. ``find_inputs``: check that the config can be recorded, find the networks of other runs, convert the robot.
2. ``build_trainer``: build the environment, set the threads, build the networks and the trainer.
3. Exchange the facts of all ranks.
4. ``create_run``: create the run directory, and write robot, configs, source snapshot, and manifest into it.

A mistake in one of the first three steps leaves no run directory behind.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from wheelleg_exp.asset import CachedConversion
from wheelleg_exp.build import prepare_asset
from wheelleg_exp.config.checking.check_terms import require_recorded
from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.files import sync_folder
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.saved_robot import save_robot
from wheelleg_exp.jobs.torch_threads import dependent_products, set_threads, thread_notes
from wheelleg_exp.jobs.train.initial_networks import find_teacher, initial_file, saved_initial, saved_teacher
from wheelleg_exp.jobs.train.scalar_logs import require_wandb
from wheelleg_exp.jobs.train.source_roots import loaded_outside, source_roots
from wheelleg_exp.jobs.train.training_recording import require_graphics
from wheelleg_exp.recording.recording_options import RecordingOptions
from wheelleg_exp.rl.determinism import no_global_draws
from wheelleg_exp.rl.ranks import ALONE, Ranks
from wheelleg_exp.rl.trainer import Trainer
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_lock import RunLock
from wheelleg_exp.run.source_changes import source_lines
from wheelleg_exp.run.source_restore import load_source
from wheelleg_exp.run.start_run import start_run


@dataclass(frozen=True)
class Recipe:
    """The inputs of a training.

    Attributes:
        config: the composed tree, plain.
        hydra_files: Hydra's own files, text by name.
        source_roots: folders whose source the snapshot holds, this package's own first.
        asset: the converted robot.
        config_dirs: the user's config folders.
        initial_run: facts about the run whose networks the training starts with.
        matmul: the decision of ``agent.matmul: auto`` in a run that is resumed; None decides by this CPU.
    """

    config: dict[str, Any]
    hydra_files: Mapping[str, str]
    source_roots: Sequence[Path]
    asset: CachedConversion
    config_dirs: Sequence[Path] = ()
    initial_run: Mapping[str, Any] = field(default_factory=dict)
    matmul: str | None = None


class RecomputedCheck:
    """Compares the iterations that a resume computes a second time with the digests in the log.

    Args:
        expected: digests by iteration, up to the iteration at which the run stopped.
        differs: called for the first iteration that differs, with the names of its digests.
        holds: called with the first and the last iteration when all are equal.
    """

    def __init__(
        self,
        expected: Mapping[int, Mapping[str, str]] | None = None,
        differs: Callable[[int, list[str]], None] | None = None,
        holds: Callable[[int, int], None] | None = None,
    ) -> None:
        self._expected = dict(expected or {})
        self._differs, self._holds = differs, holds
        self._first, self._last = min(self._expected, default=0), max(self._expected, default=-1)

    def check(self, iteration: int, found: Mapping[str, str]) -> None:
        """Compare the digests of an iteration that was computed just now."""
        expected = self._expected.pop(iteration, None)
        if expected is None:
            return
        names = sorted(name for name in expected.keys() & found.keys() if expected[name] != found[name])
        if names:
            self._expected.clear()
            if self._differs is not None:
                self._differs(iteration, names)
        elif iteration == self._last and self._holds is not None:
            self._holds(self._first, self._last)


@dataclass(frozen=True)
class Training:
    """A training that is ready to run: its input has no mistake.

    Attributes:
        recipe: the inputs.
        trainer: environment, networks, and the iteration at which training starts.
        directory: the run directory.
        manifest: the manifest of the run, status ``running``.
        lock: the lock of the run directory; a resume holds it already.
        earlier: the log lines of the iterations that are done, for a resume.
        recomputed: compares iterations that are computed a second time, for a resume.
    """

    recipe: Recipe
    trainer: Trainer
    directory: RunDirectory
    manifest: Manifest
    lock: RunLock
    earlier: Sequence[Mapping[str, Any]] = ()
    recomputed: RecomputedCheck = field(default_factory=RecomputedCheck)


def prepare(composed: Composed, command: Sequence[str], display: Display, ranks: Ranks = ALONE) -> Training:
    """Prepare a training in rank 0 (see the steps above).

    Raises:
        WheellegError: the input is wrong; no run directory was created.
    """
    with composed.placing():
        with ranks.agreed():
            recipe = find_inputs(composed, display)
        return prepare_recipe(recipe, command, display, ranks)


def prepare_recipe(recipe: Recipe, command: Sequence[str], display: Display, ranks: Ranks = ALONE) -> Training:
    """Prepare a training from its inputs: all steps but the first.

    Raises:
        WheellegError: the input is wrong; no run directory was created.
    """
    with ranks.agreed():
        trainer, threads = build_trainer(recipe, ranks)
    rank_facts = ranks.facts(recipe.config)
    directory, manifest = create_run(recipe, trainer, threads, rank_facts, command, display)
    for line in [*source_lines(load_source(directory)), *thread_notes(threads)]:
        display.note(line)
    return Training(recipe, trainer, directory, manifest, RunLock(directory))


def find_inputs(composed: Composed, display: Display) -> Recipe:
    """Find and convert what a composed config names.

    Raises:
        WheellegError: the input is wrong.
    """
    config = composed.config
    require_recorded(config)
    with initial_file(config, display.note) as (initial, initial_run):
        networks = find_teacher(config) | initial
        asset = prepare_asset(config, composed.asset_roots, networks)
    return Recipe(
        config=config,
        hydra_files=composed.hydra_files(),
        source_roots=source_roots(composed),
        asset=asset,
        config_dirs=composed.config_dirs,
        initial_run=initial_run,
    )


def build_trainer(recipe: Recipe, ranks: Ranks = ALONE) -> tuple[Trainer, dict[str, Any]]:
    """Build environment and networks; return the trainer, and the facts about threads for the manifest."""
    config = ranks.config(recipe.config)
    agent = config["agent"]
    if recipe.matmul is not None and agent.get("matmul") == "auto":
        agent = {**agent, "matmul": recipe.matmul}
    require_wandb(agent.get("logger"))
    with no_global_draws():
        env = ManagerBasedRLEnv(config["env"], recipe.asset.output, ranks.seed(config["seed"]))
    require_graphics(env, RecordingOptions(**config["recording"]))
    samples = env.num_envs * int(agent["num_steps_per_env"])
    threads = set_threads(agent, env.scene.sim.nthread, samples=samples)
    teacher = saved_teacher(recipe.asset) if "teacher" in agent else None
    initial = saved_initial(config, recipe.asset)
    adapter = RslRlVecEnv(env, agent.get("clip_actions"))
    trainer = Trainer(adapter, agent, config["seed"], teacher, initial, ranks)
    return trainer, threads | dependent_products(trainer.networks(), agent, samples, threads)


def create_run(
    recipe: Recipe,
    trainer: Trainer,
    threads: Mapping[str, Any],
    rank_facts: Mapping[str, Any] | None,
    command: Sequence[str],
    display: Display,
) -> tuple[RunDirectory, Manifest]:
    """Create the run directory with its snapshot, and return it with its manifest."""
    config, env = recipe.config, trainer.env.env
    run = config["run"]
    directory = RunDirectory.create(run["root"], config["task"]["name"], config["seed"], run.get("name"))
    try:
        display.environment(env.describe())
        save_robot(directory, recipe.asset, config["env"]["robot"]["asset"], env.scene.model_digest())
        manifest = start_run(
            directory,
            command=command,
            params={"env": config["env"], "agent": config["agent"]},
            hydra_files=recipe.hydra_files,
            source_roots=[*recipe.source_roots, *loaded_outside(recipe.source_roots)],
            seed=config["seed"],
            task=config["task"]["name"],
            threads=threads,
            max_patch_mb=run.get("max_patch_mb"),
        )
        manifest.record(engine=env.scene.sim.promise())
        manifest.record(config_dirs=[str(folder) for folder in recipe.config_dirs])
        if rank_facts is not None:
            manifest.record(ranks=rank_facts)
        if (initial := saved_initial(config, recipe.asset)) is not None:
            manifest.record(init_from={**recipe.initial_run, **initial.facts})
            source = recipe.initial_run.get("run") or initial.facts["named"]
            display.note(f"starts with the {initial.facts['what']} of {source}, {initial.facts['checkpoint']}")
        sync_folder(directory.path)
    except BaseException:
        if not (directory.path / MANIFEST_NAME).exists():  # without a manifest, nobody can identify the folder
            shutil.rmtree(directory.path, ignore_errors=True)
        raise
    return directory, manifest
