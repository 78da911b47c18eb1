"""No command."""

from __future__ import annotations

import torch

from wheelleg_exp.managers import CommandTerm, Env


class NullCommand(CommandTerm):
    """Asks for nothing, where a command is expected: its command has no components.

    Args:
        env: the environment.
        generator: the term's random stream, of which nothing is drawn.
    """

    def __init__(self, env: Env, generator: torch.Generator) -> None:
        super().__init__(env, (1.0, 1.0), (), generator)
        self._nothing = (torch.zeros(env.num_envs, 0, device=env.device),)

    @property
    def command(self) -> torch.Tensor:
        """Nothing, (N, 0)."""
        return self._nothing[0]

    def errors(self) -> torch.Tensor:
        """Return no errors, (0, N)."""
        return self.error_sums

    def draw(self, env_ids: torch.Tensor) -> None:
        """Draw nothing."""

    def compute(self, dt: float) -> torch.Tensor:
        """Do nothing, and return no errors, (0, N)."""
        del dt
        return self.errors()

    def finish_episode(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Do nothing, and log nothing."""
        del env_ids
        return {}
