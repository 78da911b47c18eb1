"""Hydra's launchers that sweeps know: what each needs to be installed, and how many jobs it has at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

from hydra.core.config_store import ConfigStore

QUEUES = ("submitit_local", "submitit_slurm", "ray")
LAUNCHERS = ("basic", "joblib", *QUEUES)
_NEEDS = {
    "submitit_local": ("slurm", ("submitit", "hydra_plugins.hydra_submitit_launcher")),
    "submitit_slurm": ("slurm", ("submitit", "hydra_plugins.hydra_submitit_launcher")),
    "ray": ("ray", ("ray",)),
}


@dataclass
class _Ray:
    init: dict[str, Any] = field(default_factory=lambda: {"address": None})
    remote: dict[str, Any] = field(default_factory=dict)


@dataclass
class _RayLauncher:
    _target_: str = "hydra_plugins.hydra_ray_launcher.ray_launcher.RayLauncher"
    ray: _Ray = field(default_factory=_Ray)


def offer_ray() -> None:
    """Let ``hydra/launcher=ray`` have the settings of hydra-ray-launcher where that is not installed.

    Nothing but the settings is taken of it, and it cannot be installed beside a cloudpickle that others want.
    """
    if not _is_there("hydra_plugins.hydra_ray_launcher"):
        ConfigStore.instance().store(group="hydra/launcher", name="ray", node=_RayLauncher, provider="wheelleg_exp")


def not_installed(launcher: str) -> str | None:
    """Return how to install what a launcher needs; None where it is there."""
    extra, modules = _NEEDS.get(launcher, ("", ()))
    return None if all(map(_is_there, modules)) else f"pip install 'wheelleg_exp[{extra}]'"


def jobs_at_once(launcher: str, settings: Mapping[str, Any], jobs: int) -> int:
    """Return how many jobs are handed in at once, as joblib counts.

    Args:
        launcher: one of ``LAUNCHERS``.
        settings: of ``hydra.launcher``.
        jobs: how many there are.
    """
    if launcher == "joblib":
        return int(settings["n_jobs"])
    return jobs if launcher in QUEUES else 1  # a queue knows best how many of them run


def _is_there(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # of a package above it
        return False
