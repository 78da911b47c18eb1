"""A task's own velocity command, held from outside: the term stays, with all that it keeps beside the command."""

from __future__ import annotations

import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers import Env
from wheelleg_exp.mdp.commands import UniformVelocityCommand


class HeldCommand:
    """Gives a velocity command term what it is to ask for, in the place of its draws.

    Args:
        env: the environment.
        name: the term.

    Raises:
        ConfigError: the term is no velocity command.
    """

    def __init__(self, env: Env, name: str) -> None:
        term = env.command_manager.get_term(name)
        if not isinstance(term, UniformVelocityCommand):
            raise ConfigError(
                f"'{name}' is no velocity command",
                key=f"env.commands.{name}",
                expected="a command of wheelleg_exp.mdp.commands.UniformVelocityCommand, or of a class of it",
            )
        self._term = term
        self._held = torch.zeros(env.num_envs, 3, device=env.device)
        setattr(term, "draw", self._draw)  # noqa: B010  # this one object alone draws no more

    @property
    def command(self) -> torch.Tensor:
        """What is asked for now, v_x, v_y in m/s and w_z in rad/s, (N, 3), however slowly the term gets there."""
        return self._term.asked

    def hold(self, command: torch.Tensor) -> None:
        """Ask for velocities (N, 3) from now on, through resets too."""
        self._held.copy_(command)
        self._draw(torch.arange(len(command), device=command.device))

    def _draw(self, env_ids: torch.Tensor) -> None:
        self._term.asked[env_ids] = self._held[env_ids]
        self._term.is_standing_env[env_ids] = (self._held[env_ids] == 0.0).all(dim=1)
