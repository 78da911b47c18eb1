"""Resume a training pipeline that was stopped or killed, or whose policy failed the evaluation of a phase."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from wheelleg_exp.config.checking.find_mistakes import compose_valid
from wheelleg_exp.config.composing.compose import apply_overrides, compose, placing
from wheelleg_exp.config.explaining.config_diff import Change, changes, same
from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.jobs.pipeline.pipeline_settings import PipelineSettings, phase_overrides, read_pipeline
from wheelleg_exp.packages import join_recorded, left_out
from wheelleg_exp.run.run_config import require_overrides
from wheelleg_exp.run.run_index import PipelineIndex
from wheelleg_exp.run.run_lock import is_alive
from wheelleg_exp.terms.key_syntax import PIPELINE, names_pipeline

# Of a phase that has already started, a resume can change only ``max_iterations`` and ``gate``.
_CHANGEABLE_LATER = ("max_iterations", "gate")


def resume_pipeline(
    index: PipelineIndex, overrides: Sequence[str], command: Sequence[str], config_dirs: Sequence[Path] = ()
) -> PipelineSettings:
    """Check that a pipeline can be resumed, and return the settings of the pipeline; an error writes nothing.

    ``overrides`` change its phases. If ``config_dirs`` is empty, the recorded config folders are used.
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
        from wheelleg_exp.jobs.pipeline.run_pipeline import require_metrics

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
