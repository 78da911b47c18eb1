"""Read back what a run was built from: parameters, config, overrides, robot.

``params/env.yaml`` and ``params/agent.yaml`` build the same environment and agent again. Hydra's
``.hydra/config.yaml`` contains ``${...}`` as written, and anybody may have written it. It is resolved from its own
keys and from the environment variables stored with the run. No variable of this process is read, and no function
is called. Recorded overrides can change the config only.
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
from wheelleg_exp.files import read_json, read_yaml, require_mapping, write_text
from wheelleg_exp.plain_data import dump_yaml
from wheelleg_exp.run.manifest import mistyped_keys
from wheelleg_exp.terms.key_syntax import is_override

if TYPE_CHECKING:
    from omegaconf.base import Container


PARTS = ("env", "agent")
# Keys of ``agent`` that a trained policy depends on; the remaining keys concern the training.
POLICY_KEYS = ("actor", "student", "obs_groups", "clip_actions", "torch_threads")


def require_resolved(params: Mapping[str, Any], where: str | None = None) -> None:
    """Raise RunDirectoryError with the key of a value that contains ``${``; parameters must be plain values.

    Args:
        params: ``env`` and ``agent``, or one of them.
        where: the file that contains the parameters.
    """
    for key in _unresolved(params, ""):
        raise RunDirectoryError(
            "contains '${', but parameters are not resolved again", key=key, where=where, expected="a plain value"
        )


def _unresolved(value: Any, key: str) -> Iterator[str]:
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from _unresolved(name, f"{key}.{name}".lstrip("."))
            yield from _unresolved(item, f"{key}.{name}".lstrip("."))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _unresolved(item, f"{key}[{index}]")
    elif isinstance(value, str) and "${" in value:
        yield key


def write_params(directory: Path, params: Mapping[str, dict[str, Any]]) -> None:
    """Write both files below ``directory/params``.

    Raises:
        RunDirectoryError: a part is missing, or a value is not plain. Nothing is written then.
    """
    if set(params) != set(PARTS):
        raise RunDirectoryError(f"parameters for {sorted(params)}", expected=" and ".join(PARTS))
    texts = {part: dump_yaml(params[part]) for part in PARTS}
    for part, text in texts.items():
        write_text(directory / "params" / f"{part}.yaml", text)


def load_params(directory: os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the environment's and the agent's parameters of a run directory.

    Raises:
        RunDirectoryError: a file is missing, is not the YAML of a mapping, or contains ``${``. The error names file and
            line.
    """
    paths = {part: Path(directory) / "params" / f"{part}.yaml" for part in PARTS}
    params = {part: _load_mapping(path) for part, path in paths.items()}
    for part, path in paths.items():
        require_resolved({part: params[part]}, str(path))
    return params["env"], params["agent"]


def upgrade_env_params(env: Mapping[str, Any]) -> dict[str, Any]:
    """Return an environment's parameters in the present format; an older version may have written them.

    Until 0.1, the ground was a plane whose material was in ``scene.ground``, and there was only one engine.
    """
    scene, sim = env.get("scene"), env.get("sim")
    if not isinstance(scene, Mapping) or not isinstance(sim, Mapping):
        return dict(env)  # the config check reports the mistake
    scene, sim = dict(scene), {"engine": "mujoco", "device": "cpu", **sim}
    if isinstance(scene.get("ground"), Mapping):
        plane = {"_target_": "wheelleg_exp.sim.terrain.Plane", **scene.pop("ground")}
        scene = {name: scene.get(name, plane) for name in dict.fromkeys(("env_spacing", "terrain", *scene))}
    return {**env, "sim": sim, "scene": scene}


def on_reference_engine(env: Mapping[str, Any]) -> dict[str, Any]:
    """Return an environment's parameters with MuJoCo's own engine.

    Evaluations, plays and exports simulate on this engine by default, wherever the policy was trained. So their figures
    can be compared, and no GPU is needed.
    """
    if not isinstance(env.get("sim"), Mapping):
        return dict(env)  # the config check reports the mistake
    return {**env, "sim": {**env["sim"], "engine": "mujoco", "device": "cpu"}}


def load_config(directory: os.PathLike[str]) -> dict[str, Any]:
    """Return a run's composed config, with unresolved interpolations; raises as ``load_params``."""
    return _load_mapping(Path(directory) / ".hydra" / "config.yaml")


def _load_mapping(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise RunDirectoryError(f"'{path}' is missing", expected="the parameters of the run")
    return require_mapping(read_yaml(path), path)


CONFIG, OVERRIDES, ROBOT = ".hydra/config.yaml", ".hydra/overrides.yaml", "asset/asset.json"
SECTIONS = (
    "seed",
    "task",
    "recording",
    "run",
    "init_from",
    "init_from_what",
)  # sections without a resolved copy in the run
_PURE = ("oc.create", "oc.decode", "oc.dict.keys", "oc.dict.values", "oc.select")
_STEPS, _LETTERS = 10_000, 100_000  # limits: resolved interpolations, and letters of texts that contain one
_NO_DEFAULT = object()
_REACHING = re.compile(r"\s*(-|[+~]*\s*hydra\b)|.*\$\{.*:", re.DOTALL)  # options, Hydra's own settings, resolvers


def recorded_config(directory: os.PathLike[str], variables: Mapping[str, str]) -> dict[str, Any]:
    """Return the resolved sections of a run's config of which the run has no resolved copy; None for a missing one.

    Args:
        directory: the run directory.
        variables: the environment variables that the config can request.

    Raises:
        RunDirectoryError: the config cannot be read or resolved, or requests another variable.
    """
    path = Path(directory) / CONFIG
    tree = read_yaml(path)
    if not isinstance(tree, dict):
        raise RunDirectoryError("is not a mapping", key=str(path), expected="the config of the run")
    asked: list[str] = []

    def not_kept(name: str) -> Any:
        asked.append(name)
        raise KeyError(name)

    try:
        return resolved(tree, variables, not_kept, SECTIONS)
    except RunDirectoryError as error:
        if asked:
            raise _missing_variable(asked[0], path) from error
        error.key = str(path)
        raise


def written_config(directory: os.PathLike[str]) -> dict[str, Any]:
    """Return a run's config with unresolved interpolations; empty when it cannot be read."""
    try:
        config = read_yaml(Path(directory) / CONFIG)
    except RunDirectoryError:
        return {}
    return config if isinstance(config, dict) else {}


def recorded_overrides(directory: os.PathLike[str]) -> list[str]:
    """Return the overrides that a run was composed with; empty when none are stored.

    Raises:
        RunDirectoryError: the overrides cannot be read, or are not a list.
    """
    path = Path(directory) / OVERRIDES
    found = read_yaml(path) if path.is_file() else []
    if not isinstance(found, list):
        raise RunDirectoryError("is not a list", key=str(path), expected="the overrides of the run")
    return [str(word) for word in found]


def require_overrides(words: Iterable[Any], path: Path) -> None:
    """Raise RunDirectoryError, with the path of the record, unless each recorded word is an override of the config.

    Options of a command, Hydra's own settings (folders, modules to import), and calls of resolvers (environment
    variables of this machine) are refused, because the words are composed again.
    """
    for word in words:
        if not isinstance(word, str) or not is_override(word) or _REACHING.match(word):
            expected = "overrides such as env.num_envs=64; name a folder of configs with --config-dir"
            raise RunDirectoryError(f"{word!r} is not accepted from a record", key=str(path), expected=expected)


def recorded_robot(directory: os.PathLike[str]) -> dict[str, Any]:
    """Return the identity of a run's robot: ``sources``, the sha256 of each file, and ``model_sha256``.

    Raises:
        RunDirectoryError: the record is missing or broken.
    """
    path = Path(directory) / ROBOT
    identity = read_json(path)
    for wrong in mistyped_keys(identity, {"model_sha256": str, "sources": {str: str}}):
        raise RunDirectoryError(
            f"'{wrong}' is missing or wrong", key=str(path), expected="the identity of the run's robot"
        )
    return dict(identity)


def resolved(
    tree: Mapping[str, Any], variables: Mapping[str, str], absent: Callable[[str], Any], sections: tuple[str, ...] = ()
) -> dict[str, Any]:
    """Return a config, or sections of it, with ``${...}`` resolved from itself and the given variables.

    Args:
        tree: the plain config.
        variables: the values of ``${oc.env:NAME}``.
        absent: returns the value of another variable without a default.
        sections: keys; all by default.

    Raises:
        RunDirectoryError: a value cannot be resolved.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import InterpolationResolutionError, OmegaConfBaseException

    letters = sum(len(text) for text in _strings(tree) if "${" in text)
    try:
        if letters > _LETTERS:
            raise InterpolationResolutionError(f"its interpolations have {letters} letters")
        with _restricted_resolvers(variables, absent):
            config = OmegaConf.create(dict(tree))
            return {key: _plain(OmegaConf.select(config, key)) for key in sections or map(str, tree)}
    except (OmegaConfBaseException, ValueError, TypeError, RecursionError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise RunDirectoryError(f"cannot be resolved: {reason}", expected="the config of the run") from error


def _plain(value: Any) -> Any:
    from omegaconf import OmegaConf

    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


def _strings(node: Any) -> Iterator[str]:
    if isinstance(node, str):
        yield node
    elif isinstance(node, (dict, list)):
        for item in node.values() if isinstance(node, dict) else node:
            yield from _strings(item)


@contextmanager
def _restricted_resolvers(variables: Mapping[str, str], absent: Callable[[str], Any]) -> Iterator[None]:
    """Restrict OmegaConf to resolvers that only read the config, and limit the number of resolutions."""
    from omegaconf import OmegaConf
    from omegaconf.base import Container
    from omegaconf.basecontainer import BaseContainer
    from omegaconf.errors import InterpolationResolutionError

    resolvers, resolve, steps = dict(BaseContainer._resolvers), Container.resolve_parse_tree, count()

    def bounded(self: Container, *arguments: Any, **more: Any) -> Any:
        if next(steps) >= _STEPS:
            raise InterpolationResolutionError(f"it takes more than {_STEPS} interpolations")
        return resolve(self, *arguments, **more)

    def variable(name: str, default: Any = _NO_DEFAULT) -> Any:
        if name in variables:
            return variables[name]
        if default is _NO_DEFAULT:
            return absent(name)
        return None if default is None else str(default)

    BaseContainer._resolvers = {name: resolvers[name] for name in _PURE}
    Container.resolve_parse_tree = bounded  # type: ignore[method-assign]
    try:
        OmegaConf.register_new_resolver("oc.env", variable)
        yield
    finally:
        BaseContainer._resolvers, Container.resolve_parse_tree = resolvers, resolve  # type: ignore[method-assign]


def _missing_variable(name: str, path: Path) -> RunDirectoryError:
    return RunDirectoryError(
        f"requests the environment variable {name}, which was not stored with the run",
        key=str(path),
        expected=f"{name} set to its value at the start of the run, and 'wheelleg replay': no other command that "
        "reads a run uses this environment",
    )
