"""Holding runs against their own manifests, and against each other; torch is imported for checkpoints alone.

| module | offers |
|---|---|
| ``self_check`` | one run: nothing missing, nothing altered, everything agrees with everything |
| ``checked_run``, ``check_files``, ``check_snapshot``, ``check_results`` | what is checked, by subject |
| ``comparison``, ``compared_runs``, ``comparison_text`` | two runs: span, verdict, words |
| ``divergence`` | the first place where they part |
| ``settings`` | what two runs were asked to compute, and which settings change no number |
| ``parts``, ``checkpoints``, ``tensors``, ``exported_policies`` | what came out of them |
| ``made_with`` | what they were made with, and which of it may change rounding |
| ``tolerance`` | when numbers that are not equal count as the same training |
"""

from wheelleg_exp.verify.checked_run import Check, RunFindings
from wheelleg_exp.verify.comparison import Comparison, Divergence, compare_runs
from wheelleg_exp.verify.made_with import FactDifference, environment_differences
from wheelleg_exp.verify.self_check import verify_run

__all__ = [
    "Check",
    "Comparison",
    "Divergence",
    "FactDifference",
    "RunFindings",
    "compare_runs",
    "environment_differences",
    "verify_run",
]
