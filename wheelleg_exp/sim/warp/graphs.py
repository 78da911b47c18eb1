"""Work that is launched as one CUDA graph: many small kernels cost the host one call."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch


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
