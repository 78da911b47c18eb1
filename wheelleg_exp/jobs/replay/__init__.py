"""Replay a run from its snapshot alone, and compare the result with the original.

| module | offers |
|---|---|
| ``replay_run`` | the job: requirements, restored source, training, comparison |
| ``restored_source`` | every recorded source tree in its own folder |
| ``restored_imports``, ``snapshot_training`` | the child process that trains with the restored code |
"""
