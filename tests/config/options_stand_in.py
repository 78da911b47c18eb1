"""Small dataclasses that replace the dataclasses of the config sections in tests."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from wheelleg_exp.config import schema
from wheelleg_exp.constraints import Parameters, Positive
from wheelleg_exp.sim.options import EnvOptions


@dataclass(frozen=True)
class SimOptions:
    dt: Positive
    solver: Literal["newton", "cg"]


@dataclass(frozen=True)
class SceneOptions:
    spacing: float
    sensors: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class RobotOptions:
    asset: str
    joint_pos: dict[str, float] = field(default_factory=dict)
    order: list[str] | None = None
    length: float = 0.0


@dataclass(frozen=True)
class RunOptions:
    root: str
    name: str | None


@dataclass(frozen=True)
class SmallEnv(EnvOptions):
    sim: SimOptions
    scene: SceneOptions
    robot: RobotOptions


@dataclass(frozen=True)
class Experiment(schema.Experiment):
    env: SmallEnv
    recording: Parameters
    run: RunOptions
