"""What goes wrong in the code of terms, as one error with the term's key and the line of that code."""

from __future__ import annotations

import copy
import inspect
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import ConfigError, SimulationFailure, WheellegError
from wheelleg_exp.managers.returned import Form
from wheelleg_exp.paths import show_file
from wheelleg_exp.user_code import in_words, is_interrupt


def failure(error: BaseException, path: str, target: str, code: Any, *, has_worked: bool) -> BaseException:
    """Return what a term's code raised as an error for people; a stop that somebody has asked for stays what it is.

    Args:
        error: what it raised.
        path: the term's config key.
        target: dotted name of the function or class.
        code: the function or object.
        has_worked: whether it has been called before without an error: then the run has failed, not its input.
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
        expected="a term that works (--debug shows the traceback)",
    )


def require_form(form: Form, value: Any, source: str, path: str, code: Any) -> None:
    """Hold what code returned against a form.

    Args:
        form: what is needed.
        value: what was returned.
        source: who returned it, in words.
        path: its config key.
        code: the function or object, whose definition is where the mistake is mended.

    Raises:
        ConfigError: it is something else.
    """
    try:
        form.check(value, source)
    except ConfigError as error:
        raise ConfigError(error.message, key=path, where=code_place(code), expected=error.expected) from None


def placed(error: ConfigError, path: str) -> ConfigError:
    """Return the error with its key below the term's, unless it names a place of its own."""
    found = copy.copy(error)
    if found.key is None or not found.key.startswith("env."):
        found.key = f"{path}.{found.key}" if found.key else path
    return found


def code_place(code: Any) -> str | None:
    """Return the file and line at which a function, or the class of an object, is defined; None when unknown."""
    found = _definition(code)
    try:
        file, line = inspect.getsourcefile(found), inspect.getsourcelines(found)[1]
    except (OSError, TypeError):
        return None
    return show_file(Path(file), line) if file else None


def _definition(code: Any) -> Callable[..., Any]:
    return code if inspect.isroutine(code) or inspect.isclass(code) else type(code)


def _line_of(error: BaseException, code: Any) -> str | None:
    """Return the innermost line of the term's own file that the error passed through."""
    try:
        file = inspect.getsourcefile(_definition(code))
    except TypeError:
        return None
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
    return show_file(Path(file), lines[-1]) if file and lines and lines[-1] else None
