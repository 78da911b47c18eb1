"""Define the fixed part of the composed config: its keys, their types, and their ranges.

Each config section has a dataclass, whose field names are the keys of the section. A field's annotation, such as
``Seed`` for the field ``seed``, defines the type and the range of the config value.
"""

from __future__ import annotations

import typing
from dataclasses import dataclass, field
from importlib import import_module
from typing import Literal

from wheelleg_exp.constraints import Natural, NonNegative, Positive, Seed
from wheelleg_exp.terms.config_sections import Env, Section

# ``OPTIONS`` maps a config section to the dataclass whose fields are the section's keys, as a dotted name.
OPTIONS: dict[str, str] = {
    "env.sim": "wheelleg_exp.sim.options.SimOptions",
    "env.scene": "wheelleg_exp.sim.options.SceneOptions",
    "env.robot": "wheelleg_exp.sim.options.RobotOptions",
    "pipeline": "wheelleg_exp.jobs.pipeline.pipeline_phases.Pipeline",
    "recording": "wheelleg_exp.recording.recording_options.RecordingOptions",
    "protocol": "wheelleg_exp.evaluation.protocol_options.Protocol",
    "run": "wheelleg_exp.run.run_directory.RunOptions",
}


@dataclass(frozen=True)
class Task:
    """``task``: what is trained."""

    name: str


@dataclass(frozen=True)
class Check:
    """``check.silence`` maps each silenced lint rule to the reason; null restores a silenced rule."""

    silence: dict[str, str | None] = field(default_factory=dict)


@dataclass(frozen=True)
class Root:
    """The top of the tree."""

    seed: Seed
    task: Task
    env: Env
    agent: Section
    recording: Section
    run: Section
    init_from: str | None = None
    init_from_what: Literal["networks", "policy", "learning"] = "networks"
    check: Check | None = None


@dataclass(frozen=True)
class Play:
    """``play``: the conditions of a play, and how its figures are measured."""

    conditions: Literal["undisturbed", "training"]
    settle_s: NonNegative


@dataclass(frozen=True)
class Drive:
    """``drive``: how a robot is driven by hand, or by a script."""

    episode_length_s: Positive
    push: NonNegative
    fall_shown_s: NonNegative
    get_up: str | None
    frames_per_s: Positive


@dataclass(frozen=True)
class PlayRecording:
    """``recording`` of a play."""

    enabled: bool
    env_ids: list[Natural]
    max_mb: NonNegative
    live: bool


@dataclass(frozen=True)
class PlayRoot:
    """The top-level config keys of ``wheelleg play``, which include ``env`` and ``agent`` of the played run."""

    seed: Seed
    play: Play
    drive: Drive
    recording: PlayRecording
    env: Env
    agent: Section


@dataclass(frozen=True)
class PipelineRoot:
    """The top-level config keys of a training pipeline, whose phases ``wheelleg_exp.jobs.pipeline`` reads."""

    pipeline: Section


@dataclass(frozen=True)
class EvaluateRoot:
    """The top-level config keys of ``wheelleg evaluate``, which include ``env`` and ``agent`` of the evaluated run."""

    seed: Seed
    protocol: Section
    env: Env
    agent: Section


# The config key `check.silence` can switch off each of these rules of `wheelleg check --physics`.
PHYSICS_RULES: tuple[str, ...] = (
    "action_clip_never_acts", "action_scale", "armature_ratio", "assumed_masses", "balance_pose", "command_reach",
    "contact_at_start", "contact_threshold", "control_rate", "cumulative_randomisation", "discount_horizon",
    "drive_bandwidth", "effort_against_load", "effort_against_traction", "episode_end", "event_never_fires",
    "falling_pays", "gains_against_time_step", "joint_limits", "late_average", "levels_out_of_reach",
    "link_masses", "lopsided_pose", "lost_in_conversion", "mirror_images", "missing_files", "no_colliders",
    "noise_against_signal", "noop_curriculum", "noop_joint_reset", "noop_restitution", "observation_scale",
    "overlapping_bodies", "placeholder_limits", "ppo_batch", "push_size", "reset_into_ground", "reward_outweighs",
    "reward_too_small", "robot_size", "rolling_direction", "spawn_height", "target_height", "tracking_std",
    "unbounded_observation", "weak_wheels", "wheel_senses", "wheels_that_do_not_roll", "world_height",
    "wrench_size", "zero_width_range",
)  # fmt: skip


def is_open(root: type, path: str) -> bool:
    """Return whether ``OPTIONS``, instead of the dataclass ``root``, defines the keys of a config section."""
    return "." in path or typing.get_type_hints(root).get(path) == Section


def options_of(path: str) -> type:
    """Return the dataclass that reads the config section at ``path``, which is a key of ``OPTIONS``."""
    module, _, attribute = OPTIONS[path].rpartition(".")
    found: type = getattr(import_module(module), attribute)
    return found
