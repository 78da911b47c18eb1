"""A declared pipeline: its phases as a config has them, composed, and held against each other before any begins."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from wheelleg_exp.config.checking.collect import compose_valid
from wheelleg_exp.config.composing.compose import Composed, compose
from wheelleg_exp.config.composing.primaries import PIPELINE as PRIMARY
from wheelleg_exp.config.composing.sweep import digest_of
from wheelleg_exp.config.problems import parts, raise_all
from wheelleg_exp.constraints import Count
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.train.initial import PARTS
from wheelleg_exp.jobs.train.policy_fit import fit
from wheelleg_exp.terms.sections import Section, read_section

_GATED = ("init_from", "agent.max_iterations", "task")  # what a pipeline sets itself


@dataclass(frozen=True)
class Gate:
    """``pipeline.phases.<phase>.gate``: what a policy must be able to do before the next phase.

    Attributes:
        protocol: the protocol of `wheelleg evaluate` whose scenarios are driven; training never sees them.
        at_least: the least value of each metric, by ``group/metric``.
        at_most: the greatest value of each metric.
        overrides: changes to the protocol, such as ``protocol.stand.episodes=16``.
        every: iterations between two evaluations while it trains; null evaluates behind the last one alone.
        passes: how many evaluations must pass in a row for it to go on before the last iteration.
    """

    protocol: str
    at_least: dict[str, float] = field(default_factory=dict)
    at_most: dict[str, float] = field(default_factory=dict)
    overrides: list[str] = field(default_factory=list)
    every: Count | None = None
    passes: Count = 1


@dataclass(frozen=True)
class Phase:
    """``pipeline.phases.<phase>``: one training.

    Attributes:
        task: the task.
        max_iterations: most iterations, in total.
        overrides: further overrides of ``wheelleg train``.
        gate: what it must pass; null lets the next phase begin in any case.
    """

    task: str
    max_iterations: Count
    overrides: list[str] = field(default_factory=list)
    gate: Gate | None = None


@dataclass(frozen=True)
class Pipeline:
    """``pipeline``: phases by name, in order.

    Attributes:
        name: the pipeline's name.
        phases: the phases, each begun with the policy of the one before.
    """

    name: str
    phases: Section


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
    nodes = {str(name): node for name, node in named.items() if node is not None}
    phases = {name: read_section(Phase, node, f"{PRIMARY}.phases.{name}") for name, node in nodes.items()}
    if not phases:
        raise ConfigError("has no phase", key=f"{PRIMARY}.phases", expected="at least one")
    for name, phase in phases.items():
        if phase.gate is not None and not (phase.gate.at_least or phase.gate.at_most):
            key = f"{PRIMARY}.phases.{name}.gate"
            raise ConfigError("asks for nothing", key=key, expected="at_least or at_most, or no gate")
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
        ConfigError: the mistakes of all phases, each with its phase.
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
    mistakes: list[ConfigError] = []
    for name, phase in phases.items():
        try:
            found[name] = compose_valid(words_of(name, phase, overrides), config_dirs=config_dirs)
            if phase.gate is not None:
                _require_protocol(name, phase.gate, config_dirs)
        except ConfigError as error:
            mistakes += [in_phase(part, name) for part in parts(error)]
    if not mistakes:
        mistakes = list(_misfits(found))
    if mistakes:
        raise_all(mistakes)
    return found


def _require_protocol(phase: str, gate: Gate, config_dirs: Sequence[Path]) -> None:
    try:
        compose([f"protocol={gate.protocol}", *gate.overrides], primary="evaluate", config_dirs=config_dirs)
    except ConfigError as error:
        for part in parts(error):
            if part.key == "protocol":  # that there is none of this name
                part.key = f"{PRIMARY}.phases.{phase}.gate.protocol"
        raise


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
