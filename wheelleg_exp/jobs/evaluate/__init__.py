"""Evaluating a run's policy: scenarios of a protocol, and what is kept of them below the run.

| module | what it offers |
|---|---|
| `evaluate` | the job: a run and a protocol become `evaluation/<time>/` |
| `settings` | the run's env and agent beside the composed protocol |
"""
