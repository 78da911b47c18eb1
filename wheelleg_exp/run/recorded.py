"""What a record holds, read back safely: a run's config is resolved from itself alone; overrides change configs only.

Hydra's ``.hydra/config.yaml`` holds ``${...}`` as it was written, and anybody may have written it. What is resolved
here refers to the config's own keys and to the variables that the run has kept; nothing of this process is asked, and
nothing is called.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import read_json, read_yaml
from wheelleg_exp.run.kinds import misfits
from wheelleg_exp.run.source.secrecy import is_secret_variable
from wheelleg_exp.terms.keys import is_override

if TYPE_CHECKING:
    from omegaconf.base import Container

CONFIG, OVERRIDES, ROBOT = ".hydra/config.yaml", ".hydra/overrides.yaml", "asset/asset.json"
SECTIONS = ("seed", "task", "recording", "run", "init_from", "init_from_what")  # of which a run keeps no resolved copy
_PURE = ("oc.create", "oc.decode", "oc.dict.keys", "oc.dict.values", "oc.select")
_STEPS, _LETTERS = 10_000, 100_000  # most interpolations that are resolved, and most letters of all that hold one
_NONE = object()
_REACHING = re.compile(r"\s*(-|[+~]*\s*hydra\b)|.*\$\{.*:", re.DOTALL)  # options, Hydra's own settings, resolvers


def recorded_config(directory: os.PathLike[str], variables: Mapping[str, str]) -> dict[str, Any]:
    """Return the sections of a run's config of which it keeps no resolved copy, resolved; None for one that is absent.

    Args:
        directory: the run directory.
        variables: the environment variables that its config may ask for.

    Raises:
        RunDirectoryError: it cannot be read or resolved, or asks for another variable.
    """
    path = Path(directory) / CONFIG
    tree = read_yaml(path)
    if not isinstance(tree, dict):
        raise RunDirectoryError("holds no mapping", key=str(path), expected="the config of the run")
    asked: list[str] = []

    def not_kept(name: str) -> Any:
        asked.append(name)
        raise KeyError(name)

    try:
        return resolved(tree, variables, not_kept, SECTIONS)
    except RunDirectoryError as error:
        if asked:
            raise _not_kept(asked[0], path) from error
        error.key = str(path)
        raise


def written_config(directory: os.PathLike[str]) -> dict[str, Any]:
    """Return a run's config, its interpolations as written; empty where none can be read."""
    try:
        config = read_yaml(Path(directory) / CONFIG)
    except RunDirectoryError:
        return {}
    return config if isinstance(config, dict) else {}


def recorded_overrides(directory: os.PathLike[str]) -> list[str]:
    """Return the overrides that a run was composed with, none where none are kept.

    Raises:
        RunDirectoryError: they cannot be read, or are no list.
    """
    path = Path(directory) / OVERRIDES
    found = read_yaml(path) if path.is_file() else []
    if not isinstance(found, list):
        raise RunDirectoryError("holds no list", key=str(path), expected="the overrides of the run")
    return [str(word) for word in found]


def require_overrides(words: Iterable[Any], path: Path) -> None:
    """Refuse recorded words that are composed again unless each is an override of the config and nothing more.

    Refused are options of a command, Hydra's own settings (folders, modules to import), and calls of resolvers
    (environment variables of this machine). The RunDirectoryError names ``path``, the record.
    """
    for word in words:
        if not isinstance(word, str) or not is_override(word) or _REACHING.match(word):
            expected = "overrides such as env.num_envs=64; name a folder of configs with --config-dir"
            raise RunDirectoryError(f"{word!r} is not accepted from a record", key=str(path), expected=expected)


def recorded_robot(directory: os.PathLike[str]) -> dict[str, Any]:
    """Return what a run's robot is: ``sources``, sha256 by file, and ``model_sha256``.

    Raises:
        RunDirectoryError: it is not kept, or broken.
    """
    path = Path(directory) / ROBOT
    identity = read_json(path)
    for wrong in misfits(identity, {"model_sha256": str, "sources": {str: str}}):
        raise RunDirectoryError(f"'{wrong}' is missing or wrong", key=str(path), expected="what the run's robot is")
    return dict(identity)


def resolved(
    tree: Mapping[str, Any], variables: Mapping[str, str], absent: Callable[[str], Any], sections: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Return a config, or sections of it, with ``${...}`` resolved from itself and the given variables.

    Args:
        tree: the plain config.
        variables: what ``${oc.env:NAME}`` stands for.
        absent: the value of a variable that is not among them and has no default.
        sections: keys; all by default.

    Raises:
        RunDirectoryError: something in it cannot be resolved.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException

    letters = sum(len(text) for text in _texts(tree) if "${" in text)
    try:
        if letters > _LETTERS:
            raise InterpolationResolutionError(f"its interpolations have {letters} letters")
        with _alone(variables, absent):
            config = OmegaConf.create(dict(tree))
            return {key: _plain(OmegaConf.select(config, key)) for key in sections or map(str, tree)}
    except (OmegaConfBaseException, ValueError, TypeError, RecursionError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise RunDirectoryError(f"cannot be resolved: {reason}", expected="the config of the run") from error


def _plain(value: Any) -> Any:
    from omegaconf import OmegaConf

    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


def _texts(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield node
    elif isinstance(node, (dict, list)):
        for item in node.values() if isinstance(node, dict) else node:
            yield from _texts(item)


@contextmanager
def _alone(variables: Mapping[str, str], absent: Callable[[str], Any]) -> Iterator[None]:
    """Let OmegaConf know no resolvers but those that only look at the config, and bound how often it resolves."""
    from omegaconf import OmegaConf
    from omegaconf.base import Container
    from omegaconf.basecontainer import BaseContainer
    from omegaconf.errors import InterpolationResolutionError

    resolvers, resolve, steps = dict(BaseContainer._resolvers), Container.resolve_parse_tree, count()

    def bounded(self: Container, *arguments: Any, **more: Any) -> Any:
        if next(steps) >= _STEPS:
            raise InterpolationResolutionError(f"it takes more than {_STEPS} interpolations")
        return resolve(self, *arguments, **more)

    def variable(name: str, default: Any = _NONE) -> Any:
        if name in variables:
            return variables[name]
        if default is _NONE:
            return absent(name)
        return None if default is None else str(default)

    BaseContainer._resolvers = {name: resolvers[name] for name in _PURE}
    Container.resolve_parse_tree = bounded  # type: ignore[method-assign]
    try:
        OmegaConf.register_new_resolver("oc.env", variable)
        yield
    finally:
        BaseContainer._resolvers, Container.resolve_parse_tree = resolvers, resolve  # type: ignore[method-assign]


def _not_kept(name: str, path: Path) -> RunDirectoryError:
    why = " because its name says that it holds a secret" if is_secret_variable(name) else ""
    return RunDirectoryError(
        f"asks for the environment variable {name}, which was not kept with the run{why}",
        key=str(path),
        expected=f"{name} set to what it was when the run began, and 'wheelleg replay': nothing else that reads a run "
        "takes it from this environment",
    )
