"""Compose the configs of a training pipeline and of its phases, and check all configs before the first phase starts."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from wheelleg_exp.config.checking.find_mistakes import compose_valid
from wheelleg_exp.config.composing.compose import Composed, compose
from wheelleg_exp.config.config_errors import override_of, parts, raise_all
from wheelleg_exp.config.tree_lookup import section_at
from wheelleg_exp.constraints import Seed
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.pipeline.pipeline_phases import Gate, Phase, Pipeline
from wheelleg_exp.jobs.train.initial_networks import PARTS, fit, initial_file
from wheelleg_exp.terms.config_sections import read_section, section_errors
from wheelleg_exp.terms.config_values import require_fit
from wheelleg_exp.terms.key_syntax import PIPELINE as PRIMARY
from wheelleg_exp.terms.key_syntax import split_path

_RESERVED_KEYS = ("init_from", "agent.max_iterations", "task", "run.name")  # The pipeline sets ``_RESERVED_KEYS``.
_NAME = re.compile(r"[\w-]+")  # A pipeline phase's name is a part of config keys and folder names.


@dataclass(frozen=True)
class PipelineSettings:
    """The config of a training pipeline and its phases; ``composed`` is None if the config was read from a file."""

    tree: dict[str, Any]
    phases: dict[str, Phase]
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
    named = read_section(Pipeline, tree, PRIMARY).phases
    phases = {str(name): phase for name, phase in named.items() if phase is not None}
    if not phases:
        raise ConfigError("has no phase", key=f"{PRIMARY}.phases", expected="at least one")
    first = next(iter(phases))
    mistakes = [error for name, phase in phases.items() for error in _own_mistakes(name, phase, is_first=name == first)]
    if mistakes:
        raise_all(mistakes)
    nodes = {str(name): node for name, node in section_at(tree, "phases").items() if node is not None}
    return PipelineSettings({**tree, "phases": nodes}, phases)


def phase_overrides(name: str, phase: Phase, overrides: Sequence[str]) -> list[str]:
    """Return a phase's overrides and those of the command line, without ``init_from`` and ``agent.max_iterations``."""
    return [f"task={phase.task}", *phase.overrides, *overrides, f"run.name={name}"]


def compose_phases(
    phases: Mapping[str, Phase], overrides: Sequence[str], config_dirs: Sequence[Path] = ()
) -> dict[str, Composed]:
    """Check each phase's config, and that it can start with the previous policy; ConfigError lists all mistakes."""
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


def compose_gate(gate: Gate, config_dirs: Sequence[Path] = ()) -> Composed:
    """Compose the evaluation config of a gate, which is an evaluation that a pipeline phase must pass."""
    composed = compose([f"protocol={gate.protocol}", *gate.overrides], primary="evaluate", config_dirs=config_dirs)
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
