"""Train: from a composed config, or from the state of a resumed run, to a finished run directory.

``prepare`` finds every mistake of the input before it makes the run directory. ``run`` trains and writes.
"""

from __future__ import annotations

import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from wheelleg_exp.asset import CachedConversion
from wheelleg_exp.build import prepare_asset
from wheelleg_exp.config.checking.check_terms import require_recorded
from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.files import for_people, sync_folder, while_running, write_bytes, write_text
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.saved_robot import save_robot
from wheelleg_exp.jobs.torch_threads import dependent_products, set_threads, thread_notes
from wheelleg_exp.jobs.train.initial_networks import find_teacher, initial_file, saved_initial, saved_teacher
from wheelleg_exp.jobs.train.scalar_logs import WandbLog, require_wandb
from wheelleg_exp.jobs.train.source_roots import loaded_outside, source_roots
from wheelleg_exp.jobs.train.training_outputs import Outputs, checkpoint_due, save_failure, summary
from wheelleg_exp.jobs.train.training_recording import require_graphics
from wheelleg_exp.recording.recording_options import RecordingOptions
from wheelleg_exp.rl import export
from wheelleg_exp.rl.determinism import no_global_draws
from wheelleg_exp.rl.ranks import ALONE, Ranks
from wheelleg_exp.rl.rollout_log import logged
from wheelleg_exp.rl.trainer import Iteration, Trainer
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.iteration_log import seconds_of
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_lock import RunLock
from wheelleg_exp.run.source_changes import source_lines
from wheelleg_exp.run.source_restore import load_source
from wheelleg_exp.run.start_run import start_run
from wheelleg_exp.stop_request import StopRequest
from wheelleg_exp.user_exceptions import ending_as, in_words

_CURRICULUM, _STUCK = "Curriculum/", "stuck"


class StuckCurricula:
    """Finds in an iteration's scalars which curricula say that they are stuck; each is told once as long as it is.

    A curriculum says so by a figure ``stuck``, or ``<part>_stuck``, that is not 0.

    Attributes:
        now: those that are stuck, by term and part.
    """

    def __init__(self) -> None:
        self.now: list[str] = []

    def take(self, index: int, scalars: Mapping[str, float]) -> Iterator[str]:
        """Yield a line for each that is stuck since this iteration.

        Args:
            index: the iteration.
            scalars: what it logs.
        """
        marks = {key: value for key, value in scalars.items() if key.startswith(_CURRICULUM) and key.endswith(_STUCK)}
        if not marks:  # no episode has ended
            return
        before, self.now = self.now, [_curriculum_name(key) for key, value in marks.items() if value > 0.0]
        for name in self.now:
            if name not in before:
                term, _, part = name.partition("/")
                what = f"env.curriculum.{term}" + (f" ({part})" if part else "")
                yield f"warning: {what} is stuck by iteration {index + 1}: it has not risen within its patience"


def _curriculum_name(key: str) -> str:
    return key.removeprefix(_CURRICULUM).removesuffix(_STUCK).rstrip("_/")


class RecomputedCheck:
    """Holds iterations past the checkpoint of a resume against what the log had of them.

    Args:
        expected: digests by iteration, as far as the run had come when it was stopped.
        differs: told of the first iteration that is not what it was, with the names of the digests.
        holds: told when all of them were what they had been.
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
        """Take up an iteration that has just been computed."""
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
class Recipe:
    """All that a training is made from.

    Attributes:
        config: the composed tree, plain.
        hydra_files: Hydra's own files, text by name.
        source_roots: folders whose source the snapshot keeps, this package's own first.
        asset: the converted robot.
        config_dirs: the user's config folders.
        begun_with: whose networks it begins with, as far as it is known.
        matmul: what ``agent.matmul: auto`` has come to in the run that goes on; None to decide by this CPU.
    """

    config: dict[str, Any]
    hydra_files: Mapping[str, str]
    source_roots: Sequence[Path]
    asset: CachedConversion
    config_dirs: Sequence[Path] = ()
    begun_with: Mapping[str, Any] = field(default_factory=dict)
    matmul: str | None = None


@dataclass(frozen=True)
class Training:
    """A training that is ready to run: everything that can be wrong with its input has been found.

    Attributes:
        recipe: what it is made from.
        trainer: environment, networks, and the iteration from which it goes on.
        directory: where it is written.
        manifest: the run's manifest, status ``running``.
        lock: the run directory's lock; a resume has taken it already.
        earlier: the log's lines of the iterations that are done, for a resume.
        proof: what holds iterations that are computed a second time against what they were, for a resume.
    """

    recipe: Recipe
    trainer: Trainer
    directory: RunDirectory
    manifest: Manifest
    lock: RunLock
    earlier: Sequence[Mapping[str, Any]] = ()
    proof: RecomputedCheck = field(default_factory=RecomputedCheck)


def prepare(composed: Composed, command: Sequence[str], display: Display, ranks: Ranks = ALONE) -> Training:
    """Convert the robot, build environment and networks, and write the run directory's snapshot.

    Raises:
        WheellegError: the input is wrong; no run directory has been made.
    """
    with composed.placing():
        with ranks.agreed():
            recipe = recipe_of(composed, display)
        return start(recipe, command, display, ranks)


def recipe_of(composed: Composed, display: Display) -> Recipe:
    """Find and convert what a composed config names.

    Raises:
        WheellegError: the input is wrong.
    """
    require_recorded(composed.config)
    with initial_file(composed.config, display.note) as (initial, begun_with):
        networks = find_teacher(composed.config) | initial
        asset = prepare_asset(composed.config, composed.asset_roots, networks)
    return Recipe(
        config=composed.config,
        hydra_files=composed.hydra_files(),
        source_roots=source_roots(composed),
        asset=asset,
        config_dirs=composed.config_dirs,
        begun_with=begun_with,
    )


def start(recipe: Recipe, command: Sequence[str], display: Display, ranks: Ranks = ALONE) -> Training:
    """Build what a recipe says, and write the run directory's snapshot.

    Raises:
        WheellegError: the input is wrong; no run directory has been made.
    """
    config, agent = recipe.config, recipe.config["agent"]
    with ranks.agreed():
        trainer, threads = build(recipe, ranks)
    together = ranks.facts(config)
    env = trainer.env.env
    run = config["run"]
    directory = RunDirectory.create(run["root"], config["task"]["name"], config["seed"], run.get("name"))
    try:
        display.environment(env.describe())
        save_robot(directory, recipe.asset, config["env"]["robot"]["asset"], env.scene.model_digest())
        manifest = start_run(
            directory,
            command=command,
            params={"env": config["env"], "agent": agent},
            hydra_files=recipe.hydra_files,
            source_roots=[*recipe.source_roots, *loaded_outside(recipe.source_roots)],
            seed=config["seed"],
            task=config["task"]["name"],
            threads=threads,
            max_patch_mb=run.get("max_patch_mb"),
        )
        manifest.record(engine=env.scene.sim.promise())
        manifest.record(config_dirs=[str(folder) for folder in recipe.config_dirs])
        if together is not None:
            manifest.record(ranks=together)
        if (initial := saved_initial(config, recipe.asset)) is not None:
            manifest.record(init_from={**recipe.begun_with, **initial.facts})
            whose = recipe.begun_with.get("run") or initial.facts["named"]
            display.note(f"begins with the {initial.facts['what']} of {whose}, {initial.facts['checkpoint']}")
        sync_folder(directory.path)
    except BaseException:
        if not (directory.path / MANIFEST_NAME).exists():  # nobody could tell what it is
            shutil.rmtree(directory.path, ignore_errors=True)
        raise
    for line in [*source_lines(load_source(directory)), *thread_notes(threads)]:
        display.note(line)
    return Training(recipe, trainer, directory, manifest, RunLock(directory))


def build(recipe: Recipe, ranks: Ranks = ALONE) -> tuple[Trainer, dict[str, Any]]:
    """Build environment and networks; return the trainer, and what the manifest says of threads."""
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
    adapted = RslRlVecEnv(env, agent.get("clip_actions"))
    trainer = Trainer(adapted, agent, config["seed"], teacher, initial, ranks)
    return trainer, threads | dependent_products(trainer.networks(), agent, samples, threads)


@while_running()
def run(training: Training, display: Display, stop: StopRequest) -> dict[str, Any]:
    """Train to the end, or until a stop is asked for, and return the results that the manifest records.

    Raises:
        KeyboardInterrupt: training was stopped; the run directory holds a checkpoint of the last iteration.
        SimulationFailure: numbers were not finite, the disk failed, or the run directory is not what it was; of
            numbers, it holds what they came from, and a checkpoint of the last iteration that was whole.
    """
    trainer, directory = training.trainer, training.directory
    agent = training.recipe.config["agent"]
    total, started = int(agent["max_iterations"]), time.perf_counter()
    stuck = StuckCurricula()
    ending = ending_as(SimulationFailure)
    with training.lock.held(), training.manifest.finishing() as results, ending, _outputs(training, display) as outputs:
        results |= _earlier_results(training.earlier)
        if outputs.note:
            display.note(f"warning: {outputs.note}")
        if outputs.sent_to:
            display.note(f"scalars and config go to {outputs.sent_to}")
        stop.check(trainer.ranks.any(stop.requested))
        for iteration in _iterations(training, outputs, results):
            due = checkpoint_due(iteration.index, agent)
            training.proof.check(iteration.index, outputs.write(iteration, due))
            display.iteration(iteration, total)
            for line in stuck.take(iteration.index, iteration.scalars):
                display.note(line)
            stopped = trainer.ranks.any(stop.requested)
            last = stopped or iteration.index + 1 == total
            if due or stopped:
                results["checkpoint"] = outputs.checkpoint(iteration.index)
            if last:
                seconds = seconds_of(training.earlier) + time.perf_counter() - started
                results |= {"iterations": iteration.index + 1, "seconds": seconds, **summary(iteration.scalars)}
                results |= {"stuck_curricula": stuck.now} if stuck.now else {}
            stop.check(stopped)
        export_policy(directory, trainer, agent)
    return results


def _iterations(training: Training, outputs: Outputs, results: dict[str, Any]) -> Iterator[Iteration]:
    """Yield the iterations; of one whose numbers fail, keep what it failed with, and the checkpoint of the one before.

    The results tell of the episodes that ended because a number was not finite.
    """
    trainer, failed = training.trainer, Counter[str]()
    for line in training.earlier:
        failed.update(logged(line["scalars"]))
    try:
        for iteration in trainer.learn(until=int(training.recipe.config["agent"]["max_iterations"])):
            failed.update(logged(iteration.scalars))
            if failed or "non_finite" in training.manifest.results:  # of iterations that are computed again
                results["non_finite"] = dict(failed)
            yield iteration
    except SimulationFailure as error:
        if error.evidence:
            name = outputs.last_checkpoint()
            results |= {} if name is None else {"checkpoint": name}
            save_failure(training.directory, training.manifest, error, trainer.iteration, trainer.env.env)
        raise


@contextmanager
def _outputs(training: Training, display: Display) -> Iterator[Outputs]:
    """Open what the run writes; when it is closed, record how episodes ended, and tell of an unfinished recording."""
    outputs = _make_outputs(training)
    first: BaseException | None = None
    try:
        with outputs:
            try:
                yield outputs
            except BaseException as error:
                first = error
                raise
    except BaseException as error:
        first = first or error  # what closing found besides is told of the same failure
        try:
            _record_end(training, outputs, display)
        except Exception as second:
            first.add_note(f"the end could not be recorded: {second}")
        raise first from first.__cause__
    _record_end(training, outputs, display)


def _record_end(training: Training, outputs: Outputs, display: Display) -> None:
    training.manifest.record(last_ended_by=dict(training.trainer.env.env.termination_manager.last_endings()))
    if outputs.parted is not None:
        display.note(f"warning: from iteration {outputs.parted} on the processes' networks are not equal to the bit")
    if outputs.unfilmed:
        display.note(f"warning: {outputs.unfilmed}")
    unfinished = outputs.unfinished
    if unfinished:
        display.note(
            f"warning: the recording has no index, and lacks nothing else ({unfinished}); "
            "'wheelleg inspect RUN --repair' writes a copy with one"
        )
    if unfinished or "recording_unfinished" in training.manifest.data:  # of an earlier process
        training.manifest.record(recording_unfinished=unfinished)


def _make_outputs(training: Training) -> Outputs:
    config = training.recipe.config
    documents = {"config": f"```yaml\n{training.recipe.hydra_files['config.yaml']}\n```"}
    options = RecordingOptions(**config["recording"])
    logger, directory = config["agent"].get("logger"), training.directory
    wandb = WandbLog(directory, config) if logger == "wandb" else None
    return Outputs(directory, training.trainer, options, documents, events=logger is not None, wandb=wandb)


def _earlier_results(earlier: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the results of the iterations that are done already."""
    if not earlier:
        return {}
    done = len(earlier)
    facts = {"checkpoint": f"model_{done - 1}.pt", "iterations": done, "seconds": seconds_of(earlier)}
    return facts | summary(earlier[-1]["scalars"])


def export_policy(directory: RunDirectory, trainer: Trainer, agent: dict[str, Any]) -> None:
    """Write ``exported/``: the policy as TorchScript and ONNX, and its description."""
    try:
        with trainer.played() as policy:
            files = {"policy.pt": export.torchscript(policy), "policy.onnx": export.onnx(policy)}
    except Exception as error:  # torch's exporter has a report of many lines for each
        raise SimulationFailure(
            f"the trained policy cannot be exported: {in_words(error).splitlines()[0]}",
            key="agent.actor.class_name",
            expected="MLPModel, or a network that needs nothing but the observations; the checkpoints are whole",
        ) from error
    with for_people(directory.exported):
        directory.exported.mkdir(exist_ok=True)
    for name, content in files.items():
        write_bytes(directory.exported / name, content)
    description = export.description(trainer.env.env, agent, trainer.iteration - 1)
    write_text(directory.exported / "policy.json", description)
