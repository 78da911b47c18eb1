"""The parts of an environment's step that are CUDA graphs: around the engine's own, and whatever needs no host."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Any

import torch

from wheelleg_exp.env.captured import Captured, Counting
from wheelleg_exp.env.recorders import CudaGraph
from wheelleg_exp.managers.non_finite import note_observations

_MOST_COUNTS = 128  # of environments that end together, each with a graph of its own
# A number that came up so often in so many resets has one: recording costs as much as eight resets without.
_OFTEN, _RECENT = 3, 1024


class CapturedStep:
    """The parts of an environment's step from its actions to its rewards: CUDA graphs around the engine's own.

    The engine's graphs end early where all simulations have converged, which a capture of torch's cannot hold.

    Args:
        env: the environment, whole but for this.
    """

    def __init__(self, env: Any) -> None:
        self._env = env

        def part(work: Callable[[], Any]) -> Captured:
            invalidate = env.scene.robot.data.invalidate
            return Captured(work, [env], CudaGraph, invalidate, env.streams.all, memory=env._captured_memory)

        self.act = part(lambda: env._act(env._action))
        self.act_again = part(env._act_again)
        self.judge = part(lambda: env._judge(None))
        self.reward = part(lambda: env._work_out_rewards(None))

    def __call__(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return which environments have ended, and whose physics has failed, (N,) bool."""
        env = self._env
        self.act()
        for substep in range(env.decimation):
            if substep:
                self.act_again()
            env.scene.sim.step()
        found: tuple[torch.Tensor, torch.Tensor] = self.judge()
        return found

    def rewards(self) -> torch.Tensor:
        """Return whose rewards are not finite, (N,) bool."""
        self._env.reward_manager.take_present_weights()
        failed: torch.Tensor = self.reward()
        return failed


def captured_look(env: Any) -> Captured:
    """Return the observations of an environment, and the note whether they are numbers, as CUDA graphs.

    Args:
        env: the environment, whole but for this.
    """
    manager = env.observation_manager
    manager.in_masks = True

    def work() -> Any:
        found = manager.compute()
        if env.autoreset == "same_step":  # else those that have failed still show it
            note_observations(env)
        return found

    invalidate = env.scene.robot.data.invalidate
    return Captured(work, [env], CudaGraph, invalidate, env.streams.all, memory=env._captured_memory)


def captured_commands(env: Any) -> Captured:
    """Return the step of commands none of which is drawn, and of events' timers, as a CUDA graph.

    Args:
        env: the environment, whole but for this.
    """

    def work() -> None:
        env.command_manager.compute(env.step_dt, draws=False)
        env.event_manager.advance_timers(env.step_dt)

    invalidate = env.scene.robot.data.invalidate
    return Captured(work, [env], CudaGraph, invalidate, env.streams.all, memory=env._captured_memory)


class CapturedReset:
    """Resets of some environments as CUDA graphs: one for each number of them that comes up again and again.

    Rows are chosen by indices whose number is a graph's own. Numbers that are rare are reset kernel by kernel. While a
    policy learns, fewer and fewer environments end together: numbers that no longer come up make room for others.

    Args:
        env: the environment, whole but for this.
    """

    def __init__(self, env: Any) -> None:
        self._env = env
        self._recent: deque[int] = deque()
        self._seen: Counter[int] = Counter()
        self._parts: dict[int, Captured] = {}
        self._ids: dict[int, torch.Tensor] = {}
        self._names: list[str] = []
        self._first: Captured | None = None
        self._works = True

    @property
    def counts(self) -> int:
        """How many numbers of environments that end together have a graph, or are about to."""
        return len(self._parts)

    def __call__(self, env_ids: torch.Tensor) -> dict[str, Any]:
        """Reset ``env_ids``, but for curricula and recorders; return what is logged."""
        count = len(env_ids)
        self._note(count)
        if not self._works or not self._is_worth(count):
            return self._env._reset_rows(env_ids, host=False)
        part = self._parts.get(count) or self._part(count)
        ids = self._ids[count]
        ids.copy_(env_ids)
        self._env.command_manager.take_present_settings()
        try:
            values = part()
            self._works = not part._fails
        except Counting as told:  # a term counts its resets
            if told.found is None:  # this one is not done
                raise
            self._works, values = False, told.found
        self._env.scene.robot.mark_written(ids)
        return dict(zip(self._names, values.clone().unbind(), strict=True))

    def _note(self, count: int) -> None:
        """Note a number of environments, and forget one that was noted long ago."""
        self._recent.append(count)
        self._seen[count] += 1
        if len(self._recent) > _RECENT:
            self._seen[self._recent.popleft()] -= 1

    def _is_worth(self, count: int) -> bool:
        """Return whether a number of environments has a graph, or comes up so often that it shall have one."""
        if count in self._parts or self._seen[count] < _OFTEN:
            return count in self._parts
        if len(self._parts) < _MOST_COUNTS:
            return True
        return self._seen[count] >= 2 * self._seen[self._rarest()]  # else many that are as rare would take turns

    def _rarest(self) -> int:
        return min(self._parts, key=self._seen.__getitem__)

    def _part(self, count: int) -> Captured:
        if len(self._parts) >= _MOST_COUNTS:
            rarest = self._rarest()
            del self._parts[rarest], self._ids[rarest]
        ids = self._ids[count] = torch.zeros(count, dtype=torch.long, device=self._env.device)
        env = self._env
        part = Captured(
            lambda: self._reset(ids),
            [env],
            CudaGraph,
            env.scene.robot.data.invalidate,
            env.streams.all,
            self._first,
            env._captured_memory,
        )
        self._first = self._first or part
        self._parts[count] = part
        return part

    def _reset(self, ids: torch.Tensor) -> torch.Tensor:
        """Return what is logged in one tensor, in the order of ``_names``."""
        log = self._env._reset_rows(ids, host=False)
        self._names = list(log)
        if not all(isinstance(value, torch.Tensor) for value in log.values()):
            raise RuntimeError("what is logged of a reset is no tensor")
        return torch.stack([value.reshape(()) for value in log.values()])
