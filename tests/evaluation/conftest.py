"""Fixtures for tests of evaluations: the stock task, short protocols, and scripted policies."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from wheelleg_exp.build import prepare_asset
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.evaluation.lqr_balancer import Reference
from wheelleg_exp.evaluation.protocol_options import Protocol
from wheelleg_exp.terms.config_sections import read_section


@pytest.fixture(scope="session")
def task() -> tuple[dict[str, Any], Path]:
    config = compose(["task=stand"]).config
    return config["env"], prepare_asset(config).output


def protocol(name: str, *words: str) -> dict[str, Any]:
    """Return a composed protocol with few bootstrap resamples, as plain data."""
    return compose([f"protocol={name}", "protocol.resamples=20", *words], primary="evaluate").config["protocol"]


def read_protocol(name: str, *words: str) -> Protocol:
    return read_section(Protocol, protocol(name, *words), "protocol")


def words(test: str, **settings: Any) -> tuple[str, ...]:
    """Return overrides of the settings of one test of a protocol."""
    return tuple(f"protocol.{test}.{name}={value}" for name, value in settings.items())


def zeros(env):
    return lambda observations: torch.zeros(env.num_envs, env.action_manager.total_action_dim)


def noise(env):
    draws = torch.Generator().manual_seed(1)
    return lambda observations: 2 * torch.rand(env.num_envs, env.action_manager.total_action_dim, generator=draws) - 1


def not_numbers(env):
    return lambda observations: torch.full((env.num_envs, env.action_manager.total_action_dim), torch.nan)


class Told:
    def __init__(self, term: Any, factor: float) -> None:
        self._term, self._factor = term, factor

    @property
    def command(self) -> torch.Tensor:
        return self._factor * self._term.command


def balancer(factor: float):
    """Return a function that makes a reference controller whose command is multiplied by ``factor``."""

    def make(env):
        policy = Reference(env)
        policy._command = Told(policy._command, factor)
        return policy

    return make


def stub_env(**data: Any) -> SimpleNamespace:
    """Return an object with the attributes of an environment that the effort meter reads."""
    robot = SimpleNamespace(data=SimpleNamespace(**data))
    return SimpleNamespace(device=torch.device("cpu"), scene=SimpleNamespace(robot=robot, sensors={}))
