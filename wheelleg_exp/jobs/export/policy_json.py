"""The types of ``policy.json``: a list has a value for each joint or component of a reading; None means no limit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NotRequired, TypedDict

Limits = list[float | None]


class TrainedWith(TypedDict):
    """What the training added, and the bundle does not."""

    delay_steps: Sequence[float] | None
    noise: NotRequired[Mapping[str, object] | None]


class Modifier(TypedDict):
    """A modifier of an observation term; ``kind`` determines which other keys exist."""

    kind: str
    multiplier: NotRequired[float]
    value: NotRequired[float]
    bounds: NotRequired[list[float]]
    dt: NotRequired[float]
    A: NotRequired[list[float]]
    B: NotRequired[list[float]]


class TermValue(TypedDict):
    """How an observation term computes its value; ``function`` determines which other keys exist."""

    function: str
    reading: NotRequired[str]
    columns: NotRequired[list[int]]
    joint_names: NotRequired[list[str]]
    subtract: NotRequired[list[float]]
    middle: NotRequired[list[float]]
    range: NotRequired[list[float]]
    needs: NotRequired[list[str]]
    command: NotRequired[str]
    signs: NotRequired[list[float]]
    wheel_radius: NotRequired[float]
    max_travel_error: NotRequired[float]
    max_heading_error: NotRequired[float]
    centres: NotRequired[list[list[float]]]
    links: NotRequired[list[dict[str, list[Any]]]]  # one joint of each leg, from the wheels: ``root_motion.Link``
    max_height_error: NotRequired[float]
    episode_length_s: NotRequired[float]
    period: NotRequired[float]
    offsets: NotRequired[list[float]]


class ObservationTerm(TermValue):
    """An observation term: its value, then modifiers, clip, scale, and history."""

    name: str
    width: int
    history_length: int
    modifiers: list[Modifier]
    clip: list[float] | None
    scale: NotRequired[list[float]]
    trained_with: TrainedWith


class ObservationGroup(TypedDict):
    """A group of observation terms; ``history_order`` is ``term`` or ``time``."""

    name: str
    history_order: str
    terms: list[ObservationTerm]


class ActionLaw(TypedDict):
    """How an action term computes its targets; ``function`` determines which other keys exist."""

    function: str
    scale: NotRequired[list[float]]
    offset: NotRequired[list[float]]
    rescale: NotRequired[bool]
    low: NotRequired[Limits]
    high: NotRequired[Limits]
    alpha: NotRequired[list[float]]
    threshold: NotRequired[float]
    strict: NotRequired[bool]
    opens_above: NotRequired[bool]
    open: NotRequired[list[float]]
    close: NotRequired[list[float]]


class ActionTerm(ActionLaw):
    """An action term: its slice of the network's output, and its joints."""

    name: str
    start: int
    stop: int
    joint_names: list[str]
    joint_ids: list[int]
    drives: str
    clip: list[Limits] | None
    trained_with: TrainedWith


# ``law`` is None if only the training's simulation has the law. One key is the keyword ``class``.
Drive = TypedDict(
    "Drive",
    {
        "name": str,
        "law": str | None,
        "class": str,
        "joint_names": list[str],
        "joint_ids": list[int],
        "stiffness": Limits,
        "damping": Limits,
        "effort_limit": Limits,
        "velocity_limit": Limits,
        "saturation_effort": list[float] | None,
        "trained_with": TrainedWith,
    },
)


class Reading(TypedDict):
    """A sensor reading or command of the policy."""

    width: int
    unit: str
    meaning: str


class Rule(TypedDict):
    """The checks of a reading: bounds, the largest jump in a control step, and still and slow values."""

    check: str
    low: Limits
    high: Limits
    max_jump: Limits
    still: float | None
    slow: float | None
    norm: NotRequired[list[float]]


class Upright(TypedDict):
    """The reading that shows the tilt, and its value when the base is upright."""

    reading: str
    upright: list[float]


class Fall(Upright):
    """A fall is a tilt of more than ``angle`` rad for ``steps`` control steps."""

    angle: float
    steps: int


class Stop(TypedDict):
    """The end of a safe stop."""

    position: list[float]
    gain: float
    ramp_s: float


class Safety(TypedDict):
    """The numbers of ``Policy.update``."""

    status: dict[str, int]
    rate_hz: float
    hold_steps: int
    missed_steps: int
    stale_s: float
    readings: dict[str, Rule]
    fall: Fall | None
    stop: Stop
    recover: dict[str, float]
    start: dict[str, float]


class Bump(TypedDict):
    """How the policy jumps onto a step that stopped its wheels: readings, wheels, and the settings of the command."""

    on: bool
    jump: str
    velocity: str
    columns: list[int]
    signs: list[float]
    wheel_radius: float
    max_acceleration: Limits
    settings: dict[str, float]


class Imu(TypedDict):
    """The pose of an IMU on its body."""

    body: str
    pos: list[float]
    quat: list[float]


class Root(TypedDict):
    """The base of the robot, and its default pose."""

    body: str
    floating: bool
    pos: list[float]
    quat: list[float]


class PerJoint(TypedDict):
    """The drive and the mechanical properties of every joint, in the order of ``joint_names``."""

    stiffness: Limits
    damping: Limits
    effort_limit: Limits
    velocity_limit: Limits
    armature: list[float]
    friction: list[float]
    viscous_friction: list[float]
    inertia: list[float]
    drive_rate: list[float]


class Robot(PerJoint):
    """The robot, what the policy reads, and what it commands: ``policy.json`` without the sections about a run."""

    format_version: int
    step_dt: float
    physics_dt: float
    decimation: int
    robot_profile: str | None
    joint_names: list[str]
    default_joint_pos: list[float]
    default_joint_vel: list[float]
    joint_pos_limits: list[Limits]
    rolling_joints: list[str]
    readings: dict[str, Reading]
    commands: dict[str, dict[str, list[float]]]
    command_accelerations: dict[str, Limits]
    bump: Bump | None
    observation_width: int
    observations: list[ObservationGroup]
    action_width: int
    clip_actions: float | None
    actions: list[ActionTerm]
    actuators: list[Drive]
    imus: dict[str, Imu]
    root: Root


class Specification(Robot):
    """``Robot`` with the numbers of the safe operation."""

    safety: Safety


class Network(TypedDict):
    """The policy's network, whose arrays are in ``file``."""

    file: str
    dtype: str
    widths: list[int]
    activations: list[str]
    normalized: bool


class Check(TypedDict):
    """The recorded steps with which the files of the bundle were compared."""

    file: str
    steps: int
    tolerance: float
    tolerance_float32: float
    largest_difference: NotRequired[dict[str, float]]


class Margin(TypedDict):
    """A change that the policy survived; ``reference`` is that of the reference controller, if measured."""

    name: str
    unit: str
    policy: float
    reference: float | None


class Run(TypedDict):
    """The run and the checkpoint of the policy."""

    id: str
    task: str | None
    iteration: int
    checkpoint: str
    checkpoint_sha256: str


class PolicyJson(Specification):
    """The whole content of ``policy.json``."""

    run: Run
    network: Network
    check: Check
    margins: list[Margin]
