"""Run sweep jobs in Slurm's queue, or in submitit's own stand-in for a queue on this machine."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import submitit

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.sweep_queue import Queue, QueuedJob, QueueWorker, Ticket

_OF_ALL = (  # which submitit takes without the name of its executor before them
    *("timeout_min", "cpus_per_task", "gpus_per_node", "tasks_per_node"),
    *("mem_gb", "nodes", "name", "stderr_to_stdout"),
)
_OF_EXECUTOR = ("max_num_timeout",)
_NOT_ITS = ("_target_", "submitit_folder", *_OF_EXECUTOR)


class SubmititLauncher(Queue):
    """Hands jobs in through submitit, as hydra-submitit-launcher does: those of one sweep are one array of Slurm's.

    Args:
        cluster: ``slurm`` or ``local``.
        settings: of ``hydra.launcher``, plain.
        folder: the sweep's folder.

    Raises:
        ConfigError: submitit refuses a setting, or there is no Slurm here.
    """

    def __init__(self, cluster: str, settings: Mapping[str, Any], folder: Path) -> None:
        super().__init__(folder)
        own = {f"{cluster}_{key}": settings[key] for key in _OF_EXECUTOR if key in settings}
        try:
            self._executor = submitit.AutoExecutor(folder=settings["submitit_folder"], cluster=cluster, **own)
            parameters = {
                key if key in _OF_ALL else f"{cluster}_{key}": value
                for key, value in settings.items()
                if key not in _NOT_ITS
            }
            self._executor.update_parameters(**parameters)
        except (RuntimeError, TypeError, ValueError, NameError, AssertionError) as error:
            raise ConfigError(
                f"submitit refuses it: {' '.join(str(error).split())[:300]}",
                key="hydra.launcher",
                expected="settings of hydra-submitit-launcher, on a machine that has what they ask for",
            ) from error

    def submit(self, jobs: Collection[QueuedJob]) -> list[Ticket]:
        """Hand jobs in, all together."""
        try:
            with self._executor.batch():
                found = [self._executor.submit(QueueWorker(), str(job.folder)) for job in jobs]
        except (submitit.core.utils.FailedJobError, OSError) as error:
            raise ConfigError(
                f"the jobs were not taken: {' '.join(str(error).split())[-300:]}",
                key="hydra.launcher",
                expected="a partition, times and memory that the cluster has",
            ) from error
        return [_Ticket(each) for each in found]


class _Ticket:
    def __init__(self, job: Any) -> None:
        self._job = job

    def gone(self) -> bool:
        """Return whether the job has ended, in whatever way."""
        return bool(self._job.done())

    def cancel(self) -> None:
        """End the job, or take it out of the queue."""
        self._job.cancel(check=False)

    def why(self) -> str:
        """Return what submitit says of the end of a job that told nothing itself, to follow its name."""
        words = [line.strip() for line in (self._job.stderr() or "").splitlines() if line.strip()]
        last = f": {words[-1][:300]}" if words else ""
        state = "" if self._job.state == "FINISHED" else f" ({self._job.state})"  # which submitit says of any end here
        return f"was ended from outside, as submitit's job {self._job.job_id}{state}{last}"
