"""Train each phase of a pipeline as an ordinary run in a child process, and resume a stopped or killed pipeline."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import takewhile
from pathlib import Path
from typing import Literal

from wheelleg_exp.build import prepare_asset
from wheelleg_exp.child_process import Event
from wheelleg_exp.config.checking.find_mistakes import compose_valid
from wheelleg_exp.config.composing.compose import Composed, apply_overrides, compose, placing
from wheelleg_exp.config.composing.compose_sweep import digest_of
from wheelleg_exp.config.config_errors import parts, raise_all
from wheelleg_exp.config.explaining.config_diff import Change, changes, same
from wheelleg_exp.errors import (
    ConfigError,
    Interrupted,
    RunDirectoryError,
    SimulationFailure,
    WheellegError,
    nearest_name,
)
from wheelleg_exp.evaluation.protocol import metric_names
from wheelleg_exp.evaluation.protocol_options import Protocol
from wheelleg_exp.files import while_running
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.pipeline.pipeline_phases import Gate, Phase, judge
from wheelleg_exp.jobs.pipeline.pipeline_settings import (
    PipelineSettings,
    compose_gate,
    name_phase,
    phase_overrides,
    place_gate_error,
    read_pipeline,
)
from wheelleg_exp.jobs.training_job import JobRequest, run_request
from wheelleg_exp.packages import join_recorded, left_out
from wheelleg_exp.rl.trainer import Iteration
from wheelleg_exp.run.run_config import require_overrides
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_index import PhaseEntry, PipelineIndex, PipelineStatus
from wheelleg_exp.run.run_lock import is_alive
from wheelleg_exp.run.timestamps import utc_now, utc_text
from wheelleg_exp.stop_request import StopRequest
from wheelleg_exp.terms.config_sections import read_section
from wheelleg_exp.terms.key_syntax import PIPELINE, names_pipeline

# Of a phase that has already started, a resume can change only ``max_iterations`` and ``gate``.
_CHANGEABLE_LATER = ("max_iterations", "gate")


def require_metrics(phases: Mapping[str, Phase], composed: Mapping[str, Composed], folders: Sequence[Path]) -> None:
    """Raise ConfigError if a phase's evaluation does not compute a metric for which the phase has a bound."""
    mistakes: list[ConfigError] = []
    for name, phase in phases.items():
        gate, config = phase.gate, composed[name].config
        if gate is None:
            continue
        try:
            whole = compose_gate(gate, folders)
            with whole.placing():
                read_section(Protocol, whole.config["protocol"], "protocol")
            env = {**config["env"], "sim": {**config["env"]["sim"], "engine": "mujoco", "device": "cpu"}}
            robot = prepare_asset(config, composed[name].asset_roots).output
            names = metric_names(env, robot, whole.config["protocol"])
        except ConfigError as error:
            mistakes += [name_phase(place_gate_error(part, name, gate), name) for part in parts(error)]
            continue
        asked = [("at_least", metric) for metric in gate.at_least] + [("at_most", metric) for metric in gate.at_most]
        for bound, metric in ((bound, metric) for bound, metric in asked if metric not in names):
            message = f"protocol '{gate.protocol}' has no such metric"
            key = f"{PIPELINE}.phases.{name}.gate.{bound}.{metric}"
            expected = f"a metric of its evaluations, such as {', '.join(names[:3])}"
            mistakes.append(ConfigError(message, key=key, expected=expected, nearest=nearest_name(metric, names)))
    if mistakes:
        raise_all(mistakes)


class PipelineRunner:
    """Runs the unfinished phases of a pipeline, until a phase fails its gate (evaluation) or a stop is requested.

    Each step has its own process. A phase's run is bitwise equal to one of ``wheelleg train``.
    """

    def __init__(self, index: PipelineIndex, settings: PipelineSettings, display: Display, stop: StopRequest) -> None:
        self._index, self._settings, self._display, self._stop = index, settings, display, stop
        self._folders = [Path(folder) for folder in index.data["config_dirs"]]

    @while_running()
    def run(self) -> PipelineStatus:
        """Run the unfinished phases of a pipeline, and return the pipeline's status."""
        status: PipelineStatus = "failed"
        why: str | None = None
        try:
            status, why = self._run()
        except KeyboardInterrupt:
            status = "interrupted"
        except WheellegError as error:
            why = str(error)
            raise
        finally:
            self._index.finish(status, why)
        return status

    def _run(self) -> tuple[PipelineStatus, str | None]:
        source: Path | None = None
        for name, phase in self._settings.phases.items():
            entry = next(entry for entry in self._index.phases if entry["name"] == name)
            if entry["status"] != "passed":
                self._index.update(entry, status="training", started=entry["started"] or utc_text(utc_now()))
                passed, why = self._phase(entry, phase, source)
                self._index.update(entry, status="passed" if passed else "failed", why=why, ended=utc_text(utc_now()))
                if not passed:
                    return "stopped", f"phase '{name}': {why}"
            run = self._index.run_of(entry)
            assert run is not None
            source = run / f"model_{entry['trained'] - 1}.pt"
        return "finished", None

    def _phase(self, entry: PhaseEntry, phase: Phase, source: Path | None) -> tuple[bool, str]:
        """Train one phase, and evaluate its policy regularly; return whether it passed the gate, and why it ended."""
        while True:
            target = self._target(entry, phase)
            self._train(entry, phase, source, target)
            if phase.gate is None:
                return True, f"trained {target} iterations; there is no gate"
            if not any(found["iteration"] == target for found in entry["gates"]):
                self._judge(entry, phase.gate, target, last=target >= phase.max_iterations)
            verdicts = [bool(found["passed"]) for found in entry["gates"]]
            in_a_row, last = len(list(takewhile(bool, reversed(verdicts)))), target >= phase.max_iterations
            times = "once" if in_a_row == 1 else f"{in_a_row} times in a row"
            if last and not verdicts[-1]:
                wrong = "; ".join(entry["gates"][-1]["why"])
                return False, f"the gate is not passed after {target} iterations: {wrong}"
            if last or in_a_row >= phase.gate.passes:
                when = "training" if last else f"{target} iterations"
                return True, f"the gate was passed {times}, after {when}"

    def _target(self, entry: PhaseEntry, phase: Phase) -> int:
        """Return the iteration count at which the training of ``phase`` pauses for an evaluation or ends."""
        every = phase.gate.every if phase.gate is not None else None
        if not every:
            return phase.max_iterations
        judged = entry["gates"][-1]["iteration"] if entry["gates"] else 0
        # A resume can reduce the evaluation interval ``every`` (iterations), so that an evaluation is already overdue.
        steps = max(1, -(-(self._index.done(entry) - judged) // every))
        return min(phase.max_iterations, judged + every * steps)

    def _train(self, entry: PhaseEntry, phase: Phase, source: Path | None, target: int) -> None:
        if entry["trained"] >= target:
            return
        run, done = self._index.run_of(entry), 0
        if run is None:
            words = phase_overrides(entry["name"], phase, self._index.data["overrides"])
            if digest_of(compose_valid(words, config_dirs=self._folders)) != entry["digest"]:
                self._display.note(f"note: {entry['name']}: its config has changed since the pipeline started")
                self._index.update(entry, config_changed=True)
            words.append(f"agent.max_iterations={target}")
            if source is not None:
                words.append(f"init_from='{source}'")
                self._index.update(entry, init_from=self._index.relative(source))
            command = ["wheelleg", "train", *words, *(w for d in self._folders for w in ("--config-dir", str(d)))]
            digest = digest_of(compose_valid(words, config_dirs=self._folders))
            self._perform(self._request("train", words, command, digest=digest), entry)
        else:
            with suppress(RunDirectoryError):
                manifest = RunDirectory(run).manifest()
                done = int(str(manifest.results.get("iterations", 0))) if manifest.status == "finished" else 0
        if run is not None and done < target:
            override = f"agent.max_iterations={target}"
            command = ["wheelleg", "resume", str(run), override]
            self._perform(self._request("resume", [override], command, run=str(run)), entry)
        self._index.update(entry, trained=target)

    def _request(
        self, kind: Literal["train", "resume", "evaluate"], overrides: list[str], command: list[str], **facts: str
    ) -> JobRequest:
        folders = [str(folder) for folder in self._folders]
        return JobRequest(kind, overrides, folders, command, root=str(self._index.root), **facts)

    def _judge(self, entry: PhaseEntry, gate: Gate, iteration: int, *, last: bool) -> None:
        run = self._index.run_of(entry)
        assert run is not None
        name = f"model_{iteration - 1}.pt"
        words = [f"protocol={gate.protocol}", *gate.overrides]
        command = ["wheelleg", "evaluate", str(run), *words]
        self._display.note(f"{entry['name']}: evaluating {name} in the scenarios of '{gate.protocol}'")
        events = self._perform(self._request("evaluate", words, command, run=str(run), checkpoint=name), entry)
        found = events.get("evaluated")
        if found is None:
            raise SimulationFailure("the evaluation's child process sent no result", key=str(run))
        verdict = judge(gate, found["metrics"])
        facts = {"iteration": iteration, "passed": verdict.passed, "values": verdict.values, "why": verdict.why}
        made = {"protocol": gate.protocol, "scenarios_sha256": found["scenarios_sha256"], "evaluation": found["folder"]}
        self._index.update(entry, gates=[*entry["gates"], {**facts, **made}])
        # If the policy fails a phase's last evaluation, the pipeline stops and reports the reason.
        why = "" if verdict.passed or last else f": {'; '.join(verdict.why)}"
        outcome = ("passed" if verdict.passed else "not passed") + why
        self._display.note(f"{entry['name']}: gate after {iteration} iterations {outcome}")

    def _perform(self, request: JobRequest, entry: PhaseEntry) -> dict[str, Event]:
        """Train, resume, or evaluate a run in a child process; return the child's last message of each type."""
        last: dict[str, Event] = {}
        if self._stop.requested:
            raise Interrupted
        try:
            with run_request(request, self._stop) as events:
                for event in events:
                    last[event["event"]] = event
                    self._hear(event, entry)
        except WheellegError as error:
            error.message = f"phase '{entry['name']}': {error.message}"
            raise
        return last

    def _hear(self, event: Event, entry: PhaseEntry) -> None:
        kind = event["event"]
        if kind == "run":
            self._index.update(entry, run=self._index.relative(Path(event["path"])))
            self._display.note(f"{entry['name']}: run directory {event['path']}")
        elif kind == "note":
            self._display.note(f"{entry['name']}: {event['text']}")
        elif kind == "iteration":
            self._display.iteration(Iteration(event["done"] - 1, event["scalars"], 0), event["total"])


def resume_pipeline(
    index: PipelineIndex, overrides: Sequence[str], command: Sequence[str], config_dirs: Sequence[Path] = ()
) -> PipelineSettings:
    """Check that a pipeline can be resumed, and return the settings of the pipeline; an error writes nothing.

    ``overrides`` change its phases, such as ``pipeline.phases.walk.max_iterations=600``. If ``config_dirs`` is empty,
    the recorded config folders are used.
    """
    if index.data["status"] == "running" and is_alive(index.data.get("process")):
        message = "this pipeline is still running"
        raise RunDirectoryError(message, key=str(index.path), expected="one that has ended: wait for it")
    if index.data["status"] == "finished":
        raise RunDirectoryError("this pipeline is finished", key=str(index.path), expected="one that was stopped")
    for text in overrides:
        if not names_pipeline(text):
            message = "a pipeline keeps the settings with which it started"
            key, expected = text.lstrip("+~").partition("=")[0], f"settings of {PIPELINE}.phases.<phase>"
            raise ConfigError(message, key=key, where=f"override {text}", expected=expected)
    recorded = index.data["config"]
    tree = apply_overrides({PIPELINE: recorded}, overrides)[PIPELINE]
    found = list(changes(recorded, tree, same, (PIPELINE,)))
    with placing(overrides):
        for change in found:
            _require_changeable(change, index)
        declared = read_pipeline(tree)
    folders = _folders(index, config_dirs)
    for name, asked in declared.phases.items():
        words = phase_overrides(name, asked, index.data["overrides"])
        require_overrides(words, index.path)
        if asked.gate is not None:
            require_overrides([f"protocol={asked.gate.protocol}", *asked.gate.overrides], index.path)
        # The trainings of a foreign pipeline must not write outside of its folder of runs.
        index.require_inside(Path(compose(words, config_dirs=folders).config["run"]["root"]).resolve())
    if list(declared.phases) != [phase["name"] for phase in index.phases]:
        message = "a resume cannot add, remove, or reorder pipeline phases"
        raise ConfigError(message, key=f"{PIPELINE}.phases", expected=str(list(recorded["phases"])))
    regated = {str(change.keys[2]) for change in found if change.keys[3:4] == ("gate",)}
    if changed := {name: declared.phases[name] for name in declared.phases if name in regated}:
        words_of = {name: phase_overrides(name, phase, index.data["overrides"]) for name, phase in changed.items()}
        with placing(overrides):
            composed = {name: compose_valid(words, config_dirs=folders) for name, words in words_of.items()}
            require_metrics(changed, composed, folders)
    for phase in index.data["phases"]:
        if phase["status"] == "failed":
            name = phase["name"]
            if not any(change.keys[2] == name for change in found):
                message = f"phase '{name}' did not pass its gate, and nothing changed: {phase['why']}"
                expected = f"more than {declared.phases[name].max_iterations}, or another gate"
                raise ConfigError(message, key=f"{PIPELINE}.phases.{name}.max_iterations", expected=expected)
            gates = [gate for gate in phase["gates"] if gate["iteration"] <= phase["trained"] and name not in regated]
            phase.update(status="training", why=None, ended=None, gates=gates)
    index.data["config_dirs"] = [str(folder) for folder in folders]
    index.restart(command, [{"key": c.key, "was": str(c.a), "now": str(c.b)} for c in found], declared.tree)
    return declared


def _folders(index: PipelineIndex, config_dirs: Sequence[Path]) -> list[Path]:
    """Return the config folders of a resumed pipeline; raise ConfigError if a recorded folder cannot be used."""
    recorded = index.data["config_dirs"]
    folders = join_recorded(config_dirs, recorded)
    for folder, why in left_out(recorded, folders).items() if not config_dirs else ():
        expected = "--config-dir with the place where that folder is now, if it is yours"
        message = f"the pipeline needs the config folder {folder}, which {why}"
        raise ConfigError(message, key=str(index.path), expected=expected)
    return folders


def _require_changeable(change: Change, index: PipelineIndex) -> None:
    name = change.keys[2] if len(change.keys) > 2 and change.keys[1] == "phases" else None
    phase = next((phase for phase in index.phases if phase["name"] == name), None)
    if phase is None:
        message = "a resume can change only settings in pipeline.phases"
        raise ConfigError(message, key=change.key, expected="settings of its phases")
    if phase["status"] == "passed":
        message = f"phase '{name}' has already passed its evaluation"
        raise ConfigError(message, key=change.key, expected="settings of a later phase")
    if phase["run"] is not None and change.keys[3] not in _CHANGEABLE_LATER:
        expected = f"{' or '.join(_CHANGEABLE_LATER)} of it, or a new pipeline"
        raise ConfigError(f"phase '{name}' has started", key=change.key, expected=expected)
    done = index.done(phase)
    if change.keys[3] == "max_iterations" and isinstance(change.b, int) and change.b < done:
        message = f"the number is {change.b}, and phase '{name}' has done {done} iterations"
        raise ConfigError(message, key=change.key, expected=f"at least {done}")
