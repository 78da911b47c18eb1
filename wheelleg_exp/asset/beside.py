"""Files that are no part of a robot and lie beside its MJCF: networks of learned actuators, the ground's own file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.constraints import PathBelow
from wheelleg_exp.paths import GROUND, NETWORKS, find_asset
from wheelleg_exp.terms.values import require_fit


def find_beside(env: Mapping[str, Any], roots: Sequence[Path] = ()) -> dict[str, Path]:
    """Return the files that an ``env`` section names, by the paths that they get beside the MJCF.

    Args:
        env: the section.
        roots: folders of the user's own assets.

    Raises:
        ConfigError: a name is no path below a folder.
        AssetError: a file is not there.
    """
    groups = env["robot"].get("actuators")
    named = [
        (node.get("network_file"), f"env.robot.actuators.{name}.network_file", NETWORKS, "network")
        for name, node in (groups.items() if isinstance(groups, Mapping) else ())
        if isinstance(node, Mapping)
    ]
    terrain = (env.get("scene") or {}).get("terrain")
    if isinstance(terrain, Mapping):
        named.append((terrain.get("file"), "env.scene.terrain.file", GROUND, "ground"))
    found = {}
    for file, key, folder, what in named:
        if file is not None:
            require_fit(key, file, PathBelow)
            found[f"{folder}/{file}"] = find_asset(file, roots, key=key, what=what)
    return found
