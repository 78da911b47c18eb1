"""Measure how well a policy works, in physical units. All policies run in the same fixed scenarios.

``evaluate(env_cfg, mjcf, make_policy, protocol, seed)`` runs a policy in the scenarios of an evaluation protocol. It
returns an ``Evaluation``: one row per episode, and metrics with their intervals. Python imports ``evaluate`` and its
result classes at the first use, because their modules import torch.

| module | offers |
|---|---|
| ``protocol_options`` | the options of a protocol: ``configs/protocol/`` |
| ``scenarios`` | the table of commands, and its sha256 |
| ``evaluation_env`` | the environment of a task for an evaluation; its wheels and mirrored joints |
| ``policy_rollout``, ``trajectories`` | N episodes without a reset, as tensors over time |
| ``motion_columns``, ``terrain_tests``, ``disturbance_tests`` | columns of episodes, by test |
| ``metric_catalogue`` | all metrics, and their intervals |
| ``protocol`` | all tests of a protocol: the entry point |
| ``result`` | the evaluation's result |
| ``method_comparison`` | intervals over training seeds; tests of paired episodes |
| ``lqr_balancer`` | a linear-quadratic balancer as a reference |
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
