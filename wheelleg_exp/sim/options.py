"""The dataclasses of the config sections ``env``, ``env.sim``, ``env.scene`` and ``env.robot``."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Annotated, Literal

from wheelleg_exp import constraints
from wheelleg_exp.constraints import Broken, Count, Length, Natural, Node, NotAllZero, Positive, Terms, relation
from wheelleg_exp.terms.config_sections import Dataset, ObservationGroup, Realism, read_section
from wheelleg_exp.terms.term_binding import TARGET, drop_removed


@dataclass(frozen=True)
class EngineKind:
    """A class of engines, and what it supports and needs.

    Attributes:
        target: path of the class, a subclass of ``wheelleg_exp.sim.engine.Engine``.
        devices: regular expression of the devices on which it runs.
        exact_devices: regular expression of the devices on which it can be bit-reproducible.
        inexact: why it is not bit-reproducible on other devices, as the end of a sentence.
        reads_robot_file: whether it reads the robot's file, and not only the compiled model.
    """

    target: str
    devices: str = "cpu"
    exact_devices: str = "cpu"
    inexact: str = ""
    packages: tuple[str, ...] = ()
    install: str = ""
    solvers: tuple[str, ...] = ("pgs", "cg", "newton")
    reads_robot_file: bool = False


ENGINES = {
    "mujoco": EngineKind("wheelleg_exp.sim.batch_engine.BatchEngine"),
    "warp": EngineKind(
        "wheelleg_exp.sim.warp_engine.WarpEngine",
        devices=r"cpu|cuda(:\d+)?",
        exact_devices=".*",
        packages=("warp", "mujoco_warp"),
        install="pip install 'wheelleg_exp[gpu]'",
        solvers=("newton", "cg"),
    ),
    "physx": EngineKind(
        "wheelleg_exp.sim.physx.physx_engine.PhysxEngine",
        exact_devices="",
        inexact="does not continue a restored state identically",
        packages=("ovphysx", "physx_usd_schemas"),
        install="pip install 'wheelleg_exp[physx]', on x86-64 Linux or Windows",
        reads_robot_file=True,
    ),
}


def engine_kind(engine: str | Node) -> EngineKind:
    """Return the kind of engine that ``env.sim.engine`` names, or selects by a ``_target_``."""
    if isinstance(engine, str):
        return ENGINES[engine]
    target = str(engine[TARGET])
    own = EngineKind(target, devices=".*", exact_devices=".*", reads_robot_file=True)
    return next((kind for kind in ENGINES.values() if kind.target == target), own)


def _engine_fits(engine: str | Node, device: str, solver: str, deterministic: bool) -> Iterator[Broken]:
    kind = engine_kind(engine)
    name = engine if isinstance(engine, str) else kind.target
    if not re.fullmatch(kind.devices, device):
        if kind.devices == "cpu":
            yield Broken("device", f"the engine '{name}' runs on the CPU, not on {device!r}", "cpu, or engine: warp")
        else:
            yield Broken("device", f"{device!r} is not a device of the engine '{name}'", "cpu, or cuda:0 and so on")
    if deterministic and not re.fullmatch(kind.exact_devices, device):
        expected = "false, or engine: mujoco, which is bit-reproducible (docs/reproducibility.md)"
        yield Broken("deterministic", f"the engine '{name}' {kind.inexact}", expected)
    if solver not in kind.solvers:
        yield Broken("solver", f"the engine '{name}' has no solver '{solver}'", " or ".join(kind.solvers))
    if missing := [package for package in kind.packages if find_spec(package) is None]:
        message = f"the engine '{name}' needs the package {missing[0]}, which is not installed"
        yield Broken("engine", message, f"mujoco, or: {kind.install}")


@relation(_engine_fits)
@dataclass(frozen=True)
class SimOptions:
    """Options of the physics engine and the solver (``env.sim``); the solver options have MuJoCo's names.

    Attributes:
        engine: The engine ``mujoco`` simulates bit-reproducibly on the CPU; ``warp`` is mujoco-warp, in single
            precision, usually on a GPU; ``physx`` is NVIDIA PhysX on the CPU, to evaluate policies (docs/engines.md). A
            node with a ``_target_`` selects another subclass of ``wheelleg_exp.sim.engine.Engine``.
        device: device of the engine's tensors, ``cpu``, or for the engine ``warp`` also ``cuda:0`` and so on.
        dt: physics time step, s.
        gravity: world gravity, m/s^2.
        integrator: MuJoCo integrator.
        solver: constraint solver.
        cone: friction cone.
        iterations: maximum number of solver iterations in one step.
        ls_iterations: maximum number of line-search iterations in one solver iteration.
        tolerance: solver tolerance at which the iterations stop early.
        impratio: frictional to normal constraint impedance.
        nthread: physics threads; 0 means one for each core that the process may use. It never changes a result.
        nconmax: engine ``warp``: capacity for contacts, per simulation on average, since all simulations share one
            buffer; 0 derives it from the model. More contacts are an error.
        njmax: engine ``warp``: capacity for constraint rows in each simulation; 0 derives it from the model and
            ``nconmax``. More rows are an error.
        graph: engine ``warp`` on a GPU: launch a physics step as one CUDA graph, which changes no number.
        graph_step: engine ``warp`` on a GPU: launch the torch operations of a control step (actions, rewards, resets,
            commands, observations) as CUDA graphs. docs/gpu.md lists the requirements for terms.
        deterministic: require bit-reproducible results. On a GPU, the engine ``warp`` and torch then compute in a
            fixed order, and raise an error where they cannot (docs/gpu.md). ``physx`` is refused.
    """

    engine: Literal["mujoco", "warp", "physx"] | Node
    device: str
    dt: constraints.Positive
    gravity: Annotated[Sequence[float], Length(3)]
    integrator: Literal["euler", "rk4", "implicit", "implicitfast"]
    solver: Literal["pgs", "cg", "newton"]
    cone: Literal["pyramidal", "elliptic"]
    iterations: Count
    ls_iterations: Count
    tolerance: constraints.NonNegative
    impratio: constraints.Positive
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
        sensors: the sensors' nodes by name.
    """

    env_spacing: constraints.NonNegative
    terrain: Node
    sensors: dict[str, Node | None]


@dataclass(frozen=True)
class InitState:
    """The robot's default state, to which resets return the robot (``env.robot.init_state``).

    Attributes:
        pos: root link, m.
        rot: root link, (w, x, y, z).
        joint_pos: rad, by joint expression; 0 for joints that no expression matches.
        joint_vel: rad/s, by joint expression; 0 for joints that no expression matches.
    """

    pos: Annotated[Sequence[float], Length(3)]
    rot: Annotated[Sequence[float], Length(4), NotAllZero()]
    joint_pos: dict[str, float]
    joint_vel: dict[str, float]


CombineMode = Literal["average", "min", "multiply", "max"]


@dataclass(frozen=True)
class RobotOptions:
    """The robot (``env.robot``).

    Attributes:
        profile: name of this set of numbers, which results state.
        asset: the robot's USD file, relative to an asset folder.
        base: whether the base is floating or fixed; ``auto`` accepts the model's base.
        init_state: the state that resets start from.
        joint_order: joint names in the order that terms see; null is breadth-first, as in PhysX.
        soft_joint_pos_limit_factor: width of the soft limits as a share of the joint range.
        friction_source: which of a material's two coefficients becomes MuJoCo's single coefficient.
        friction_combine_mode: how the coefficients of robot and ground combine; Isaac Lab's locomotion tasks multiply.
        actuators: the nodes of the actuator groups by name.
        self_collisions: whether the robot's own bodies collide; null uses the asset's setting.
        root_frame: orientation of the root's frame in the file's, (w, x, y, z), for x forwards and z upwards; or null.
        standing_height: height of the root link above the ground in the default pose, m.
        wheel_radius: radius of the wheels, m.
        joint_sets: joint expressions by role. Terms refer to them, for example by ``${env.robot.joint_sets.legs}``.
        body_sets: body expressions by role, likewise.
        size: height of the root link or of the centre of mass in the default pose, whichever is larger, m. The numbers
            of stock configs grow with it, with the mass, and with the natural speed (docs/robots.md).
        mass: mass of the whole robot, kg.
        natural_speed: square root of gravity times size, at most the top speed of the wheels, m/s.
        leg_reach: rotation that the legs' drives and limits allow around the default pose, rad; null without legs.
        physics_dt: physics time step that suits the drives, s.
        decimation: physics steps per control step.
        action_scales: rotation of a leg joint, rad, and speed of a wheel, rad/s, per unit of action, by role.
        joint_pairs: joints of one side, and the names of their mirror images, as in agent.symmetry; null for a
            robot that is not symmetric, whose policies learn without mirror images.
        silence: reasons to accept findings of ``check --physics`` that are properties of the robot, by rule.
    """

    profile: str
    asset: str
    base: Literal["auto", "floating", "fixed"]
    init_state: InitState
    joint_order: list[str] | None
    soft_joint_pos_limit_factor: Annotated[float, constraints.Above(0), constraints.AtMost(1)]
    friction_source: Literal["static", "dynamic"]
    actuators: dict[str, Node | None]
    self_collisions: bool | None = None
    root_frame: Annotated[Sequence[float], Length(4), NotAllZero()] | None = None
    friction_combine_mode: CombineMode = "average"
    standing_height: Positive | None = None
    wheel_radius: Positive | None = None
    joint_sets: dict[str, list[str]] = field(default_factory=dict)
    body_sets: dict[str, list[str]] = field(default_factory=dict)
    size: Positive | None = None
    mass: Positive | None = None
    natural_speed: Positive | None = None
    leg_reach: Positive | None = None
    physics_dt: Positive | None = None
    decimation: Count | None = None
    action_scales: dict[str, float] = field(default_factory=dict)
    joint_pairs: dict[str, str | None] | None = None
    silence: dict[str, str | None] = field(default_factory=dict)


@dataclass(frozen=True)
class EnvOptions:
    """``env``: number of environments, episode length, decimation, and all parts of the environment."""

    num_envs: Count
    episode_length_s: Positive
    decimation: Annotated[int, constraints.AtLeast(1), constraints.AtMost(10_000)]
    sim: SimOptions
    scene: SceneOptions
    robot: RobotOptions
    commands: Terms
    actions: Terms
    observations: dict[str, ObservationGroup]
    events: Terms
    rewards: Terms
    terminations: Terms
    curriculum: Terms
    realism: Realism = field(default_factory=Realism)
    recorders: Terms = field(default_factory=dict)
    dataset: Dataset = field(default_factory=Dataset)
    is_finite_horizon: bool = False


def read_env(cfg: EnvOptions | Mapping[str, object]) -> EnvOptions:
    """Return the config section ``env`` as options, without terms that are null; a missing section has no terms."""
    if isinstance(cfg, EnvOptions):
        return cfg
    tree = {"env": copy.deepcopy(dict(cfg))}
    drop_removed(tree)
    return read_section(EnvOptions, tree["env"], "env")
