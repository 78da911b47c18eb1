"""Collect the reports of a rollout: episode returns and lengths, manager logs, failures, and means over steps."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Mapping
from typing import Any

import torch

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.managers.non_finite import ACTIONS, POLICY
from wheelleg_exp.rl.determinism import one_thread

SCALAR = "Diagnostics/non_finite/"  # ``SCALAR`` is the name prefix of scalars that count episodes with NaN or inf.


class FailureCount:
    """Counts episodes that ended because a number was NaN or inf: a few are accepted, many are an error.

    Each training iteration may have up to max(1, ``max_non_finite * num_envs``) episodes with NaN or inf.
    """

    def __init__(self, num_envs: int, max_non_finite: float) -> None:
        self._num_envs = num_envs
        self._allowed = max(1, int(max_non_finite * num_envs))
        self._evidence: Mapping[str, torch.Tensor] = {}
        self.episodes = 0
        self.by_key: Counter[str] = Counter()

    def take(self, extras: Mapping[str, Any]) -> None:
        """Count the episodes with NaN or inf that an environment step reports."""
        found = extras.get("non_finite")
        if found is not None:
            self.episodes += len(found["keys"])
            for keys in found["keys"].values():
                self.by_key.update(keys)
            self._evidence = self._evidence or found["evidence"]

    def require_few(self, when: str) -> None:
        """Raise SimulationFailure if too many episodes had NaN or inf; name the config key that failed most often."""
        if self.episodes > self._allowed:
            key, count = self.by_key.most_common(1)[0]
            others = f" ({len(self.by_key) - 1} more keys others)" if len(self.by_key) > 1 else ""
            message = f"numbers of this key were not finite and ended {count} episodes{others} {when}"
            if key == ACTIONS:
                key, message = POLICY, f"the policy has diverged: its actions ended {count} episodes{others} {when}"
            expected = f"at most {self._allowed} with {self._num_envs} environments (agent.max_non_finite)"
            raise SimulationFailure(message, key=key, expected=expected, evidence=self._evidence)


def logged(scalars: Mapping[str, float]) -> dict[str, int]:
    """Return how many episodes of an iteration had NaN or inf, by the config key of the failed term."""
    return {key.removeprefix(SCALAR): int(n) for key, n in scalars.items() if key.startswith(SCALAR)}


_EPISODES = 100  # Mean reward and mean episode length cover the last 100 finished episodes, as in rsl_rl.


class EpisodeLog:
    """Collects rewards and manager logs of all steps, and averages them to scalars such as ``Train/mean_reward``."""

    def __init__(self, num_envs: int, device: torch.device | str = "cpu") -> None:
        self._return = torch.zeros(num_envs, device=device)
        self._length = torch.zeros(num_envs, device=device)
        self._ended: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]] = []
        self._returns: deque[float] = deque(maxlen=_EPISODES)
        self._lengths: deque[float] = deque(maxlen=_EPISODES)
        self._values: defaultdict[str, list[float]] = defaultdict(list)
        self._pending: list[Mapping[str, torch.Tensor | float]] = []
        self._non_finite: Counter[str] = Counter()

    def step(self, rewards: torch.Tensor, dones: torch.Tensor, extras: dict[str, Any]) -> None:
        """Add the rewards (N,), dones (N,), and extras of one environment step to the log."""
        self._return += rewards
        self._length += 1
        for keys in extras.get("non_finite", {"keys": {}})["keys"].values():
            self._non_finite.update(keys)
        if extras.get("log_is_fresh"):
            self._pending.append(extras["log"])
            done = dones > 0
            self._ended.append((done, self._return.clone(), self._length.clone()))
            self._return.masked_fill_(done, 0.0)
            self._length.masked_fill_(done, 0.0)

    def _take_pending(self) -> None:
        for log in self._pending:
            for key, value in _numbers(log).items():
                self._values[key].append(value)
        self._pending.clear()
        for done, returns, lengths in self._ended:
            self._returns.extend(returns[done].tolist())
            self._lengths.extend(lengths[done].tolist())
        self._ended.clear()

    def collect(self) -> dict[str, float]:
        """Return means of the newly logged values, and the mean return and length of the last 100 episodes."""
        self._take_pending()
        scalars = {key: sum(values) / len(values) for key, values in self._values.items()}
        self._values.clear()
        scalars |= {f"{SCALAR}{key}": float(n) for key, n in self._non_finite.items()}
        self._non_finite.clear()
        if self._returns:
            scalars["Train/mean_reward"] = sum(self._returns) / len(self._returns)
            scalars["Train/mean_episode_length"] = sum(self._lengths) / len(self._lengths)
        return scalars

    def state_dict(self) -> dict[str, object]:
        """Return all collected episode returns, lengths, and log values, which a checkpoint saves."""
        self._take_pending()
        ended = {"returns": list(self._returns), "lengths": list(self._lengths)}
        values = {key: list(values) for key, values in self._values.items()}
        running = {"return": self._return.clone(), "length": self._length.clone()}
        return {**running, **ended, "values": values, "non_finite": dict(self._non_finite)}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self._return.copy_(saved["return"])
        self._length.copy_(saved["length"])
        self._returns = deque(saved["returns"], maxlen=_EPISODES)
        self._lengths = deque(saved["lengths"], maxlen=_EPISODES)
        self._values = defaultdict(list, {key: list(values) for key, values in saved["values"].items()})
        self._pending.clear()
        self._ended.clear()
        self._non_finite = Counter(saved["non_finite"])


def _numbers(log: Mapping[str, torch.Tensor | float]) -> dict[str, float]:
    """Return a log as Python numbers; tensors of equal dtype are copied together, because a copy waits for the GPU."""
    kinds: defaultdict[tuple[torch.dtype, torch.device], dict[str, torch.Tensor]] = defaultdict(dict)
    for key, value in log.items():
        if isinstance(value, torch.Tensor):
            kinds[value.dtype, value.device][key] = value.reshape(())
    found = dict(log)
    for tensors in kinds.values():
        found.update(zip(tensors, torch.stack(list(tensors.values())).tolist(), strict=True))
    return {key: float(value) for key, value in found.items()}


class StepMeans:
    """Sums rewards, terminations, and command errors of each control step, and returns means once per iteration.

    The managers log only finished episodes, so robots that fall early count more often than robots that stand.
    """

    def __init__(self, env: ManagerBasedRLEnv) -> None:
        self._env = env
        self._sums: dict[tuple[str, tuple[str, ...]], torch.Tensor] = {}
        self._steps = 0

    def take(self) -> None:
        """Add rewards, terminations, and command errors of the last step to the sums of the current iteration."""
        rewards, terminations = self._env.reward_manager, self._env.termination_manager
        commands = self._env.command_manager
        rows = {("Rewards_per_step", tuple(rewards.active_terms)): rewards.step_reward}
        rows["Terminations_per_step", tuple(terminations.active_terms)] = terminations.fired
        for command, errors in commands.step_errors.items():
            names = tuple(f"{command}/{name}" for name in commands.get_term(command).metric_names)
            rows["Metrics_per_step", names] = errors
        for key, values in rows.items():  # ``key`` has the prefix of the logged keys, and a name for each row (N,).
            self._sums[key] = self._sums[key].add_(values) if key in self._sums else values.double()
        self._steps += 1

    def collect(self) -> dict[str, float]:
        """Return the means of rewards, terminations, and errors since the last ``collect``, and reset the sums to 0."""
        scalars: dict[str, float] = {}
        with one_thread():
            for (head, names), sums in self._sums.items():
                values = sums.mean(dim=1).tolist()
                scalars |= {f"{head}/{n}": value / self._steps for n, value in zip(names, values, strict=True)}
        self._sums.clear()
        self._steps = 0
        return scalars
