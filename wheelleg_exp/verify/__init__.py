"""Check a run against the run's own manifest, and compare two runs.

| module | offers |
|---|---|
| ``check_run``, ``check_files`` | one run: no file is missing or altered, and all files agree |
| ``run_comparison``, ``comparison_text`` | two runs: the verdict, the first difference, the text |
| ``run_differences`` | differences in settings, code, and machine, and which of them may change numbers |
| ``run_parts``, ``policy_differences``, ``tensor_differences`` | differences in results |
| ``tolerance`` | when unequal numbers count as the same training |
"""

from wheelleg_exp.verify.check_files import Check, RunFindings
from wheelleg_exp.verify.check_run import verify_run
from wheelleg_exp.verify.run_comparison import Comparison, compare_runs
from wheelleg_exp.verify.run_differences import FactDifference, environment_differences

__all__ = [
    "Check",
    "Comparison",
    "FactDifference",
    "RunFindings",
    "compare_runs",
    "environment_differences",
    "verify_run",
]
