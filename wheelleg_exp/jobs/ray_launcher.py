"""Run sweep jobs on a Ray cluster, or on the cluster that Ray starts on this machine."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import ray

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.sweep_queue import Queue, QueuedJob, QueueWorker, Ticket

_OBJECT_STORE = 78_643_200  # bytes, the least that Ray takes: nothing but a folder's name passes through it
_INIT = {"include_dashboard": False, "log_to_driver": False, "logging_level": "error"}


class RayLauncher(Queue):
    """Hands each job in as one task, with the settings of hydra-ray-launcher's option ``ray``.

    Args:
        settings: of ``hydra.launcher``, plain: ``ray.init`` and ``ray.remote``.
        folder: the sweep's folder.

    Raises:
        ConfigError: the cluster cannot be reached, or Ray refuses a setting.
    """

    def __init__(self, settings: Mapping[str, Any], folder: Path) -> None:
        super().__init__(folder)
        chosen = settings["ray"]
        init = {**_INIT, **chosen["init"]}
        if init.get("address") is None and "RAY_ADDRESS" not in os.environ:  # a cluster of its own
            init.setdefault("object_store_memory", _OBJECT_STORE)
        try:
            if not ray.is_initialized():
                ray.init(**init)
            # A job that dies is told of, and not begun again.
            options = {"max_retries": 0, **chosen["remote"]}
            self._task = ray.remote(**options)(_carry)
        except (ConnectionError, RuntimeError, TypeError, ValueError) as error:
            raise ConfigError(
                f"Ray refuses it: {' '.join(str(error).split())[:300]}",
                key="hydra.launcher.ray",
                expected="init: what ray.init takes, such as address; remote: what ray.remote takes, such as num_cpus",
            ) from error

    def submit(self, jobs: Collection[QueuedJob]) -> list[Ticket]:
        """Hand jobs in."""
        return [_Ticket(self._task.remote(str(job.folder))) for job in jobs]


def _carry(folder: str) -> str:
    return QueueWorker()(folder)


class _Ticket:
    def __init__(self, reference: Any) -> None:
        self._reference = reference

    def gone(self) -> bool:
        """Return whether the task has ended, in whatever way."""
        done, _ = ray.wait([self._reference], timeout=0)
        return bool(done)

    def cancel(self) -> None:
        """End the task's worker, or take the task out of the queue."""
        ray.cancel(self._reference, force=True)

    def why(self) -> str:
        """Return what Ray says of the end of a task that told nothing itself, to follow its name."""
        try:
            ray.get(self._reference, timeout=1)
        except ray.exceptions.RayError as error:
            line = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
            return f"was ended from outside on Ray: {line.strip()[:300]}"
        return "ended on Ray and did not say why"
