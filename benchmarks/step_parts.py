"""Measure the time of each part of an environment step."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any

from wheelleg_exp.env import ManagerBasedRLEnv


def time_parts(env: ManagerBasedRLEnv, now: Callable[[], float]) -> dict[str, float]:
    """Measure the parts of every following step of an environment.

    Args:
        env: the environment; its parts stay wrapped.
        now: a clock, s.

    Returns:
        The seconds spent in each part so far; every environment step increases the values.
    """
    spent: dict[str, float] = defaultdict(float)

    def timed(owner: Any, name: str, label: str) -> None:
        function: Callable[..., Any] = getattr(owner, name)

        def wrapper(*args: Any, **kwargs: Any) -> Any:
            start = now()
            try:
                return function(*args, **kwargs)
            finally:
                spent[label] += now() - start

        setattr(owner, name, wrapper)

    timed(env.scene.sim, "step", "physics")
    timed(env.scene, "update", "sensors")
    timed(env.scene, "write_data_to_sim", "actuators and wrenches")
    timed(env.action_manager, "process_action", "actions")
    timed(env.action_manager, "apply_action", "actions")
    timed(env.termination_manager, "compute", "terminations")
    timed(env.reward_manager, "compute", "rewards")
    timed(env, "_reset_idx", "resets")
    timed(env.command_manager, "compute", "commands")
    timed(env.event_manager, "apply_interval", "interval events")
    timed(env.scene, "show_written", "what was written")
    timed(env.observation_manager, "compute", "observations")
    return spent
