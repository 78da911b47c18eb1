"""Terms that write down when they are called, and terms with values set by a test."""

from __future__ import annotations

from typing import Any

import torch

from wheelleg_exp.managers import ActionTerm, CommandTerm, Env, TermBase

LOG: list[Any] = []
VALUES: dict[str, Any] = {}

HERE = "managers.spies."


def clear() -> None:
    """Forget what was written down and set."""
    LOG.clear()
    VALUES.clear()


# ---- functions with a value set by the test ----


def value(env: Env, key: str) -> torch.Tensor:
    """Return ``VALUES[key]``, spread over the environments when it is a number."""
    found = VALUES[key]
    if callable(found):
        found = found(env)
    return found if isinstance(found, torch.Tensor) else torch.full((env.num_envs,), float(found))


def column(env: Env, key: str) -> torch.Tensor:
    """Return ``VALUES[key]`` as an observation of width 1."""
    return value(env, key).unsqueeze(1)


def flag(env: Env, key: str) -> torch.Tensor:
    """Return ``VALUES[key]`` as (N,) bool."""
    return value(env, key).bool()


def noted(env: Env, env_ids: torch.Tensor | None, key: str = "event") -> None:
    """Note the step, and the environments that an event was called for."""
    ids = None if env_ids is None else env_ids.tolist()
    LOG.append((key, env.common_step_counter, ids))


def draw_once(env: Env, env_ids: torch.Tensor | None, generator: torch.Generator, key: str) -> None:
    """Note one draw of the term's stream."""
    LOG.append((key, float(torch.rand(1, generator=generator))))


def drawing_observation(env: Env, generator: torch.Generator) -> torch.Tensor:
    """Return draws of the term's own stream."""
    return torch.rand(env.num_envs, 1, generator=generator)


def state_of(env: Env, env_ids: torch.Tensor, key: str) -> Any:
    """Return ``VALUES[key]`` as a curriculum's state."""
    return VALUES[key]


class CountingObservation(TermBase):
    """How often it was called since the reset of each environment."""

    def __init__(self, env: Env) -> None:
        self.count = torch.zeros(env.num_envs, 1)

    def __call__(self, env: Env) -> torch.Tensor:
        self.count += 1
        return self.count.clone()

    def reset(self, env_ids: torch.Tensor) -> None:
        self.count[env_ids] = 0.0


# ---- spies that write down the order of calls ----


class Spy(TermBase):
    """Notes its construction, calls and resets."""

    kind = "?"

    def __init__(self, env: Env) -> None:
        self._env = env
        LOG.append(f"{self.kind} made")

    def reset(self, env_ids: torch.Tensor) -> None:
        LOG.append(f"{self.kind} reset {env_ids.tolist()}")


class SpyObservation(Spy):
    kind = "observation"

    def __call__(self, env: Env) -> torch.Tensor:
        LOG.append("observation")
        return torch.zeros(env.num_envs, 1)


class SpyTermination(Spy):
    kind = "termination"

    def __call__(self, env: Env) -> torch.Tensor:
        LOG.append("termination")
        return VALUES.get("done", torch.zeros(env.num_envs)).bool()


class SpyReward(Spy):
    kind = "reward"

    def __call__(self, env: Env) -> torch.Tensor:
        LOG.append("reward")
        return torch.zeros(env.num_envs)


class SpyCurriculum(Spy):
    kind = "curriculum"

    def __call__(self, env: Env, env_ids: torch.Tensor) -> None:
        LOG.append(f"curriculum {env_ids.tolist()} at length {env.episode_length_buf[env_ids].tolist()}")


class SpyEvent(Spy):
    kind = "event"

    def __init__(self, env: Env, name: str) -> None:
        self.kind = f"event {name}"
        super().__init__(env)

    def __call__(self, env: Env, env_ids: torch.Tensor | None) -> None:
        LOG.append(f"{self.kind} {None if env_ids is None else env_ids.tolist()}")


def spy_prestartup(env: Env, env_ids: torch.Tensor | None) -> None:
    LOG.append(f"event prestartup {env_ids}, compiled: {hasattr(env.scene, 'sim')}")


class SpyCommand(CommandTerm):
    def __init__(self, env: Env, generator: torch.Generator) -> None:
        super().__init__(env, (100.0, 100.0), (), generator)
        LOG.append("command made")

    @property
    def command(self) -> torch.Tensor:
        return torch.zeros(self._env.num_envs, 1)

    def errors(self) -> torch.Tensor:
        LOG.append("command compute")
        return torch.zeros(0, self._env.num_envs)

    def draw(self, env_ids: torch.Tensor) -> None:
        LOG.append(f"command draw {env_ids.tolist()}")


class SpyAction(ActionTerm):
    def __init__(self, env: Env) -> None:
        self.action_dim = 1
        self.raw_actions = torch.zeros(env.num_envs, 1)
        self.processed_actions = torch.zeros(env.num_envs, 1)
        LOG.append("action made")

    def process_actions(self, actions: torch.Tensor) -> None:
        LOG.append("action process")

    def apply_actions(self) -> None:
        LOG.append("action apply")

    def reset(self, env_ids: torch.Tensor) -> None:
        LOG.append(f"action reset {env_ids.tolist()}")
