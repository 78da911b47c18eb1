"""What may stand under ``env.sim``, ``env.scene`` and ``env.robot``; no defaults, so every number is in the config."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated, Any, Literal

from wheelleg_exp.constraints import (
    Above,
    AtMost,
    Broken,
    Count,
    Length,
    Natural,
    Node,
    NonNegative,
    NotAllZero,
    Positive,
    relation,
)

GPU_EXTRA = "pip install 'wheelleg_exp[gpu]'"
_GPU_PACKAGES = ("warp", "mujoco_warp")


def engine_fits(given: Mapping[str, Any]) -> Iterator[Broken]:
    """Hold the engine against its device and its solver, and against what is installed."""
    device = given["device"]
    if given["engine"] == "mujoco":
        if device != "cpu":
            yield Broken(
                "device", f"the engine 'mujoco' runs on the CPU, and not on {device!r}", "cpu, or engine: warp"
            )
        return
    if not re.fullmatch(r"cpu|cuda(:\d+)?", str(device)):
        yield Broken("device", f"{device!r} is no device of the engine 'warp'", "cpu, or cuda:0 and so on")
    if given.get("deterministic") and device != "cpu":
        told = "the engine 'warp' does not repeat to the bit on a GPU, nor with mujoco-warp's own opt.deterministic"
        yield Broken("deterministic", told, "false, or engine: mujoco, which repeats (docs/gpu.md)")
    if given["solver"] == "pgs":
        yield Broken("solver", "the engine 'warp' has no solver 'pgs'", "newton or cg")
    for name in _GPU_PACKAGES:
        if find_spec(name) is None:
            told = f"the engine 'warp' needs the package {name}, which is not installed"
            yield Broken("engine", told, f"mujoco, or: {GPU_EXTRA}")
            return


@relation(engine_fits)
@dataclass(frozen=True)
class SimOptions:
    """The solver (``env.sim``), in MuJoCo's terms.

    Attributes:
        engine: what simulates: ``mujoco`` is MuJoCo's batch on the CPU, which repeats to the bit; ``warp`` is
            mujoco-warp, in single precision, on a GPU, or on the CPU for tests.
        device: where the engine's tensors are: ``cpu``, or ``cuda:0`` and so on for the engine ``warp``.
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
        nconmax: engine ``warp``: contacts that there is room for, a simulation on average, since all share one room; 0
            works it out of the model. More than that is an error.
        njmax: engine ``warp``: constraint rows that each simulation has room for; 0 works it out of the model and
            ``nconmax``. More than that is an error.
        graph: engine ``warp`` on a GPU: whether a physics step is launched as one CUDA graph, which changes no number.
        graph_step: engine ``warp`` on a GPU: whether what torch does from the actions to the rewards, for resets,
            commands and observations, is launched as CUDA graphs. docs/gpu.md says what that asks of terms.
        deterministic: whether nothing may simulate that does not repeat to the bit: ``warp`` on a GPU is refused.
    """

    engine: Literal["mujoco", "warp"]
    device: str
    dt: Positive
    gravity: Annotated[Sequence[float], Length(3)]
    integrator: Literal["euler", "rk4", "implicit", "implicitfast"]
    solver: Literal["pgs", "cg", "newton"]
    cone: Literal["pyramidal", "elliptic"]
    iterations: Count
    ls_iterations: Count
    tolerance: NonNegative
    impratio: Positive
    nthread: Natural
    nconmax: Natural = 0
    njmax: Natural = 0
    graph: bool = True
    graph_step: bool = False
    deterministic: bool = False


@dataclass(frozen=True)
class SceneOptions:
    """The scene (``env.scene``).

    Attributes:
        env_spacing: distance between the origins of neighbouring environments, m.
        terrain: the node of the ground.
        sensors: one node a sensor, by name.
    """

    env_spacing: NonNegative
    terrain: Node
    sensors: dict[str, Node | None]


@dataclass(frozen=True)
class InitState:
    """The state that resets start from (``env.robot.init_state``).

    Attributes:
        pos: root link, m.
        rot: root link, (w, x, y, z).
        joint_pos: rad, by joint expression; others are 0.
        joint_vel: rad/s, by joint expression; others are 0.
    """

    pos: Annotated[Sequence[float], Length(3)]
    rot: Annotated[Sequence[float], Length(4), NotAllZero()]
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
        root_frame: the root link's frame in the file's, (w, x, y, z), for a file that has not x forwards and z upwards;
            null is the file's own.
    """

    profile: str
    asset: str
    base: Literal["auto", "floating", "fixed"]
    init_state: InitState
    joint_order: list[str] | None
    soft_joint_pos_limit_factor: Annotated[float, Above(0), AtMost(1)]
    friction_source: Literal["static", "dynamic"]
    actuators: dict[str, Node | None]
    self_collisions: bool | None = None
    root_frame: Annotated[Sequence[float], Length(4), NotAllZero()] | None = None
