"""A declared pipeline: its phases as a config has them, composed, and held against each other before any begins."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from wheelleg_exp.config.checking.collect import compose_valid
from wheelleg_exp.config.composing.compose import Composed, compose
from wheelleg_exp.config.composing.primaries import PIPELINE as PRIMARY
from wheelleg_exp.config.composing.sweep import digest_of
from wheelleg_exp.config.problems import override_of, parts, raise_all
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.pipeline.options import Gate, Phase, Pipeline
from wheelleg_exp.jobs.train.initial import PARTS
from wheelleg_exp.jobs.train.policy_fit import fit
from wheelleg_exp.terms.sections import read_section

_GATED = ("init_from", "agent.max_iterations", "task")  # what a pipeline sets itself


@dataclass(frozen=True)
class Declared:
    """A pipeline as it is declared.

    Attributes:
        tree: its plain config.
        phases: its phases by name.
        composed: what it was composed from, which knows the file and the line of a key; None of a record.
    """

    tree: dict[str, Any]
    phases: dict[str, Phase]
    composed: Composed | None = None


def declared(overrides: Sequence[str], config_dirs: Sequence[Path] = ()) -> Declared:
    """Compose a pipeline.

    Raises:
        ConfigError: there is none of that name, or a setting of it is wrong.
    """
    composed = compose(overrides, primary=PRIMARY, config_dirs=config_dirs)
    with composed.placing():
        return replace(read(composed.config[PRIMARY]), composed=composed)


def read(tree: Mapping[str, Any]) -> Declared:
    """Return a pipeline's plain config, read.

    Raises:
        ConfigError: a setting of it is wrong.
    """
    named = read_section(Pipeline, tree, PRIMARY).phases
    phases = {str(name): phase for name, phase in named.items() if phase is not None}
    if not phases:
        raise ConfigError("has no phase", key=f"{PRIMARY}.phases", expected="at least one")
    for name, phase in phases.items():
        if phase.gate is not None and not (phase.gate.at_least or phase.gate.at_most):
            key = f"{PRIMARY}.phases.{name}.gate"
            raise ConfigError("asks for nothing", key=key, expected="at_least or at_most, or no gate")
    nodes = {str(name): node for name, node in tree["phases"].items() if node is not None}
    return Declared({**tree, "phases": nodes}, phases)


def words_of(name: str, phase: Phase, overrides: Sequence[str]) -> list[str]:
    """Return the overrides that a phase is trained with, but for what it begins with and how long it trains.

    Args:
        name: the phase's name, which its run gets.
        phase: the phase.
        overrides: those of the command line, for all phases.
    """
    return [f"task={phase.task}", f"run.name={name}", *phase.overrides, *overrides]


def compose_phases(
    phases: Mapping[str, Phase], overrides: Sequence[str], config_dirs: Sequence[Path] = ()
) -> dict[str, Composed]:
    """Compose and check every phase, and hold each against the one whose policy it begins with.

    Raises:
        ConfigError: the mistakes of all phases, each with its phase; one that all of them have is told once.
    """
    for text in overrides:
        key = text.lstrip("+~").partition("=")[0]
        if key in _GATED:
            raise ConfigError(
                "a pipeline's phases say this themselves",
                key=key,
                where=f"override {text}",
                expected=f"settings of {PRIMARY}.phases.<phase>",
            )
    found: dict[str, Composed] = {}
    wrong: dict[str, list[ConfigError]] = {}
    for name, phase in phases.items():
        try:
            found[name] = compose_valid(words_of(name, phase, overrides), config_dirs=config_dirs)
            if phase.gate is not None:
                _require_protocol(phase.gate, config_dirs)
        except ConfigError as error:
            wrong[name] = [_declared(part, name, phase) for part in parts(error)]
    mistakes = list(_told(wrong, len(phases)) if wrong else _misfits(found))
    if mistakes:
        raise_all(mistakes)
    return found


def _require_protocol(gate: Gate, config_dirs: Sequence[Path]) -> None:
    compose([f"protocol={gate.protocol}", *gate.overrides], primary="evaluate", config_dirs=config_dirs)


def _declared(error: ConfigError, name: str, phase: Phase) -> ConfigError:
    """Return a mistake of what a phase names by the key that names it."""
    named = {f"task={phase.task}": "task"}
    if phase.gate is not None:
        named[f"protocol={phase.gate.protocol}"] = "gate.protocol"
    key = named.get(override_of(error) or "")
    if key is not None:
        error.key, error.where = f"{PRIMARY}.phases.{name}.{key}", None
    return error


def _told(wrong: Mapping[str, Sequence[ConfigError]], phases: int) -> Iterator[ConfigError]:
    """Yield each mistake with its phase; what all phases have, as of an override for all, is told once."""
    times = Counter(text for errors in wrong.values() for text in {str(error) for error in errors})
    shared: set[str] = set()
    for name, errors in wrong.items():
        for error in errors:
            text = str(error)
            if phases == 1 or times[text] < phases:
                yield in_phase(error, name)
            elif text not in shared:
                shared.add(text)
                yield error


def digest(composed: Composed) -> str:
    """Return the digest of a phase's config; what it begins with and how long it trains stand in none of it."""
    return digest_of(composed)


def _misfits(phases: Mapping[str, Composed]) -> Iterator[ConfigError]:
    names = list(phases)
    for before, name in pairwise(names):
        was, now = phases[before].config, phases[name].config
        roles = [part for part in PARTS[now.get("init_from_what") or "networks"] if part != "optimizer"]
        found = fit((was["env"], was["agent"]), (now["env"], now["agent"]), roles, f"phase '{before}'")
        for error in [*found.mistakes, *found.suspects]:
            yield in_phase(error, name)


def in_phase(error: ConfigError, name: str) -> ConfigError:
    """Return a mistake that says in whose phase it is."""
    message = f"phase '{name}': {error.message}"
    return ConfigError(message, key=error.key, where=error.where, expected=error.expected, nearest=error.nearest)
