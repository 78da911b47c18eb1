"""Run a prepared training: train until the end or until a stop, and write the files of the run directory."""

from __future__ import annotations

import io
import json
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np

from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.files import for_people, while_running, write_bytes, write_text
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.train.prepare_training import Training
from wheelleg_exp.jobs.train.training_outputs import Outputs, checkpoint_due, digested, summary
from wheelleg_exp.rl import export
from wheelleg_exp.rl.options import Learning
from wheelleg_exp.rl.ranks import FirstRankFailed, digests_of_all, state_of_all_ranks
from wheelleg_exp.rl.rollout_log import logged
from wheelleg_exp.rl.trainer import Iteration, Trainer
from wheelleg_exp.run.iteration_log import LogLine, seconds_of
from wheelleg_exp.run.run_directory import FAILURE, RunDirectory
from wheelleg_exp.stop_request import StopRequest
from wheelleg_exp.user_exceptions import ending_as, in_words

_CURRICULUM, _STUCK = "Curriculum/", "stuck"


class StuckCurricula:
    """Collects the names of stuck curricula in ``now``: those with a scalar ``stuck`` or ``<part>_stuck`` above 0."""

    def __init__(self) -> None:
        self.now: list[str] = []

    def take(self, index: int, scalars: Mapping[str, float]) -> Iterator[str]:
        """Yield a warning for each curriculum that became stuck in this training iteration."""
        keys = [key for key in scalars if key.startswith(_CURRICULUM) and key.endswith(_STUCK)]
        marks = {key.removeprefix(_CURRICULUM).removesuffix(_STUCK).rstrip("_/"): scalars[key] for key in keys}
        if not marks:  # Curricula log scalars only in iterations in which an episode ends.
            return
        before, self.now = self.now, [name for name, value in marks.items() if value > 0.0]
        for name in self.now:
            if name not in before:
                term, _, part = name.partition("/")
                what = f"env.curriculum.{term}" + (f" ({part})" if part else "")
                yield f"warning: {what} is stuck by iteration {index + 1}: it has not risen within its patience"


@while_running()
def run(training: Training, display: Display, stop: StopRequest) -> dict[str, object]:
    """Train until the last iteration or a stop request, and return the training's results for the run's manifest.

    After a stop request, write the checkpoint of the last finished iteration, and raise KeyboardInterrupt. NaN or inf
    (saved with a last checkpoint), a disk that failed, or a removed run raises SimulationFailure.
    """
    trainer, directory = training.trainer, training.directory
    agent = training.recipe.experiment.agent
    total, started = agent.max_iterations, time.perf_counter()
    stuck = StuckCurricula()
    ending = ending_as(SimulationFailure)
    with training.lock, training.manifest.finishing() as results, ending, _outputs(training, display) as outputs:
        results |= (before := _earlier_results(training.earlier))
        if outputs.recording is not None:
            outputs.recording.warn(display.note)
        if outputs.wandb is not None:
            display.note(f"scalars and config go to {outputs.wandb.place}")
        stop.check(trainer.ranks.any(stop.requested))
        for iteration in _iterations(training, outputs, results):
            for key in before.keys() - {"checkpoint", "non_finite"}:  # They describe the iteration before the resume.
                results.pop(key, None)
            due = checkpoint_due(iteration.index, agent)
            training.recomputed(iteration.index, outputs.write(iteration, due))
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


def run_other_rank(trainer: Trainer, agent: Learning, stop: StopRequest) -> None:
    """Train in a rank above 0, and send the training state to rank 0, which writes it into checkpoints."""
    total, state, unsaved = agent.max_iterations, None, False
    ranks = trainer.ranks
    stop.check(ranks.any(stop.requested))
    try:
        for iteration in trainer.learn(until=total):
            trainer.env.env.recorder_manager.take()
            state = trainer.state_dict()
            due = checkpoint_due(iteration.index, agent)
            digests_of_all(ranks, digested(trainer, state, due))
            stopped = ranks.any(stop.requested)
            unsaved = not (due or stopped)
            if not unsaved:
                state_of_all_ranks(ranks, state)
            stop.check(stopped)
    except FirstRankFailed as failure:
        if failure.saves_state and unsaved and state is not None:
            state_of_all_ranks(ranks, state)
        raise


def record_untrained(training: Training, display: Display) -> None:
    """Write the files of a run whose networks come from elsewhere: its iteration 0 only records them."""
    trainer, agent = training.trainer, training.recipe.experiment.agent
    with training.lock, training.manifest.finishing() as results, _outputs(training, display) as outputs:
        trainer.iteration = 1
        outputs.write(Iteration(0, {}, 0), due=True)
        results |= {"checkpoint": outputs.checkpoint(0), "iterations": 1, "seconds": 0.0}
        export_policy(training.directory, trainer, agent)


def _iterations(training: Training, outputs: Outputs, results: dict[str, object]) -> Iterator[Iteration]:
    """Yield the training iterations, and count the episodes that ended because of a NaN or inf."""
    # If an iteration fails, save the failed state and the checkpoint of the last finished iteration.
    trainer, before = training.trainer, results.get("non_finite")
    failed = Counter[str](before if isinstance(before, dict) else {})
    try:
        for iteration in trainer.learn(until=training.recipe.experiment.agent.max_iterations):
            failed.update(logged(iteration.scalars))
            if failed:
                results["non_finite"] = dict(failed)
            yield iteration
    except SimulationFailure as error:
        if error.evidence:
            name = outputs.last_checkpoint()
            results |= {} if name is None else {"checkpoint": name}
            # Write the evidence: arrays by name, and ``about``, a JSON text that describes the arrays.
            entry: dict[str, object] = {"file": FAILURE, "key": error.key, "iteration": trainer.iteration}
            entry["message"] = error.message
            env, arrays = trainer.env.env, {name: value.cpu().numpy() for name, value in error.evidence.items()}
            about = {**entry, "joints": env.scene.robot.joint_names, "bodies": env.scene.robot.body_names}
            about |= {"reward_terms": env.reward_manager.active_terms}
            about |= {"observations": env.observation_manager.active_terms}
            buffer = io.BytesIO()
            np.savez(buffer, allow_pickle=False, about=np.array(json.dumps(about)), **arrays)
            write_bytes(training.directory.path / FAILURE, buffer.getvalue())
            training.manifest.record(failure=entry)
        raise


@contextmanager
def _outputs(training: Training, display: Display) -> Iterator[Outputs]:
    """Open the run's output files; on exit, record how the training ended. An error of the block takes precedence."""
    outputs = Outputs(training)
    try:
        with outputs:
            yield outputs
    except BaseException as error:
        try:
            _record_end(training, outputs, display)
        except Exception as second:
            error.add_note(f"the end could not be recorded: {second}")
        raise
    _record_end(training, outputs, display)


def _record_end(training: Training, outputs: Outputs, display: Display) -> None:
    training.manifest.record(last_ended_by=dict(training.trainer.env.env.termination_manager.last_endings()))
    if outputs.diverged_after is not None:
        what = f"from iteration {outputs.diverged_after} on, the networks of the ranks are not equal to the bit"
        display.note(f"warning: {what}")
    if outputs.films is not None and outputs.films.ended:
        display.note(f"warning: {outputs.films.ended}")
    unfinished = None if outputs.recording is None else outputs.recording.unfinished
    if unfinished:
        text = f"warning: the recording has no index, and lacks nothing else ({unfinished}); "
        display.note(text + "'wheelleg inspect RUN --repair' writes a copy with one")
    # A resumed run may have finished a recording that was unfinished before.
    if unfinished or "recording_unfinished" in training.manifest.data:
        training.manifest.record(recording_unfinished=unfinished)


def _earlier_results(earlier: Sequence[LogLine]) -> dict[str, object]:
    """Return the results of the iterations before the resume, such as their number and the last scalars."""
    if not earlier:
        return {}
    done = len(earlier)
    facts = {"checkpoint": f"model_{done - 1}.pt", "iterations": done, "seconds": seconds_of(earlier)}
    scalars = ({key: float(str(value)) for key, value in line["scalars"].items()} for line in earlier)
    failed = sum(map(Counter, map(logged, scalars)), Counter[str]())
    return facts | summary(earlier[-1]["scalars"]) | ({"non_finite": dict(failed)} if failed else {})


def export_policy(directory: RunDirectory, trainer: Trainer, agent: Learning) -> None:
    """Write ``exported/``: the policy as TorchScript and ONNX, and its description."""
    try:
        with trainer.played() as policy:
            files = {"policy.pt": export.torchscript(policy), "policy.onnx": export.onnx(policy)}
    except Exception as error:  # torch's ONNX exporter raises many types of errors, with messages of many lines.
        message = f"the trained policy cannot be exported: {in_words(error).splitlines()[0]}"
        expected = "MLPModel, or a network that needs nothing but the observations; the checkpoints are whole"
        raise SimulationFailure(message, key="agent.actor.class_name", expected=expected) from error
    with for_people(directory.exported):
        directory.exported.mkdir(exist_ok=True)
    for name, content in files.items():
        write_bytes(directory.exported / name, content)
    write_text(directory.exported / "policy.json", export.description(trainer.env.env, agent, trainer.iteration - 1))
