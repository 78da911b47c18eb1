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
    """Return the modules Warp and mujoco-warp for a device; raise ConfigError if a package or device is missing."""
    try:
        import warp as wp

        if not getattr(wp, "_src").context.runtime:  # noqa: B009  # Changes of wp.config have no effect after wp.init.
            wp.config.log_level = wp.LOG_WARNING
            # Without gradient kernels, which the simulation does not use, Warp kernels compile in half the time.
            wp.config.enable_backward = False
            if not os.environ.get("WARP_CACHE_PATH"):
                wp.config.kernel_cache_dir = str(cache_dir() / "warp")
            if device.type == "cpu":
                wp.config.optimization_level = 0  # On a CPU, optimised compilation takes longer than it saves.
                # Without a CUDA driver, Warp's C++ code writes a warning directly to file descriptor 2 (stderr).
                # Redirect file descriptor 2 to the null device while Warp starts, which hides the warning about CUDA.
                sys.stderr.flush()
                saved, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
                try:
                    os.dup2(nowhere, 2)
                    wp.init()
                finally:
                    os.dup2(saved, 2)
                    os.close(saved)
                    os.close(nowhere)
            wp.init()
        import mujoco_warp as mjw
    except ImportError as error:
        message = f"the engine 'warp' needs the package {error.name}, which is not installed"
        raise ConfigError(message, key=ENGINE, expected="mujoco, or: pip install 'wheelleg_exp[gpu]'") from error
    require_device(device)
    return wp, mjw


def repeat_torch() -> None:
    """Make torch and cuBLAS compute in a fixed order on GPUs, in this process; torch raises an error where it cannot.

    cuBLAS reads its variable when torch first multiplies matrices, so call this function before.
    """
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True)
    # Do not fill each new tensor with NaN, because this takes time.
    setattr(torch.utils.deterministic, "fill_uninitialized_memory", False)  # noqa: B010  # not annotated by torch


def require_device(device: torch.device) -> None:
    """Raise ConfigError if a device does not exist on the present machine."""
    if device.type == "cpu":
        return
    count = torch.cuda.device_count()
    known = ["cpu", *(f"cuda:{index}" for index in range(count))]
    if device.type != "cuda" or (device.index or 0) >= count:
        why = ": the installed torch supports only CPUs" if torch.version.cuda is None else ""
        message = f"the device '{device}' does not exist on this machine{why}"
        raise ConfigError(message, key=DEVICE, expected="one of " + ", ".join(known))


def put_model(mjw: ModuleType, model: mujoco.MjModel) -> Any:
    """Convert a MuJoCo model to mujoco-warp; raise ConfigError if mujoco-warp cannot simulate the model."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return mjw.put_model(model)
    except (NotImplementedError, ValueError) as error:
        message = f"mujoco-warp cannot simulate this model: {str(error).rstrip('.')}"
        expected = "mujoco, or a robot, ground and solver that mujoco-warp supports"
        raise ConfigError(message, key=ENGINE, expected=expected) from error


class Graphs:
    """Runs Warp functions in the order of torch's stream; on a GPU, each function is captured as a CUDA graph.

    The first call of a function runs it directly, which compiles its kernels; the second captures it, and later calls
    launch the graph. While torch captures a CUDA graph, a function becomes part of torch's graph.
    """

    def __init__(self, wp: ModuleType, device: torch.device, wanted: bool) -> None:
        self._wp, self._device = wp, device
        self.place = wp.device_from_torch(device)
        self._wanted = wanted and device.type == "cuda"
        self._captured: dict[str, Any] = {}

    @property
    def is_capturing(self) -> bool:
        """Whether torch is capturing a CUDA graph now."""
        return self._device.type == "cuda" and torch.cuda.is_current_stream_capturing()

    def forget(self) -> None:
        """Drop all captured CUDA graphs, because the arrays that the graphs refer to were replaced."""
        self._captured.clear()

    @contextmanager
    def here(self) -> Iterator[None]:
        """Launch the kernels inside the ``with`` block on the device, after all earlier kernels of torch."""
        wp, stream = self._wp, self._stream()
        if stream is None:  # Warp synchronises its own stream with torch's default stream.
            with wp.ScopedDevice(self.place):
                yield
        elif torch.cuda.is_current_stream_capturing():
            with wp.ScopedStream(stream, sync_enter=False), wp.ScopedCapture(stream=stream, external=True):
                yield
        else:
            with wp.ScopedStream(stream, sync_enter=False):
                yield

    def run(self, name: str, work: Callable[[], None]) -> None:
        """Run the function ``work``; calls with equal ``name`` must launch the same kernels on the same arrays."""
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
        """Return torch's current CUDA stream as a Warp stream; None means the default stream."""
        if self._device.type != "cuda":
            return None
        stream = torch.cuda.current_stream(self._device)
        if stream == torch.cuda.default_stream(self._device):
            return None
        return self._wp.stream_from_torch(stream)
