"""How good a policy is, in physical units, on fixed scenarios that are the same for every policy.

``evaluate(env_cfg, mjcf, make_policy, protocol, seed)`` rolls a policy through the scenarios of a protocol and returns
an ``Evaluation``: one row for each episode, and the metrics with their intervals. Nothing heavy is imported before.

| module | what it offers |
|---|---|
| `options` | what a protocol says: `configs/protocol/` |
| `scenarios` | the table of commands, and its sha256 |
| `task` | the environment of a task as an evaluation wants it |
| `held_command` | the task's command, held from outside |
| `robot_parts` | which joints are wheels, which mirror which |
| `rollout` | N episodes without a reset, as whole tensors over time |
| `over_time` | means, exits and slopes over the steps that count |
| `measuring` | columns of the episodes, by test |
| `metrics`, `catalogue` | what a metric is of the episodes, and its interval; which there are |
| `protocol` | all tests of a protocol: the entry |
| `result` | the evaluation itself |
| `statistics`, `comparison` | intervals over training seeds; tests of paired episodes |
| `reference` | a linear-quadratic balancer to hold policies against |
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wheelleg_exp.evaluation.protocol import evaluate
    from wheelleg_exp.evaluation.result import Evaluation, Figure

__all__ = ["Evaluation", "Figure", "evaluate"]

_HOME = {"evaluate": "protocol", "Evaluation": "result", "Figure": "result"}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    from importlib import import_module

    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
