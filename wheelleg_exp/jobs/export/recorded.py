"""Episodes of training's own simulation: readings in, observations, actions and joint targets out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.jobs.export.readings import reading
from wheelleg_exp.managers.finite import require_finite_actions
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.user_code import ending_as

READING = "reading:"


@ending_as(SimulationFailure)
@torch.inference_mode()
def recorded_episodes(
    adapter: RslRlVecEnv,
    policy: Callable[[Any], torch.Tensor],
    trained: Callable[[Any], torch.Tensor],
    groups: Sequence[str],
    names: Sequence[str],
    clip_actions: float | None,
    steps: int,
) -> dict[str, np.ndarray]:
    """Return what a policy saw and did in the first simulation, float32, a row a control step.

    Args:
        adapter: the environment.
        policy: the mean action of observations, which is applied.
        trained: the same in float32, as training computes it.
        groups: the observation groups that it sees.
        names: the readings to keep.
        clip_actions: bound of the raw actions, or None.
        steps: control steps.

    Returns:
        ``reset`` (T,) bool: an episode begins; ``reading:<name>`` (T, width); ``observations`` (T, O); ``actions``
        (T, A), clipped, and ``actions_float32``, of ``trained``; ``targets`` (T, 3, J): positions, velocities, efforts
        of all joints.
    """
    env, begins = adapter.env, True
    rows: dict[str, list[np.ndarray]] = {}
    for _ in range(steps):
        seen = adapter.get_observations()
        actions, rounded = policy(seen), trained(seen)
        require_finite_actions(env, actions)
        if clip_actions is not None:
            actions, rounded = (found.clamp(-clip_actions, clip_actions) for found in (actions, rounded))
        row = {READING + name: reading(name).of(env) for name in names}
        row |= {"observations": torch.cat([seen[group] for group in groups], dim=1), "actions": actions}
        row |= {"actions_float32": rounded, "targets": _targets(adapter, actions)}
        for name, value in row.items():
            rows.setdefault(name, []).append(value[0].numpy().astype(np.float32))
        rows.setdefault("reset", []).append(np.bool_(begins))  # type: ignore[arg-type]
        _, _, dones, _ = adapter.step(actions)
        begins = bool(dones[0])
        if begins:
            env.reset()  # as a deployer begins: nothing has happened before the first reading
    return {name: np.stack(values) for name, values in rows.items()}


def _targets(adapter: RslRlVecEnv, actions: torch.Tensor) -> torch.Tensor:
    """Return the joint targets (N, 3, J) that actions set in the first physics step, and change nothing.

    Positions are clipped to the joints' limits, as a runner clips them; training does not.
    """
    env = adapter.env
    manager, kept = env.action_manager, env.action_manager.state_dict()
    manager.process_action(actions)
    manager.apply_action()
    targets = env.scene.robot.targets
    low, high = env.scene.robot.layout.joint_pos_limits.unbind(dim=1)
    found = torch.stack((targets.pos.clamp(low, high), targets.vel, targets.effort), dim=1)
    manager.load_state_dict(kept)
    return found
