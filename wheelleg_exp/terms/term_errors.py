"""Report errors in a term: values that do not fit its annotations, and exceptions in its code."""

from __future__ import annotations

import copy
import inspect
import traceback
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from wheelleg_exp.constraints import broken_rules
from wheelleg_exp.errors import ConfigError, SimulationFailure, WheellegError, nearest_name
from wheelleg_exp.paths import show_file
from wheelleg_exp.terms import term_binding as binding
from wheelleg_exp.terms.config_values import value_errors
from wheelleg_exp.terms.key_syntax import below
from wheelleg_exp.user_exceptions import in_words, is_interrupt


def field_errors(section: str, term: binding.TermNode) -> Iterator[ConfigError]:
    """Yield errors in the fields of a term's config that the manager reads, such as ``weight`` or ``mode``."""
    for name in binding.REQUIRED_FIELDS.get(section, ()):
        if name not in term.fields:
            yield ConfigError(f"every term of {section} needs '{name}'", key=f"{term.path}.{name}")
    for name, value in term.fields.items():
        if not has_target(value):
            yield from value_errors(f"{term.path}.{name}", value, binding.FIELD_TYPES.get(name, object))
    mode = term.fields.get("mode")
    if not isinstance(mode, str):
        return
    nearest = nearest_name(mode, binding.EVENT_MODES)
    if nearest is not None and mode != nearest:
        expected = ", ".join(binding.EVENT_MODES) + ", or a user-defined name that is less similar to these"
        yield ConfigError(f"unknown mode '{mode}'", key=f"{term.path}.mode", expected=expected, nearest=nearest)
        return
    for name, owner in binding.MODE_FIELDS.items():
        if name in term.fields and owner != mode:
            message = f"only events of mode '{owner}' read this field, and this event has mode '{mode}'"
            yield ConfigError(message, key=f"{term.path}.{name}", expected=f"mode {owner}, or no {name}")
    if mode == "interval" and term.fields.get("interval_range_s") is None:
        key = f"{term.path}.interval_range_s"
        yield ConfigError("an interval event needs an interval", key=key, expected="[shortest, longest] in s")


def parameter_errors(section: str, term: binding.TermNode, target: Callable[..., object]) -> list[ConfigError]:
    """Return the mistakes in a term's parameters: their names, their values, and the rules between them."""
    errors = list(_name_errors(section, term, target))
    hints, accepted = type_hints(target), binding.signature_parameters(target)
    wrong: list[ConfigError] = []
    for name, value in term.params.items():
        is_default = value is None and name in accepted and accepted[name].default is None
        if name in hints and not has_target(value) and not is_default:
            wrong += value_errors(below(term.path, name), value, hints[name])
    given = {name: term.params.get(name, parameter.default) for name, parameter in accepted.items()}
    if not wrong and all(value is not inspect.Parameter.empty for value in given.values()):
        broken = broken_rules(target, given)
        wrong = [ConfigError(b.message, key=f"{term.path}.{b.key}", expected=b.expected) for b in broken]
    return errors + wrong


def nested_errors(path: str, node: Mapping[str, object], target: Callable[..., object]) -> list[ConfigError]:
    """Return the mistakes in a ``_target_`` node that is not a term: a sensor, an actuator, noise, an entity."""
    try:
        parameters = binding.target_arguments(node, path)
        term = binding.TermNode(path.rsplit(".", 1)[-1], path, str(node[binding.TARGET]), {}, parameters)
    except ConfigError as error:
        return [error]
    return parameter_errors("commands", term, target)  # The section "commands" reserves no parameter names.


def _name_errors(section: str, term: binding.TermNode, target: Callable[..., object]) -> Iterator[ConfigError]:
    accepted = binding.signature_parameters(target)
    for name in accepted:
        if name in binding.RESERVED[section] and name != binding.SHARED:
            message = f"'{term.target}' has a parameter '{name}', but this name is a field of the manager"
            others = [other for other in binding.RESERVED[section] if other != binding.SHARED]
            expected = "a target without parameters named " + ", ".join(others)
            yield ConfigError(message, key=term.path, expected=expected)
            return
    known = [*accepted, *binding.RESERVED[section]]
    meant: set[str] = set()  # A parameter with a misspelled key is not also reported as missing.
    for name, value in term.params.items():
        if name in accepted:
            continue
        nearest, expected = nearest_name(name, known), "one of " + ", ".join(known) if known else "no parameters"
        if isinstance(value, Mapping) and set(value) & set(known):
            expected = f"{', '.join(value)} next to _target_, not below '{name}'"
            meant |= set(value)
        meant |= {nearest} if nearest else set()
        message = f"'{term.target}' takes no parameter '{name}'"
        yield ConfigError(message, key=f"{term.path}.{name}", expected=expected, nearest=nearest)
    given = {*term.params, *meant}
    missing = [n for n, p in accepted.items() if p.default is inspect.Parameter.empty and n not in given]
    if missing:
        message = f"'{term.target}' needs " + ", ".join(f"'{n}'" for n in missing)
        yield ConfigError(message, key=term.path, expected="a value for each parameter without a default")


def type_hints(target: Callable[..., object]) -> dict[str, object]:
    """Return the annotations of parameters, except those that fail, such as imports under ``TYPE_CHECKING``."""
    target = binding.read_from(target)
    function = target.__init__ if inspect.isclass(target) else target
    try:
        return typing.get_type_hints(function, include_extras=True)
    except (NameError, TypeError, AttributeError):
        function, hints = inspect.unwrap(function), dict[str, object]()
        for name, annotation in getattr(function, "__annotations__", {}).items():
            alone = types.SimpleNamespace(__annotations__={name: annotation})
            with suppress(Exception):  # Evaluating an annotation can raise any exception.
                hints |= typing.get_type_hints(alone, getattr(function, "__globals__", {}), include_extras=True)
        return hints


def has_target(value: object) -> bool:
    """Return whether a config value contains the key ``_target_`` at any depth."""
    return any(binding.TARGET in node for _, node in binding.walk_nodes(value))


@contextmanager
def blamed(path: str, part: object, *, has_worked: bool = False, what: str = "code") -> Iterator[None]:
    """Convert an exception in the code of a part, such as a sensor or noise, into an error at the config key ``path``.

    The error is a ConfigError, or, if ``has_worked`` is True, a SimulationFailure; see ``failure``.
    """
    try:
        yield
    except BaseException as error:
        converted = failure(error, path, dotted_name(part), part, has_worked=has_worked, what=what)
        if converted is error:
            raise
        raise converted from error


def dotted_name(part: object) -> str:
    """Return the dotted name of an object's class."""
    return f"{type(part).__module__}.{type(part).__qualname__}"


def failure(
    error: BaseException, path: str, target: str, code: object, *, has_worked: bool, what: str = "a term"
) -> BaseException:
    """Convert an exception from the code of a term at the config key ``path`` into an error with key, file, and line.

    A KeyboardInterrupt by the user, and errors of this program other than ConfigError, are returned unchanged. Any
    other error becomes a SimulationFailure if an earlier call of the term succeeded (``has_worked``), else a
    ConfigError. ``what`` is the noun for the failed code in the message, such as ``a term``.
    """
    if isinstance(error, ConfigError):
        return placed(error, path)
    if isinstance(error, WheellegError) or is_interrupt(error):
        return error
    kind = SimulationFailure if has_worked else ConfigError
    ending = "" if isinstance(error, Exception) else ", which would end the program"
    return kind(
        f"'{target}' raises {in_words(error).splitlines()[0]}{ending}",
        key=path,
        where=_line_of(error, code) or code_place(code),
        expected=f"{what} that works (--debug shows the traceback)",
    )


def placed(error: ConfigError, path: str) -> ConfigError:
    """Return a copy of ``error`` with a full config key: ``weight`` becomes ``env.rewards.alive.weight``."""
    found = copy.copy(error)
    if found.key is None or not found.key.startswith("env."):
        found.key = f"{path}.{found.key}" if found.key else path
    return found


def code_place(code: object) -> str | None:
    """Return the file and line of a function or of an object's class; None if the source code is unknown."""
    found = _definition(code)
    try:
        file, line = inspect.getsourcefile(found), inspect.getsourcelines(found)[1]
    except (OSError, TypeError):
        return None
    return show_file(Path(file), line) if file else None


def _definition(code: object) -> Callable[..., object]:
    return code if inspect.isroutine(code) or inspect.isclass(code) else type(code)


def _line_of(error: BaseException, code: object) -> str | None:
    try:
        file = inspect.getsourcefile(_definition(code))
    except TypeError:
        return None
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return show_file(Path(file), lines[-1]) if file and lines and lines[-1] else None


def described(value: object) -> str:
    """Return a short text for a value: the shape of a tensor or an array, otherwise the type and the value."""
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple):
        kind = "a numpy array" if type(value).__module__ == "numpy" else "a tensor"
        return f"{kind} of shape {tuple(shape)}"
    if value is None:
        return "None"
    text = repr(value)
    return f"{type(value).__name__} {text}" if len(text) <= 40 else f"a {type(value).__name__}"
