"""What goes wrong in code that a config names, as one error with its key and the line of that code."""

from __future__ import annotations

import copy
import inspect
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import ConfigError, SimulationFailure, WheellegError
from wheelleg_exp.paths import show_file
from wheelleg_exp.user_code import in_words, is_interrupt


@contextmanager
def blamed(path: str, part: Any, *, has_worked: bool = False) -> Iterator[None]:
    """Tell what a part of the scene raises in the body as an error of its config key.

    Args:
        path: its config key.
        part: the object.
        has_worked: whether the scene has been built with it: then the run has failed, not its input.

    Raises:
        ConfigError: the part raises an error; SimulationFailure when it has worked.
    """
    try:
        yield
    except BaseException as error:
        told = failure(error, path, dotted_name(part), part, has_worked=has_worked, what="code")
        if told is error:
            raise
        raise told from error


def dotted_name(part: Any) -> str:
    """Return the dotted name of an object's class."""
    return f"{type(part).__module__}.{type(part).__qualname__}"


def failure(
    error: BaseException, path: str, target: str, code: Any, *, has_worked: bool, what: str = "a term"
) -> BaseException:
    """Return what a term's code raised as an error for people; a stop that somebody has asked for stays what it is.

    Args:
        error: what it raised.
        path: the term's config key.
        target: dotted name of the function or class.
        code: the function or object.
        has_worked: whether it has been called before without an error: then the run has failed, not its input.
        what: the code in words.
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


def described(value: Any) -> str:
    """Return in words what a value is; what has a shape is told by it, whoever made it."""
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple):
        kind = "a numpy array" if type(value).__module__ == "numpy" else "a tensor"
        return f"{kind} of shape {tuple(shape)}"
    if value is None:
        return "None"
    text = repr(value)
    return f"{type(value).__name__} {text}" if len(text) <= 40 else f"a {type(value).__name__}"
