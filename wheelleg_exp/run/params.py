"""``params/env.yaml`` and ``params/agent.yaml``: they build the same environment and agent again."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import read_yaml, require_mapping, write_text
from wheelleg_exp.plain_yaml import dump_yaml

PARTS = ("env", "agent")
# Keys of ``agent`` that a trained policy depends on; all others are of the training.
OF_A_POLICY = ("actor", "student", "obs_groups", "clip_actions", "torch_threads")


def require_resolved(params: Mapping[str, Any], where: str | None = None) -> None:
    """Raise RunDirectoryError, with the key, where a value holds ``${``: parameters are what a run was made with.

    Args:
        params: ``env`` and ``agent``, or one of them.
        where: the file that they stand in.
    """
    for key in _unresolved(params, ""):
        raise RunDirectoryError(
            "holds '${', and parameters are not resolved again", key=key, where=where, expected="a plain value"
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
        RunDirectoryError: a part is missing or holds something that is not plain (nothing is written then).
    """
    if set(params) != set(PARTS):
        raise RunDirectoryError(f"parameters for {sorted(params)}", expected=" and ".join(PARTS))
    texts = {part: dump_yaml(params[part]) for part in PARTS}
    for part, text in texts.items():
        write_text(directory / "params" / f"{part}.yaml", text)


def load_params(directory: os.PathLike[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the environment's and the agent's parameters of a run directory.

    Raises:
        RunDirectoryError: a file is missing or is not the YAML of a mapping, with file and line; or a value in it holds
            ``${``.
    """
    paths = {part: Path(directory) / "params" / f"{part}.yaml" for part in PARTS}
    params = {part: _load(path) for part, path in paths.items()}
    for part, path in paths.items():
        require_resolved({part: params[part]}, str(path))
    return params["env"], params["agent"]


def present_form(env: Mapping[str, Any]) -> dict[str, Any]:
    """Return an environment's parameters, perhaps an older version's, as this one writes them.

    Until 0.1 the ground was a plane whose material stood in ``scene.ground``, and there was one engine.
    """
    scene, sim = env.get("scene"), env.get("sim")
    if not isinstance(scene, Mapping) or not isinstance(sim, Mapping):
        return dict(env)  # who checks it tells
    scene, sim = dict(scene), {"engine": "mujoco", "device": "cpu", **sim}
    if isinstance(scene.get("ground"), Mapping):
        plane = {"_target_": "wheelleg_exp.sim.terrain.Plane", **scene.pop("ground")}
        scene = {name: scene.get(name, plane) for name in dict.fromkeys(("env_spacing", "terrain", *scene))}
    return {**env, "sim": sim, "scene": scene}


def on_reference_engine(env: Mapping[str, Any]) -> dict[str, Any]:
    """Return an environment's parameters with MuJoCo's own engine.

    What is evaluated, played and exported is simulated on it wherever a policy was trained, unless an override says
    otherwise: then figures compare, and a machine without a GPU has them.
    """
    if not isinstance(env.get("sim"), Mapping):
        return dict(env)  # who checks it tells
    return {**env, "sim": {**env["sim"], "engine": "mujoco", "device": "cpu"}}


def load_config(directory: os.PathLike[str]) -> dict[str, Any]:
    """Return the config that a run was composed to, its interpolations as written (raises as ``load_params``)."""
    return _load(Path(directory) / ".hydra" / "config.yaml")


def _load(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise RunDirectoryError(f"there is no '{path}'", expected="the parameters that the run was made with")
    return require_mapping(read_yaml(path), path)
