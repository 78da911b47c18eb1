"""Check and read sections of the config; a dataclass defines the keys of each section."""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

from wheelleg_exp.constraints import Natural, Node, NonNegative, NonNegativeInterval, Share, Terms, broken_rules
from wheelleg_exp.errors import ConfigError, MissingValue, UnreadKey, nearest_name
from wheelleg_exp.terms.config_values import describe, options_in, value_errors
from wheelleg_exp.terms.key_syntax import below

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@dataclass(frozen=True)
class Dataset:
    """``env.dataset``: which of the recorders' episodes are written to files.

    Attributes:
        export_mode: ``all``: every episode. ``succeeded_failed``: every episode, in one folder for successes and one
            for failures; an episode succeeds if the termination named `success` fires. ``succeeded_only``: only
            successes. ``none``: no episode.
        export_in_close: whether episodes that are still running at the end are written, too.
    """

    export_mode: Literal["all", "succeeded_failed", "succeeded_only", "none"] = "all"
    export_in_close: bool = False


@dataclass(frozen=True)
class SensorRealism:
    """``env.realism.sensors.<function>``: the errors of all observation terms with this function.

    Attributes:
        noise: the noise of the terms, which replaces their own noise.
        delay_s: shortest and longest delay of the readings, s; each reset draws one delay for each environment.
        jitter_s: largest random addition to the delay, s; drawn in each physics step.
    """

    noise: Node | None = None
    delay_s: NonNegativeInterval = (0.0, 0.0)
    jitter_s: NonNegative = 0.0


@dataclass(frozen=True)
class ActionRealism:
    """``env.realism.actions``: the delay of all actions.

    Attributes:
        delay_s: shortest and longest delay of the commands, s; each reset draws one delay for each environment.
        jitter_s: largest random addition to the delay, s; drawn in each physics step.
        prompt_share: share of the robots, the first ones, whose actions are never late.
    """

    delay_s: NonNegativeInterval = (0.0, 0.0)
    jitter_s: NonNegative = 0.0
    prompt_share: Share = 0.0


@dataclass(frozen=True)
class Realism:
    """``env.realism``: what a real robot adds to the ideal simulation of a task.

    Attributes:
        name: name of the variant in results.
        events: the variant's terms in ``env.events``; they run after all other events.
        replaces: terms of the task in ``env.events`` that the variant removes.
        curriculum: the variant's terms in ``env.curriculum``.
        groups: the observation groups whose terms get the sensors' errors.
        sensors: the errors of observation terms, by the name of their function, such as ``joint_vel_rel``.
        actions: the delay of all actions.
        exact_share: share of the robots, the first ones, without errors of sensors, drives, body, friction, and floor
            slope. Kicks reach them too. Late actions have their own share.
    """

    name: str = "none"
    events: list[str] = field(default_factory=list)
    replaces: list[str] = field(default_factory=list)
    curriculum: list[str] = field(default_factory=list)
    groups: list[str] = field(default_factory=list)
    sensors: dict[str, SensorRealism] = field(default_factory=dict)
    actions: ActionRealism = ActionRealism()
    exact_share: Share = 0.0


@dataclass(frozen=True)
class ObservationGroup:
    """``env.observations.<group>``."""

    terms: Terms
    concatenate_terms: bool = True
    enable_corruption: bool = False
    history_length: Natural | None = None
    flatten_history_dim: bool = True
    concatenate_dim: int = -1
    history_order: Literal["term", "time"] = "term"


_Options = TypeVar("_Options", bound="DataclassInstance")


class Key(NamedTuple):
    """The type annotation of a key of a config section, and whether the section must have the key."""

    annotation: Any
    required: bool


@functools.cache
def keys_of(options: type) -> Mapping[str, Key]:
    """Return the keys that a config section accepts, which are the fields of the section's dataclass."""
    hints = typing.get_type_hints(options, include_extras=True)
    missing = dataclasses.MISSING
    return {
        f.name: Key(hints[f.name], f.default is missing and f.default_factory is missing)
        for f in dataclasses.fields(options)
        if f.init
    }


def section_errors(path: str, node: Mapping[str, object], options: type) -> list[ConfigError]:
    """Return the errors in a config section ``node``; the dataclass ``options`` defines its valid keys and values."""
    keys = keys_of(options)
    errors = []
    for given_name, value in node.items():
        if given_name in keys:
            errors += _value_errors(below(path, given_name), value, keys[given_name].annotation)
        else:
            expected, nearest = "one of " + ", ".join(keys), nearest_name(str(given_name), keys)
            errors.append(UnreadKey(key=below(path, str(given_name)), expected=expected, nearest=nearest))
    for name, key in keys.items():
        if key.required and name not in node:
            errors.append(MissingValue(key=below(path, name), expected=describe(key.annotation)))
    if errors:
        return errors
    given = {f.name: f.default for f in dataclasses.fields(options)} | dict(node)
    return [
        ConfigError(broken.message, key=".".join(filter(None, (path, broken.key))), expected=broken.expected)
        for broken in broken_rules(options, given)
    ]


def _value_errors(key: str, value: object, annotation: object) -> list[ConfigError]:
    if isinstance(value, Mapping) and (nested := dataclass_of(annotation, value)) is not None:
        return section_errors(key, value, nested)
    named = _dataclass_of_values(annotation)
    if named is not None and isinstance(value, Mapping):
        return [e for name, node in value.items() for e in _value_errors(below(key, str(name)), node, named)]
    return value_errors(key, value, annotation)


def dataclass_of(annotation: object, node: Mapping[str, object]) -> type[DataclassInstance] | None:
    """Return the dataclass of the config section ``node``, which a type annotation names; None without a dataclass."""
    kinds = (option for option in options_in(annotation) if isinstance(option, type))
    found = next((kind for kind in kinds if dataclasses.is_dataclass(kind)), None)
    # The algorithm in `agent` decides which keys `agent` has.
    choose: Callable[[Mapping[str, object]], type[DataclassInstance]] | None = getattr(found, "of_section", None)
    return found if choose is None else choose(node)


def _dataclass_of_values(annotation: object) -> object:
    values = typing.get_args(annotation)[1:] if typing.get_origin(annotation) is dict else ()
    return next((value for value in values if dataclass_of(value, {}) is not None), None)


def read_section(options: type[_Options], node: object, path: str) -> _Options:
    """Return a config section as an instance of its dataclass; raise ConfigError at the first mistake."""
    if not isinstance(node, Mapping):
        raise MissingValue(key=path, expected="a mapping")
    for error in section_errors(path, node, options):
        raise error
    return _instance(options, node)


def _instance(options: type[_Options], node: Mapping[str, object]) -> _Options:
    keys = keys_of(options)
    return options(**{name: _read_value(value, keys[name].annotation) for name, value in node.items()})


def _read_value(value: object, annotation: object) -> object:
    if not isinstance(value, Mapping):
        return value
    if (nested := dataclass_of(annotation, value)) is not None:
        return _instance(nested, value)
    if (named := _dataclass_of_values(annotation)) is not None:
        return {name: _read_value(node, named) for name, node in value.items()}
    return value


def plain_section(options: object) -> Any:
    """Return an instance of a section's dataclass as the plain config section, with the keys that have defaults."""
    if dataclasses.is_dataclass(options):
        return {f.name: plain_section(getattr(options, f.name)) for f in dataclasses.fields(options)}
    if isinstance(options, tuple):  # the default of a list
        return list(options)
    return {k: plain_section(v) for k, v in options.items()} if isinstance(options, Mapping) else options
