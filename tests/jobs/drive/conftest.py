"""Fixtures of the drive tests, which share one small training."""

from jobs.conftest import _cache_and_threads, _own_folder, run, trained

__all__ = ["_cache_and_threads", "_own_folder", "run", "trained"]
