"""What may stand under ``env.sim``, ``env.scene`` and ``env.robot``; no defaults, so every number is in the config."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal


@dataclass(frozen=True)
class SimOptions:
    """The solver (``env.sim``), in MuJoCo's terms.

    Attributes:
        dt: physics time step, s.
        gravity: world gravity, m/s^2.
        integrator: MuJoCo integrator.
        solver: constraint solver.
        cone: friction cone.
        iterations: most solver iterations of one step.
        ls_iterations: most line-search iterations of one solver iteration.
        tolerance: solver tolerance at which iterations end early.
        impratio: frictional to normal constraint impedance.
        nthread: physics threads; 0 takes one for each core that the process may use. It never changes a result.
    """

    dt: float = field(metadata={"above": 0.0})
    gravity: list[float] = field(metadata={"length": 3})
    integrator: Literal["euler", "rk4", "implicit", "implicitfast"]
    solver: Literal["pgs", "cg", "newton"]
    cone: Literal["pyramidal", "elliptic"]
    iterations: int = field(metadata={"minimum": 1})
    ls_iterations: int = field(metadata={"minimum": 1})
    tolerance: float = field(metadata={"minimum": 0.0})
    impratio: float = field(metadata={"above": 0.0})
    nthread: int = field(metadata={"minimum": 0})


@dataclass(frozen=True)
class Ground:
    """The ground plane's material (``env.scene.ground``); restitution has no counterpart in MuJoCo."""

    static_friction: float = field(metadata={"minimum": 0.0})
    dynamic_friction: float = field(metadata={"minimum": 0.0})
    restitution: float = field(metadata={"minimum": 0.0})


@dataclass(frozen=True)
class SceneOptions:
    """The scene (``env.scene``).

    Attributes:
        env_spacing: distance between the origins of neighbouring environments, m.
        ground: the ground plane's material.
        sensors: one node a sensor, by name.
    """

    env_spacing: float = field(metadata={"minimum": 0.0})
    ground: Ground
    sensors: dict[str, Any]


@dataclass(frozen=True)
class InitState:
    """The state that resets start from (``env.robot.init_state``).

    Attributes:
        pos: root link, m.
        rot: root link, (w, x, y, z).
        joint_pos: rad, by joint expression; others are 0.
        joint_vel: rad/s, by joint expression; others are 0.
    """

    pos: list[float] = field(metadata={"length": 3})
    rot: list[float] = field(metadata={"length": 4, "nonzero": 1})
    joint_pos: dict[str, float]
    joint_vel: dict[str, float]


@dataclass(frozen=True)
class RobotOptions:
    """The robot (``env.robot``).

    Attributes:
        profile: name of this set of numbers; results carry it.
        asset: the robot's USD file, relative to an asset folder.
        base: whether the base is free.
        init_state: the state that resets start from.
        joint_order: joint names in the order that terms see; null is breadth-first, as in PhysX.
        soft_joint_pos_limit_factor: share of the joint range that the soft limits keep.
        friction_source: which of a material's two coefficients MuJoCo's single one is taken from.
        actuators: one node an actuator group, by name.
        self_collisions: whether the robot's own bodies may touch; null is what the asset says.
    """

    profile: str
    asset: str
    base: Literal["auto", "floating", "fixed"]
    init_state: InitState
    joint_order: list[str] | None
    soft_joint_pos_limit_factor: float = field(metadata={"above": 0.0, "maximum": 1.0})
    friction_source: Literal["static", "dynamic"]
    actuators: dict[str, Any]
    self_collisions: bool | None = None
