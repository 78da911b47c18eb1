"""Holding runs against their own manifests, and against each other.

| module | owns |
|---|---|
| ``checks``, ``findings`` | one run: nothing missing, nothing altered, everything agrees with everything |
| ``check_files``, ``check_snapshot``, ``check_results`` | what is checked, by subject |
| ``comparison``, ``sides`` | two runs: the verdict |
| ``divergence`` | the first place where they part |
| ``log`` | ``iterations.jsonl``, read back |
| ``settings`` | what two runs were asked to compute |
| ``parts``, ``checkpoints``, ``tensors``, ``exported`` | what came out of them |
| ``environment`` | what they were made with, and which of it may change rounding |
| ``tolerance`` | when numbers that are not equal count as the same training |
| ``text`` | a comparison in words |

Nothing here imports torch until a checkpoint has to be opened.
"""

from wheelleg_exp.run.verification.checks import verify_run
from wheelleg_exp.run.verification.comparison import Comparison, Divergence, compare_runs
from wheelleg_exp.run.verification.environment import FactDifference, environment_differences
from wheelleg_exp.run.verification.findings import Check, RunFindings

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
