"""Functions for ``modify_fn`` of ``modify_env_param`` and ``modify_term_cfg``: how a value changes with time.

Time is ``common_step_counter``, the control steps since the start of training. ``value``, ``start``, and ``end`` have
the form of the setting: a number, a list of numbers, or a mapping to numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from wheelleg_exp.constraints import Natural
from wheelleg_exp.managers import Env
from wheelleg_exp.mdp.curriculums import modify_env_param


def override_value(env: Env, env_ids: torch.Tensor, old_value: object, value: object, num_steps: Natural) -> object:
    """Return ``value`` after ``num_steps`` control steps of training, and ``NO_CHANGE`` until then."""
    del env_ids, old_value
    return value if env.common_step_counter > num_steps else modify_env_param.NO_CHANGE


def linear(
    env: Env, env_ids: torch.Tensor, old_value: Any, start: Any, end: Any, num_steps: Natural, first_step: Natural = 0
) -> Any:
    """Interpolate a setting from ``start`` at the control step ``first_step`` to ``end``, ``num_steps`` steps later."""
    del env_ids, old_value
    past = env.common_step_counter - first_step
    return _between(start, end, min(max(past / num_steps, 0.0), 1.0) if num_steps else float(past > 0))


def _between(start: Any, end: Any, share: float) -> Any:
    if isinstance(start, Mapping):
        return {key: _between(value, end[key], share) for key, value in start.items()}
    if isinstance(start, (list, tuple)):
        return [_between(a, b, share) for a, b in zip(start, end, strict=True)]
    return start + (end - start) * share
