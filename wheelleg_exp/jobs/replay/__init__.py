"""Replay a run from its snapshot alone, and compare the result with the original.

``replay_run`` starts a child process, which imports the restored source (``restored_imports``) and trains.
"""
