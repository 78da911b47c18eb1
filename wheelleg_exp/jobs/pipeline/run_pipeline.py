"""Pipelines: compose and check the configs of all phases, train each phase in a child process, and resume a pipeline.

Each phase is an ordinary run, and the pipeline's record names the run directories.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from fnmatch import filter as filter_names
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any, Literal

from wheelleg_exp.build import prepare_asset
from wheelleg_exp.child_process import Event
from wheelleg_exp.config.checking.find_mistakes import compose_valid
from wheelleg_exp.config.composing.compose import Composed, apply_overrides, compose, placing
from wheelleg_exp.config.composing.compose_sweep import digest_of
from wheelleg_exp.config.composing.sized_values import robot_sizes
from wheelleg_exp.config.config_errors import override_of, parts, raise_all
from wheelleg_exp.config.explaining.config_diff import Change, changes, same
from wheelleg_exp.config.tree_lookup import section_at
from wheelleg_exp.constraints import Seed
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
from wheelleg_exp.jobs.pipeline.pipeline_phases import Gate, Phase, Pipeline, judge
from wheelleg_exp.jobs.train.initial_networks import PARTS, fit, initial_file
from wheelleg_exp.jobs.training_job import JobRequest, run_request
from wheelleg_exp.packages import join_recorded, left_out
from wheelleg_exp.rl.trainer import Iteration
from wheelleg_exp.run.run_config import require_overrides
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_index import PhaseEntry, PipelineIndex, PipelineStatus
from wheelleg_exp.run.timestamps import utc_now, utc_text
from wheelleg_exp.stop_request import StopRequest
from wheelleg_exp.terms.config_sections import read_section, section_errors
from wheelleg_exp.terms.config_values import require_fit
from wheelleg_exp.terms.key_syntax import PIPELINE, names_pipeline, split_path
from wheelleg_exp.terms.key_syntax import PIPELINE as PRIMARY

_RESERVED_KEYS = ("init_from", "agent.max_iterations", "task", "run.name")  # The pipeline sets ``_RESERVED_KEYS``.
_NAME = re.compile(r"[\w-]+")  # A pipeline phase's name is a part of config keys and folder names.


@dataclass(frozen=True)
class PipelineSettings:
    """The config of a training pipeline and its phases; ``composed`` is None if the config was read from a file."""

    tree: dict[str, Any]
    phases: dict[str, Phase]
    results: str | None = None
    composed: Composed | None = None


def compose_pipeline(overrides: Sequence[str], config_dirs: Sequence[Path] = ()) -> PipelineSettings:
    """Compose a pipeline's config from overrides, and check the settings of the pipeline."""
    composed = compose(overrides, primary=PRIMARY, config_dirs=config_dirs)
    with composed.placing():
        return replace(read_pipeline(composed.config[PRIMARY]), composed=composed)


def read_pipeline(tree: Mapping[str, object]) -> PipelineSettings:
    """Read a pipeline from its recorded config, and check the settings of the pipeline."""
    if errors := section_errors(PRIMARY, tree, Pipeline):
        raise_all(errors)
    pipeline = read_section(Pipeline, tree, PRIMARY)
    phases = {str(name): phase for name, phase in pipeline.phases.items() if phase is not None}
    if not phases:
        raise ConfigError("has no phase", key=f"{PRIMARY}.phases", expected="at least one")
    first = next(iter(phases))
    mistakes = [error for name, phase in phases.items() for error in _own_mistakes(name, phase, is_first=name == first)]
    if mistakes:
        raise_all(mistakes)
    nodes = {str(name): node for name, node in section_at(tree, "phases").items() if node is not None}
    return PipelineSettings({**tree, "phases": nodes}, phases, pipeline.results)


def phase_overrides(name: str, phase: Phase, overrides: Sequence[str]) -> list[str]:
    """Return a phase's overrides and those of the command line, without ``init_from`` and ``agent.max_iterations``."""
    return [f"task={phase.task}", *phase.overrides, *overrides, f"run.name={name}"]


def compose_phases(
    phases: Mapping[str, Phase], overrides: Sequence[str], config_dirs: Sequence[Path] = ()
) -> dict[str, Composed]:
    """Check the config of every phase, and check that each phase can start with the policy of the phase before it.

    ConfigError lists the mistakes of all phases; a mistake that a command line override causes in every phase, once.
    """
    for text in overrides:
        if _key(text) in _RESERVED_KEYS:
            message = "the phases of a pipeline set this themselves"
            expected = f"settings of {PRIMARY}.phases.<phase>"
            raise ConfigError(message, key=_key(text), where=f"override {text}", expected=expected)
    found: dict[str, Composed] = {}
    wrong: dict[str, list[ConfigError]] = {}
    for name, phase in phases.items():
        errors = []
        try:
            found[name] = compose_valid(phase_overrides(name, phase, overrides), config_dirs=config_dirs)
            with found[name].placing(), initial_file(found[name].config, lambda _: None):
                pass  # ``initial_file`` checks the checkpoint from which the phase's networks start.
        except ConfigError as error:
            errors += [_place_phase_error(part, name, phase, overrides) for part in parts(error)]
        if phase.gate is not None:
            try:
                compose_gate(phase.gate, config_dirs)
            except ConfigError as error:
                errors += [place_gate_error(part, name, phase.gate) for part in parts(error)]
        if errors:
            wrong[name] = errors
    mistakes = list(_mistakes_by_phase(wrong, len(phases), overrides) if wrong else _misfits(found))
    if mistakes:
        raise_all(mistakes)
    return found


def _key(text: str) -> str:
    return text.lstrip("+~").partition("=")[0]


def _own_mistakes(name: str, phase: Phase, *, is_first: bool) -> Iterator[ConfigError]:
    """Yield the mistakes in one phase's settings, such as an override of a config key that the pipeline itself sets."""
    key, gate = f"{PRIMARY}.phases.{name}", phase.gate
    if not _NAME.fullmatch(name):
        yield ConfigError(f"'{name}' is not a phase name", key=f"{PRIMARY}.phases", expected="letters, digits, - and _")
    if gate is not None and not (gate.at_least or gate.at_most):
        yield ConfigError("has no bounds", key=f"{key}.gate", expected="at_least or at_most, or no gate")
    for text in phase.overrides:
        if _key(text) in _RESERVED_KEYS and not (is_first and _key(text) == "init_from"):
            yield ConfigError(f"'{text}': the phase sets this itself", key=f"{key}.overrides")
    for text in gate.overrides if gate is not None else ():
        if _key(text) == "protocol":
            yield ConfigError(f"'{text}': the gate sets this itself", key=f"{key}.gate.overrides")


def compose_gate(gate: Gate, config_dirs: Sequence[Path] = (), env: Mapping[str, object] | None = None) -> Composed:
    """Compose the evaluation of a gate, which a pipeline phase must pass, for the robot of a config section ``env``."""
    words = [*robot_sizes(env or {}), f"protocol={gate.protocol}", *gate.overrides]
    composed = compose(words, primary="evaluate", config_dirs=config_dirs)
    with composed.placing():
        require_fit("seed", composed.config["seed"], Seed)
    return composed


def _place_phase_error(error: ConfigError, name: str, phase: Phase, overrides: Sequence[str]) -> ConfigError:
    """Return an error about a training config with the responsible key, such as ``pipeline.phases.walk.task``."""
    blamed, key = override_of(error), f"{PRIMARY}.phases.{name}"
    if blamed == f"task={phase.task}":
        return _at_key(error, f"{key}.task")
    if blamed == f"run.name={name}":
        return _at_key(error, key)
    if blamed in phase.overrides and blamed not in overrides:
        return _at_key(error, f"{key}.overrides", f", in '{blamed}'")
    return error


def place_gate_error(error: ConfigError, name: str, gate: Gate) -> ConfigError:
    """Return an error about an evaluation config with the responsible key, such as ``pipeline.phases.walk.gate``."""
    key, blamed = f"{PRIMARY}.phases.{name}.gate", override_of(error)
    if blamed == f"protocol={gate.protocol}":
        return _at_key(error, f"{key}.protocol")
    if blamed in gate.overrides:
        return _at_key(error, f"{key}.overrides", f", in '{blamed}'")
    # If no single override causes the error, report ``gate.overrides`` (or ``gate.protocol``) as the wrong key.
    if split_path(error.key or "")[:1] in (("protocol",), ("seed",)):
        return _at_key(error, f"{key}.overrides" if gate.overrides else f"{key}.protocol", "")
    return error


def _at_key(error: ConfigError, key: str, blamed: str | None = None) -> ConfigError:
    """Replace an error's key; unless ``blamed`` is None, name the old key in the message."""
    message = error.message if blamed is None else f"{error.key}: {error.message}{blamed}"
    return ConfigError(message, key=key, expected=error.expected, nearest=error.nearest)


def _mistakes_by_phase(
    wrong: Mapping[str, Sequence[ConfigError]], phases: int, overrides: Sequence[str]
) -> Iterator[ConfigError]:
    of_all = [
        {(error.key, blamed) for error in errors if (blamed := override_of(error)) in overrides}
        for errors in wrong.values()
    ]
    shared = set.intersection(*of_all) if len(wrong) == phases else set()
    reported = set()
    for name, errors in wrong.items():
        for error in errors:
            mistake = (error.key, override_of(error))
            if mistake not in shared:
                yield name_phase(error, name)
            elif mistake not in reported:
                reported.add(mistake)
                yield error


def _misfits(phases: Mapping[str, Composed]) -> Iterator[ConfigError]:
    for before, name in pairwise(list(phases)):
        was, now = phases[before].config, phases[name].config
        roles = [part for part in PARTS[now.get("init_from_what") or "networks"] if part != "optimizer"]
        found = fit((was["env"], was["agent"]), (now["env"], now["agent"]), roles, f"phase '{before}'")
        for error in [*found.mistakes, *found.suspects]:
            expected = f"the settings of phase '{before}', with whose policy it starts"
            message = f"{error.key}: {error.message}"
            yield name_phase(ConfigError(message, key=f"{PRIMARY}.phases.{name}", expected=expected), name)


def name_phase(error: ConfigError, name: str) -> ConfigError:
    """Return ``error`` with the name of the phase at the start of its message."""
    message = f"phase '{name}': {error.message}"
    return ConfigError(message, key=error.key, where=error.where, expected=error.expected, nearest=error.nearest)


# Of a phase that has already started, a resume can change only ``max_iterations`` and ``gate``.
_CHANGEABLE_LATER = ("max_iterations", "gate")


def require_metrics(phases: Mapping[str, Phase], composed: Mapping[str, Composed], folders: Sequence[Path]) -> None:
    """Raise ConfigError if a phase's evaluation does not compute a metric for which the phase has a bound."""
    mistakes: list[ConfigError] = []
    for name, phase in phases.items():
        gate = phase.gate
        if gate is None:
            continue
        try:
            names = _metric_names(gate, composed[name], folders)
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


def require_figures(pipeline: PipelineSettings, last: Composed, folders: Sequence[Path]) -> None:
    """Raise ConfigError if the evaluation at the end of a pipeline has no metric for a pattern of ``figures``."""
    if pipeline.results is None:
        return
    names = _metric_names(Gate(pipeline.results), last, folders)
    for pattern in pipeline.tree.get("figures", []):
        if not filter_names(names, pattern):
            message = f"no metric of protocol '{pipeline.results}' matches '{pattern}'"
            expected = f"metrics such as {', '.join(names[:3])}, or patterns such as '*/survival'"
            raise ConfigError(
                message, key=f"{PIPELINE}.figures", expected=expected, nearest=nearest_name(pattern, names)
            )


def _metric_names(gate: Gate, composed: Composed, folders: Sequence[Path]) -> list[str]:
    """Return the names of the metrics of an evaluation of the policy that a phase trains."""
    config = composed.config
    whole = compose_gate(gate, folders, config["env"])
    with whole.placing():
        read_section(Protocol, whole.config["protocol"], "protocol")
    env = {**config["env"], "sim": {**config["env"]["sim"], "engine": "mujoco", "device": "cpu"}}
    return metric_names(env, prepare_asset(config, composed.asset_roots).output, whole.config["protocol"])


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
            total = self._settings.phases[entry["name"]].max_iterations  # a gate pauses the training earlier
            self._display.iteration(Iteration(event["done"] - 1, event["scalars"], 0), total)


def resume_pipeline(
    index: PipelineIndex, overrides: Sequence[str], command: Sequence[str], config_dirs: Sequence[Path] = ()
) -> PipelineSettings:
    """Check that a pipeline can be resumed, and return the settings of the pipeline; an error writes nothing.

    ``overrides`` change its phases, such as ``pipeline.phases.walk.max_iterations=600``. If ``config_dirs`` is empty,
    the recorded config folders are used.
    """
    index.require_ended()
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
