"""Read the inputs of a run from its directory: parameters, config, overrides, and hashes of the robot files.

``params/env.yaml`` and ``params/agent.yaml`` contain all parameters that rebuild environment and agent. The file
``.hydra/config.yaml`` contains unresolved ``${...}``, and anyone can have changed it. Each ``${...}`` is resolved from
the config's own keys and the run's recorded environment variables, without variables of this process and user-defined
resolvers. Recorded overrides can change config values, but not Hydra's own settings.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, NoReturn

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import read_json, read_yaml, require_mapping, write_text
from wheelleg_exp.plain_data import dump_yaml
from wheelleg_exp.run.records import read_record
from wheelleg_exp.terms.key_syntax import is_override

PARTS = ("env", "agent")
# A trained policy depends on the ``POLICY_KEYS`` of ``agent``; other keys of ``agent`` affect only the training.
POLICY_KEYS = ("actor", "student", "obs_groups", "clip_actions", "torch_threads")


def require_resolved(params: Mapping[str, object], where: str | None = None) -> None:
    """Raise RunDirectoryError if a parameter contains ``${``, because runs store only resolved parameters."""
    for key, _ in _unresolved(params, ""):
        message = "the value contains '${', but parameters are not resolved again"
        raise RunDirectoryError(message, key=key, where=where, expected="a plain value")


def _unresolved(value: object, key: str) -> Iterator[tuple[str, str]]:
    """Yield the path and the text of each value and key that contains ``${``."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            for text in (name, item):
                yield from _unresolved(text, f"{key}.{name}".lstrip("."))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _unresolved(item, f"{key}[{index}]")
    elif isinstance(value, str) and "${" in value:
        yield key, value


def write_params(directory: Path, params: Mapping[str, object]) -> None:
    """Write ``env.yaml`` and ``agent.yaml`` below ``directory/params``; write no file if a parameter is invalid."""
    for part, text in {part: dump_yaml(params[part]) for part in PARTS}.items():
        write_text(directory / "params" / f"{part}.yaml", text)


def load_params(directory: os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the resolved parameters of a run's environment and agent, read from the run directory."""
    paths = {part: Path(directory) / "params" / f"{part}.yaml" for part in PARTS}
    params = {part: _load_mapping(path) for part, path in paths.items()}
    for part, path in paths.items():
        require_resolved({part: params[part]}, str(path))
    return params["env"], params["agent"]


def upgrade_env_params(env: Mapping[str, object]) -> dict[str, object]:
    """Convert an environment's parameters from the format of an older version of the program to the current format."""
    # Until version 0.1, the ground was a plane with its material in ``scene.ground``, and MuJoCo was the only engine.
    scene, sim = env.get("scene"), env.get("sim")
    if not isinstance(scene, Mapping) or not isinstance(sim, Mapping):
        return dict(env)  # If ``scene`` or ``sim`` is not a mapping, a later check of the config raises an error.
    scene, sim = dict(scene), {"engine": "mujoco", "device": "cpu", **sim}
    if isinstance(scene.get("ground"), Mapping):
        plane = {"_target_": "wheelleg_exp.sim.terrain.Plane", **scene.pop("ground")}
        scene = {name: scene.get(name, plane) for name in dict.fromkeys(("env_spacing", "terrain", *scene))}
    return {**env, "sim": sim, "scene": scene}


def on_reference_engine(env: Mapping[str, object]) -> dict[str, object]:
    """Return an environment's parameters, but with MuJoCo on the CPU as the physics engine."""
    # By default, the commands evaluate, play, and export simulate with MuJoCo on the CPU, which needs no GPU.
    # The metrics of two evaluations are comparable only if both evaluations use the same physics engine.
    sim = env.get("sim")
    if not isinstance(sim, Mapping):
        return dict(env)  # If ``sim`` is not a mapping, a later check of the config raises an error.
    return {**env, "sim": {**sim, "engine": "mujoco", "device": "cpu"}}


def load_config(directory: os.PathLike[str]) -> dict[str, object]:
    """Return a run's composed config with unresolved ``${...}``; raise RunDirectoryError if the config is missing."""
    return _load_mapping(Path(directory) / ".hydra" / "config.yaml")


def _load_mapping(path: Path) -> dict[str, object]:
    if not path.is_file():
        raise RunDirectoryError(f"'{path}' is missing", expected="the parameters of the run")
    return require_mapping(read_yaml(path), path)


CONFIG, OVERRIDES, ROBOT = ".hydra/config.yaml", ".hydra/overrides.yaml", "asset/asset.json"
# Only the file ``.hydra/config.yaml`` contains the config sections in ``SECTIONS``, with unresolved interpolations.
SECTIONS = ("seed", "task", "recording", "run", "init_from", "init_from_what")
_PURE = ("oc.create", "oc.decode", "oc.dict.keys", "oc.dict.values", "oc.select")
_MAX_STEPS = 10_000  # The largest number of interpolations that are resolved in one config.
_MAX_LETTERS = 100_000  # The largest total number of characters in config values with interpolations.
_NO_DEFAULT = object()
# ``_FORBIDDEN`` matches command options such as ``-cn``, overrides of ``hydra``, and resolver calls ``${name:...}``.
_FORBIDDEN = re.compile(r"\s*(-|[+~]*\s*hydra\b)|.*\$\{.*:", re.DOTALL)


def recorded_config(directory: os.PathLike[str], variables: Mapping[str, str]) -> dict[str, Any]:
    """Return the resolved config sections ``SECTIONS`` of a run; use only the given environment variables."""
    path = Path(directory) / CONFIG
    tree = read_yaml(path)
    if not isinstance(tree, dict):
        raise RunDirectoryError("the config file is not a mapping", key=str(path), expected="the config of the run")
    missing: list[str] = []

    def not_stored(name: str) -> NoReturn:
        missing.append(name)
        raise KeyError(name)

    try:
        return resolved(tree, variables, not_stored, SECTIONS)
    except RunDirectoryError as error:
        if missing:
            message = f"the config requests the environment variable {missing[0]}, which was not stored with the run"
            value = f"{missing[0]} set to its value at the start of the run"
            expected = f"{value}, and 'wheelleg replay': no other command that reads a run uses this environment"
            raise RunDirectoryError(message, key=str(path), expected=expected) from error
        error.key = str(path)
        raise


def written_config(directory: os.PathLike[str]) -> dict[str, object]:
    """Return a run's config with unresolved ``${...}``; return an empty mapping if the config file cannot be read."""
    try:
        config = read_yaml(Path(directory) / CONFIG)
    except RunDirectoryError:
        return {}
    return config if isinstance(config, dict) else {}


def recorded_overrides(directory: os.PathLike[str]) -> list[str]:
    """Return the config overrides with which a run was started; return an empty list if the run stores no overrides."""
    path = Path(directory) / OVERRIDES
    found = read_yaml(path) if path.is_file() else []
    if not isinstance(found, list):
        raise RunDirectoryError("the overrides file is not a list", key=str(path), expected="the overrides of the run")
    return [str(word) for word in found]


def require_overrides(words: Iterable[object], path: Path) -> None:
    """Raise RunDirectoryError unless all words from the file ``path`` are allowed config overrides."""
    # Do not trust overrides that are read from a file, because anyone can have changed the file.
    for word in words:
        if not isinstance(word, str) or not is_override(word) or _FORBIDDEN.match(word):
            expected = "overrides such as env.num_envs=64; name a folder of configs with --config-dir"
            raise RunDirectoryError(f"{word!r} is not allowed as a recorded override", key=str(path), expected=expected)


@dataclass(frozen=True, kw_only=True)
class RobotIdentity:
    """The content of ``asset/asset.json``: the sha256 of each robot file, and of the compiled model."""

    source: str | None = None
    sources: Mapping[str, str]
    model_sha256: str


def recorded_robot(directory: os.PathLike[str]) -> RobotIdentity:
    """Return the sha256 of each robot file of a run, and of the robot's compiled model."""
    path = Path(directory) / ROBOT
    return read_record(RobotIdentity, read_json(path), "broken identity of the run's robot", path)


def resolved(
    tree: Mapping[str, object],
    variables: Mapping[str, str],
    absent: Callable[[str], object],
    sections: tuple[str, ...] = (),
) -> dict[str, object]:
    """Return a config or some config sections; each ``${...}`` is resolved from the config and the given variables.

    ``${oc.env:NAME}`` is ``variables[NAME]``, the config's default, or else ``absent(NAME)``.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException

    letters = sum(len(text) for _, text in _unresolved(tree, ""))
    try:
        if letters > _MAX_LETTERS:
            raise InterpolationResolutionError(f"config values with '${{' are too long: {letters} characters in total")
        with _restricted_resolvers(variables, absent):
            config = OmegaConf.create(dict(tree))
            values = {key: OmegaConf.select(config, key) for key in sections or map(str, tree)}
            plain = OmegaConf.to_container
            return {key: plain(x, resolve=True) if OmegaConf.is_config(x) else x for key, x in values.items()}
    except (OmegaConfBaseException, ValueError, TypeError, RecursionError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise RunDirectoryError(f"the config cannot be resolved: {reason}", expected="the config of the run") from error


@contextmanager
def _restricted_resolvers(variables: Mapping[str, str], absent: Callable[[str], object]) -> Iterator[None]:
    """Inside the ``with`` block, let OmegaConf call only built-in resolvers, and limit the number of interpolations."""
    from omegaconf import OmegaConf
    from omegaconf.base import Container
    from omegaconf.basecontainer import BaseContainer
    from omegaconf.errors import InterpolationResolutionError

    from wheelleg_exp.config.composing.sized_values import register

    resolvers, resolve, steps = dict(BaseContainer._resolvers), Container.resolve_parse_tree, count()

    def bounded(self: Container, *arguments: Any, **more: Any) -> object:
        if next(steps) >= _MAX_STEPS:
            raise InterpolationResolutionError(f"resolving the config takes more than {_MAX_STEPS} interpolations")
        return resolve(self, *arguments, **more)

    def variable(name: str, default: object = _NO_DEFAULT) -> object:
        if name in variables:
            return variables[name]
        if default is _NO_DEFAULT:
            return absent(name)
        return None if default is None else str(default)

    BaseContainer._resolvers = {name: resolvers[name] for name in _PURE}
    Container.resolve_parse_tree = bounded  # type: ignore[method-assign]
    try:
        OmegaConf.register_new_resolver("oc.env", variable)
        register()
        yield
    finally:
        BaseContainer._resolvers, Container.resolve_parse_tree = resolvers, resolve  # type: ignore[method-assign]
