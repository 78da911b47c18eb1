"""Define the fixed part of the composed config: its keys, their types, and their ranges.

Each section has a dataclass: field names are keys, and an annotation such as ``Seed`` defines type and range.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Annotated, Literal

from wheelleg_exp.constraints import Count, Natural, NonNegative, Pattern, Positive, Seed
from wheelleg_exp.rl.options import Learning
from wheelleg_exp.sim.options import EnvOptions

# ``_ROOTS`` maps a top-level key to the dataclass of the config that has this key; other configs are an `Experiment`.
_ROOTS = {
    "pipeline": "wheelleg_exp.jobs.pipeline.pipeline_phases.PipelineRoot",
    "protocol": "wheelleg_exp.evaluation.protocol_options.EvaluateRoot",
    "play": "wheelleg_exp.config.schema.PlayRoot",
}
# The task name and ``run.name`` must match ``NAME``, because a run directory's path contains both.
NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}"
NAME_WORDS = "up to 100 letters, digits, '.', '_' and '-', starting with a letter or digit"


@dataclass(frozen=True)
class Task:
    """``task``: what is trained."""

    name: str


@dataclass(frozen=True)
class Check:
    """``check.silence`` maps each silenced lint rule to the reason; null restores a silenced rule."""

    silence: dict[str, str | None] = field(default_factory=dict)


@dataclass(frozen=True)
class RecordingOptions:
    """The config section ``recording``. Options with a default can be missing in the configs of old runs.

    Attributes:
        enabled: whether a recording is written.
        env_ids: environments whose motion is recorded.
        interval: iterations between the starts of two samples of whole episodes.
        steps: control steps after which a sample ends with its current episode.
        max_mb: largest size of the recorded motion, MB; scalars are not limited.
        live: whether a viewer shows the run.
        video_every: iterations between two videos of the first of ``env_ids``, each ``steps`` control steps long; 0
            makes no videos.
    """

    enabled: bool
    env_ids: list[Natural]
    interval: Count
    steps: Count
    max_mb: NonNegative
    live: bool
    video_every: Natural = 0


@dataclass(frozen=True)
class RunOptions:
    """The config section ``run``: where a run is written, and how much of the source tree it stores.

    Args:
        root: folder of the run directories; a relative path starts at the working directory.
        name: last part of the run directory's name; letters, digits, ``.``, ``_`` and ``-``.
        max_patch_mb: largest source patch that is stored, in megabytes (10^6 bytes).
    """

    root: str = "runs"
    name: Annotated[str, Pattern(NAME, NAME_WORDS)] | None = None
    max_patch_mb: NonNegative = 50.0


@dataclass(frozen=True)
class Experiment:
    """The composed config of a training."""

    seed: Seed
    task: Task
    env: EnvOptions
    agent: Learning
    recording: RecordingOptions
    run: RunOptions
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
    env: EnvOptions
    agent: Learning


# The config key `check.silence` can switch off each of these rules of `wheelleg check --physics`.
PHYSICS_RULES: tuple[str, ...] = (
    "action_clip_never_acts", "action_scale", "armature_ratio", "assumed_masses", "balance_pose", "command_reach",
    "contact_at_start", "contact_threshold", "control_rate", "cumulative_randomisation", "cylinder_edges",
    "discount_horizon", "drive_bandwidth", "effort_against_load", "effort_against_traction", "episode_end",
    "event_never_fires", "falling_pays", "gains_against_time_step", "joint_limits", "late_average",
    "levels_out_of_reach", "link_masses", "lopsided_pose", "lost_in_conversion", "mirror_images", "missing_files",
    "no_colliders", "noise_against_signal", "noop_curriculum", "noop_joint_reset", "noop_restitution",
    "observation_scale", "overlapping_bodies", "placeholder_limits", "ppo_batch", "push_size", "reset_into_ground",
    "reward_outweighs", "reward_too_small", "robot_size", "rolling_direction", "spawn_height", "target_height",
    "tracking_std", "unbounded_observation", "weak_wheels", "wheel_senses", "wheels_that_do_not_roll", "world_height",
    "wrench_size", "zero_width_range",
)  # fmt: skip


def root_of(tree: Mapping[str, object]) -> type:
    """Return the dataclass of a config's top-level keys, such as ``Experiment`` for the config of a training."""
    dotted = next((dotted for key, dotted in _ROOTS.items() if key in tree), None)
    if dotted is None:
        return Experiment
    module, _, name = dotted.rpartition(".")
    found: type = getattr(import_module(module), name)
    return found
