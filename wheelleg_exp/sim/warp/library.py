"""mujoco-warp and Warp: imported when the engine is chosen, and never before."""

from __future__ import annotations

import os
import sys
import warnings
from types import ModuleType
from typing import Any

import mujoco
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.paths import cache_dir

ENGINE = "env.sim.engine"
DEVICE = "env.sim.device"


def load(device: torch.device) -> tuple[ModuleType, ModuleType]:
    """Return Warp and mujoco-warp, ready for a device; kernels are kept below the program's own cache folder.

    Args:
        device: where the simulations run.

    Raises:
        ConfigError: a package is not installed, or there is no such device.
    """
    try:
        import warp as wp

        if not getattr(wp, "_src").context.runtime:  # noqa: B009  # the first to use it says how
            wp.config.log_level = wp.LOG_WARNING
            wp.config.enable_backward = False  # nobody asks for gradients, which take half of the time of compiling
            if not os.environ.get("WARP_CACHE_PATH"):
                wp.config.kernel_cache_dir = str(cache_dir() / "warp")
            if device.type == "cpu":
                wp.config.optimization_level = 0  # for tests, which wait longer for a compiler than for a step
                _keep_quiet_of_cuda(wp)
            wp.init()
        import mujoco_warp as mjw
    except ImportError as error:
        raise ConfigError(
            f"the engine 'warp' needs the package {error.name}, which is not installed",
            key=ENGINE,
            expected="mujoco, or: pip install 'wheelleg_exp[gpu]'",
        ) from error
    require_device(device)
    return wp, mjw


def _keep_quiet_of_cuda(wp: Any) -> None:
    """Start Warp without its word that there is no CUDA driver, which it writes past Python, and nobody asked for."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        wp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def require_device(device: torch.device) -> None:
    """Raise ConfigError where there is no such device here."""
    if device.type == "cpu":
        return
    count = torch.cuda.device_count()
    known = ["cpu", *(f"cuda:{index}" for index in range(count))]
    if device.type != "cuda" or (device.index or 0) >= count:
        why = ": this torch is for CPUs alone" if torch.version.cuda is None else ""
        raise ConfigError(f"there is no device '{device}' here{why}", key=DEVICE, expected="one of " + ", ".join(known))


def put_model(mjw: Any, model: mujoco.MjModel) -> Any:
    """Return mujoco-warp's model.

    Raises:
        ConfigError: the model has what mujoco-warp does not simulate.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return mjw.put_model(model)
    except (NotImplementedError, ValueError) as error:
        raise ConfigError(
            f"mujoco-warp does not simulate this model: {str(error).rstrip('.')}",
            key=ENGINE,
            expected="mujoco, or a robot, ground and solver without it",
        ) from error
