"""Warp and mujoco-warp at run time: the import when the engine is chosen, devices, and CUDA graphs of launches."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


class Graphs:
    """Runs work on Warp's device in the order of torch's stream, and on a GPU as graphs.

    Work runs by itself the first time, which compiles its kernels, is captured the second time, and is one launch from
    then on. Within a capture of torch's own it becomes a part of that.

    Args:
        wp: Warp.
        device: where the work runs.
        wanted: whether to capture; a CPU has no graphs.
    """

    def __init__(self, wp: Any, device: torch.device, wanted: bool) -> None:
        self._wp, self._device = wp, device
        self.place = wp.device_from_torch(device)
        self._wanted = wanted and device.type == "cuda"
        self._captured: dict[str, Any] = {}

    @property
    def is_capturing(self) -> bool:
        """Whether torch captures what is launched now."""
        return self._device.type == "cuda" and torch.cuda.is_current_stream_capturing()

    def forget(self) -> None:
        """Forget what was captured: the arrays that it works on are others now."""
        self._captured.clear()

    @contextmanager
    def here(self) -> Iterator[None]:
        """Launch what is inside on the device, behind what torch has launched."""
        wp, stream = self._wp, self._stream()
        if stream is None:  # Warp's own stream keeps step with torch's default one
            with wp.ScopedDevice(self.place):
                yield
        elif torch.cuda.is_current_stream_capturing():
            with wp.ScopedStream(stream, sync_enter=False), wp.ScopedCapture(stream=stream, external=True):
                yield
        else:
            with wp.ScopedStream(stream, sync_enter=False):
                yield

    def run(self, name: str, work: Callable[[], None]) -> None:
        """Run work that always launches the same kernels on the same arrays.

        Args:
            name: what it is known by.
            work: launches the kernels.
        """
        if not self._wanted or self.is_capturing:
            with self.here():
                work()
        elif name not in self._captured:
            with self.here():
                work()
            self._captured[name] = None
        else:
            if self._captured[name] is None:
                self._captured[name] = self._capture(work)
            self._wp.capture_launch(self._captured[name], stream=self._stream() or self.place.stream)

    def _capture(self, work: Callable[[], None]) -> Any:
        torch.cuda.synchronize(self._device)
        with self._wp.ScopedDevice(self.place), self._wp.ScopedCapture(self.place) as capture:
            work()
        return capture.graph

    def _stream(self) -> Any:
        """Return torch's present stream for Warp, None when it is the default one."""
        if self._device.type != "cuda":
            return None
        stream = torch.cuda.current_stream(self._device)
        if stream == torch.cuda.default_stream(self._device):
            return None
        return self._wp.stream_from_torch(stream)
