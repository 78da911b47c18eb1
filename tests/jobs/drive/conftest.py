"""Fixtures of the drive tests, which share one small training."""

from jobs.conftest import _own_folders, _threads, run, trained

__all__ = ["_own_folders", "_threads", "run", "trained"]
