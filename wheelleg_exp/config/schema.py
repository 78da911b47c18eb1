"""The fixed part of the composed tree: which keys there are, of which type, in which range.

The keys of a section are the fields of the dataclass that reads it, so that the two cannot drift apart. A
field's ``metadata`` may hold ``minimum`` (value at least that), ``above`` (value greater than that) and
``maximum``.
"""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Literal

# Section of the tree -> the dataclass whose fields are its keys; imported when it is needed.
OPTIONS: dict[str, str] = {
    "env.sim": "wheelleg_exp.sim.options.SimOptions",
    "env.scene": "wheelleg_exp.sim.options.SceneOptions",
    "env.robot": "wheelleg_exp.sim.options.RobotOptions",
    "recording": "wheelleg_exp.recording.options.RecordingOptions",
    "run": "wheelleg_exp.run.options.RunOptions",
}

Section = dict[str, Any]


@dataclass(frozen=True)
class Task:
    """``task``: what is trained."""

    name: str


@dataclass(frozen=True)
class Env:
    """``env``: the size and pace of the environments, and the sections that others read."""

    num_envs: int = field(metadata={"minimum": 1})
    episode_length_s: float = field(metadata={"above": 0.0})
    decimation: int = field(metadata={"minimum": 1})
    sim: Section
    scene: Section
    robot: Section
    commands: Section
    actions: Section
    observations: Section
    events: Section
    rewards: Section
    terminations: Section
    curriculum: Section


@dataclass(frozen=True)
class ObservationGroup:
    """``env.observations.<group>``."""

    terms: Section
    concatenate_terms: bool = True
    enable_corruption: bool = False
    history_length: int | None = field(default=None, metadata={"minimum": 0})
    flatten_history_dim: bool = True


@dataclass(frozen=True)
class Check:
    """``check``: findings that are known and accepted."""

    silence: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Root:
    """The top of the tree."""

    seed: int = field(metadata={"minimum": 0})
    task: Task
    env: Env
    agent: Section
    recording: Section
    run: Section
    check: Check | None = None


@dataclass(frozen=True)
class Play:
    """``play``: how figures are taken."""

    settle_s: float = field(metadata={"minimum": 0.0})


@dataclass(frozen=True)
class PlayRecording:
    """``recording`` of a play."""

    enabled: bool
    env_ids: list[int]
    max_mb: float = field(metadata={"minimum": 0.0})
    live: bool


@dataclass(frozen=True)
class PlayRoot:
    """The top of the tree that a play reads: the run's own ``env`` and ``agent``, and the play's settings."""

    seed: int = field(metadata={"minimum": 0})
    play: Play
    recording: PlayRecording
    env: Env
    agent: Section


@dataclass(frozen=True)
class Agent:
    """``agent``: what rsl_rl's algorithm and networks read, and what the trainer reads."""

    algorithm: Section
    num_steps_per_env: int = field(metadata={"minimum": 1})
    max_iterations: int = field(metadata={"minimum": 1})
    save_interval: int = field(metadata={"minimum": 1})
    obs_groups: dict[str, list[str]]
    actor: Section
    critic: Section
    device: str
    torch_threads: int = field(metadata={"minimum": 1, "maximum": 1024})
    clip_actions: float | None = field(default=None, metadata={"above": 0.0})
    logger: Literal["tensorboard"] | None = "tensorboard"
    torch_compile_mode: str | None = None


# The manager's own fields of a term, by section: their types, and which of them every term must have.
FIELD_TYPES: dict[str, Any] = {
    "weight": float,
    "time_out": bool,
    "mode": str,
    "interval_range_s": tuple[float, float] | None,
    "is_global_time": bool,
    "min_step_count_between_reset": int,
    "history_length": int,
    "flatten_history_dim": bool,
    "clip": tuple[float, float] | None,
    "scale": float | list[float] | None,
}
# Events may have modes of the user's own; one that is nearly a known one is taken for a misspelling.
EVENT_MODES = ("prestartup", "startup", "reset", "interval")
# Fields that only events of one mode read.
MODE_FIELDS = {"interval_range_s": "interval", "is_global_time": "interval", "min_step_count_between_reset": "reset"}
REQUIRED_FIELDS: dict[str, tuple[str, ...]] = {"rewards": ("weight",), "events": ("mode",)}


# The rules of `wheelleg check --physics`, which `check.silence` may name.
PHYSICS_RULES: tuple[str, ...] = (
    "action_clip_never_acts",
    "action_scale",
    "armature_ratio",
    "command_reach",
    "contact_threshold",
    "control_rate",
    "cumulative_randomisation",
    "discount_horizon",
    "drive_bandwidth",
    "effort_against_load",
    "effort_against_traction",
    "episode_end",
    "event_never_fires",
    "falling_pays",
    "gains_against_time_step",
    "noise_against_signal",
    "noop_curriculum",
    "noop_joint_reset",
    "noop_restitution",
    "observation_scale",
    "ppo_batch",
    "push_size",
    "reward_too_small",
    "spawn_height",
    "target_height",
    "tracking_std",
    "unbounded_observation",
    "wrench_size",
    "zero_width_range",
)


@dataclass(frozen=True)
class Key:
    """One allowed key of a section."""

    name: str
    annotation: Any
    required: bool
    limits: dict[str, Any]


def keys_of(options: type) -> dict[str, Key]:
    """Return the allowed keys of a section from the fields of its dataclass."""
    hints = typing.get_type_hints(options)
    missing = dataclasses.MISSING
    return {
        f.name: Key(f.name, hints[f.name], f.default is missing and f.default_factory is missing, dict(f.metadata))
        for f in dataclasses.fields(options)
        if f.init
    }


def is_open(root: type, path: str) -> bool:
    """Return whether the keys of the section at ``path`` are not set down by ``root`` itself."""
    return "." in path or typing.get_type_hints(root).get(path) == Section


def options_of(path: str) -> type | None:
    """Return the dataclass that reads the section at ``path``, or None when none is set down."""
    name = OPTIONS.get(path)
    if name is None:
        return None
    module, _, attribute = name.rpartition(".")
    found: type = getattr(import_module(module), attribute)
    return found
