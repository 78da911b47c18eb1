"""Files of the networks of a robot's learned actuators, which lie beside its MJCF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.constraints import PathBelow
from wheelleg_exp.paths import find_asset
from wheelleg_exp.terms.values import require_fit


def find_networks(robot: Mapping[str, Any], roots: Sequence[Path] = ()) -> dict[str, Path]:
    """Return the files of networks that actuators of an ``env.robot`` section name, by their names there.

    Args:
        robot: the section.
        roots: folders of the user's own assets.

    Raises:
        ConfigError: a name is no path below a folder.
        AssetError: a file is not there.
    """
    groups = robot.get("actuators")
    found = {}
    for name, node in groups.items() if isinstance(groups, Mapping) else ():
        file = node.get("network_file") if isinstance(node, Mapping) else None
        if file is not None:
            key = f"env.robot.actuators.{name}.network_file"
            require_fit(key, file, PathBelow)
            found[file] = find_asset(file, roots, key=key, what="network")
    return found
