"""Measure how well a policy works, in physical units. All policies run in the same fixed scenarios.

``protocol.evaluate`` runs a policy in all tests of a protocol (``protocol_options``, ``scenarios``) and returns a
``result.Evaluation``: one row per episode, and metrics with intervals (``metric_catalogue``). The columns of the rows
are in ``motion_columns`` and ``disturbance_tests``. ``method_comparison`` compares evaluations, and
``lqr_balancer`` is a reference. ``evaluate`` is imported at the first use, because it imports torch.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from wheelleg_exp.evaluation.protocol import evaluate
    from wheelleg_exp.evaluation.result import Evaluation, Figure

__all__ = ["Evaluation", "Figure", "evaluate"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{'protocol' if name == 'evaluate' else 'result'}"), name)
