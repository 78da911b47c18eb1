"""What tests of evaluations share: the stock task, short protocols, scripted policies."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from wheelleg_exp.build import prepare_asset
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.evaluation.lqr_balancer import Reference


@pytest.fixture(scope="session")
def task() -> tuple[dict[str, Any], Path]:
    config = compose(["task=stand"]).config
    return config["env"], prepare_asset(config).output


def protocol(name: str, *words: str) -> dict[str, Any]:
    """Return a composed protocol with few resamples, plain."""
    return compose([f"protocol={name}", "protocol.resamples=20", *words], primary="evaluate").config["protocol"]


def zeros(env):
    return lambda observations: torch.zeros(env.num_envs, env.action_manager.total_action_dim)


def noise(env):
    draws = torch.Generator().manual_seed(1)
    return lambda observations: 2 * torch.rand(env.num_envs, env.action_manager.total_action_dim, generator=draws) - 1


def not_numbers(env):
    return lambda observations: torch.full((env.num_envs, env.action_manager.total_action_dim), torch.nan)


class Told:
    """A command term of which somebody hears a multiple."""

    def __init__(self, term: Any, factor: float) -> None:
        self._term, self._factor = term, factor

    @property
    def command(self) -> torch.Tensor:
        return self._factor * self._term.command


def balancer(factor: float):
    """Return what makes the reference controller, which hears a multiple of the command: 0 never moves, -1 is wrong."""

    def make(env):
        policy = Reference(env)
        policy._command = Told(policy._command, factor)
        return policy

    return make


def stub_env(**data: Any) -> SimpleNamespace:
    """Return as much of an environment as the effort meter reads."""
    robot = SimpleNamespace(data=SimpleNamespace(**data))
    return SimpleNamespace(device=torch.device("cpu"), scene=SimpleNamespace(robot=robot, sensors={}))
