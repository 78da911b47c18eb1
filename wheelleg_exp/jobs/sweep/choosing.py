"""Which launcher Hydra's group ``hydra/launcher`` names; what a queue works with is imported only then."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wheelleg_exp.jobs.sweep.launchers import Launcher, LocalLauncher


def launcher_of(name: str, settings: Mapping[str, Any], folder: Path) -> Launcher:
    """Return the launcher that Hydra's group ``hydra/launcher`` names.

    Args:
        name: the group's option.
        settings: its settings, plain.
        folder: the sweep's folder, which all machines must see.

    Raises:
        WheellegError: what it works with is not installed, or cannot be reached.
    """
    if name.startswith("submitit"):
        from wheelleg_exp.jobs.sweep.submitit_launcher import SubmititLauncher

        return SubmititLauncher(name.removeprefix("submitit_"), settings, folder)
    if name == "ray":
        from wheelleg_exp.jobs.sweep.ray_launcher import RayLauncher

        return RayLauncher(settings, folder)
    return LocalLauncher()
