"""The one training that tests share, in a folder of each test's own."""

from jobs.conftest import _own_folders, _threads, run, trained

__all__ = ["_own_folders", "_threads", "run", "trained"]
