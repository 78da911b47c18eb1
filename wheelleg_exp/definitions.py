"""Define every reported figure: its label, its unit, and its meaning.

Commands, plots, reports, and docs read these definitions. The sections are: how figures are written, the scalars
of a training, the figures of plays and agents, the figures of drives, and the figures of a recording.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

SHARE = "share"  # the unit of what is shown as a percentage
STEPS = "steps"  # control steps
NOT_FINITE = "a number that is not finite"


@dataclass(frozen=True)
class Definition:
    """What a figure is.

    Attributes:
        label: what stands beside it wherever it is shown to people.
        unit: its unit; empty for a number, a count or a text.
        meaning: of which episodes, environments and steps it is, and what is taken over them.
        of: in a few words, what it is taken over.
    """

    label: str
    unit: str
    meaning: str
    of: str = ""

    @property
    def heading(self) -> str:
        """The label with the unit, as a table's column has it; percentages say themselves what they are."""
        return f"{self.label} ({self.unit})" if self.unit not in ("", SHARE) else self.label


def ending(terms: Iterable[str]) -> str:
    """Return by what an episode ended: the terminations that fired in its last step, so that it counts once.

    An episode that no termination ended had a reward, or a state, that was not finite.
    """
    return " and ".join(terms) or NOT_FINITE


def percent(share_: float) -> str:
    """Return a share as a percentage, ``93.8%``: nearly all is not all, and nearly none is not none."""
    shown = min(max(round(100.0 * share_, 1), 0.1), 99.9) if 0.0 < share_ < 1.0 else 100.0 * share_
    return f"{shown:.1f}%"


def share(part: int, whole: int) -> str:
    """Return a share with what it is of, ``93.8% (60 of 64)``: 1 of 1 says little; a dash for a share of nothing."""
    return f"{percent(part / whole)} ({part} of {whole})" if whole else "-"


LAST = "the last 100 ended episodes"
EPISODE_REWARD = "sum of an episode / longest episode's seconds"
_ALL = "all environments"
_ENDED = "the iteration's ended episodes"
_ALL_STEPS = "all control steps of all environments in the iteration"
_NAME = re.compile(r"<(\w+)>")

TRAINING_ABOUT = (
    "One value an iteration, of the exploring policy; steps are control steps. What is logged when environments are "
    "reset (`Episode_*`, `Metrics`, `Curriculum`, `Diagnostics`) is the mean over the iteration's resets, each of "
    "which is a mean over the environments that it resets, whatever their number; an iteration without a reset has "
    "none. Such means are biased: who falls early ends more episodes, and shorter ones. `*_per_step/…` has no such "
    "bias: each environment counts alike in each control step of the iteration, whether its episode ends or not. "
    "Errors of commands are sampled once a control step, after its resets."
)
# By key; a part in <> is any name, and the first pattern that fits counts.
SCALARS = {
    "Train/mean_reward": Definition(
        "return, mean", "", f"Mean sum of rewards of {LAST}, of {_ALL}; not discounted.", LAST
    ),
    "Train/mean_episode_length": Definition("episode length, mean", STEPS, f"Of {LAST}, of {_ALL}.", LAST),
    "Episode_Termination/<term>": Definition(
        "last episode ended by <term>",
        SHARE,
        f"Of {_ALL}: those whose last ended episode this termination ended. An episode that two ended in one step "
        "counts for both, and an environment without an ended episode for none.",
        _ALL,
    ),
    "Episode_Reward/<term>": Definition(
        f"<term>, {EPISODE_REWARD}",
        "1/s",
        "Sum of the weighted term over an episode, divided by the seconds of the longest episode there may be, not by"
        " its own.",
        _ENDED,
    ),
    "Episode_Metrics/<command>/error_vel_xy_per_step": Definition(
        "mean planar velocity error (<command>)",
        "m/s",
        "Size of velocity minus command in the base's axes, mean over an episode's control steps.",
        _ENDED,
    ),
    "Episode_Metrics/<command>/error_vel_yaw_per_step": Definition(
        "mean yaw rate error (<command>)",
        "rad/s",
        "Size of yaw rate minus command, mean over an episode's control steps.",
        _ENDED,
    ),
    "Episode_Metrics/<command>/<metric>_per_step": Definition(
        "mean <metric> (<command>)",
        "",
        "A command's own error, mean over an episode's control steps.",
        _ENDED,
    ),
    "Metrics/<command>/<metric>": Definition(
        "<metric>, added up over an episode (<command>)",
        "",
        "Isaac Lab's metric: the error added up over an episode's control steps, times the control step, divided by "
        "the longest time between two commands. It grows with the episode; `Episode_Metrics` has the error itself.",
        _ENDED,
    ),
    "Metrics_per_step/<command>/error_vel_xy": Definition(
        "planar velocity error (<command>)",
        "m/s",
        f"Size of velocity minus command in the base's axes, mean over {_ALL_STEPS}.",
        _ALL_STEPS,
    ),
    "Metrics_per_step/<command>/error_vel_yaw": Definition(
        "yaw rate error (<command>)", "rad/s", f"Size of yaw rate minus command, mean over {_ALL_STEPS}.", _ALL_STEPS
    ),
    "Metrics_per_step/<command>/<metric>": Definition(
        "<metric> (<command>)", "", f"A command's own error, mean over {_ALL_STEPS}.", _ALL_STEPS
    ),
    "Rewards_per_step/<term>": Definition(
        "<term>, reward per second", "1/s", f"The weighted term per second, mean over {_ALL_STEPS}.", _ALL_STEPS
    ),
    "Terminations_per_step/<term>": Definition(
        "steps that <term> ended",
        SHARE,
        f"Of {_ALL_STEPS}: those in which this termination ended an episode.",
        _ALL_STEPS,
    ),
    "Curriculum/<term>": Definition("curriculum <term>", "", "What the term returned last."),
    "Diagnostics/joint_over_speed": Definition(
        "a joint beyond its velocity limit", SHARE, "Of the episodes that end, in their last step.", _ENDED
    ),
    "Diagnostics/<sensor>_overflow": Definition(
        "more contacts than <sensor> sums", SHARE, "Of the episodes that end.", _ENDED
    ),
    "Diagnostics/non_finite/<key>": Definition(
        "episodes ended by numbers of <key> that were not finite",
        "",
        "How many in the iteration: of a reward, of the physics (`env.sim`) or of the actions.",
    ),
    "Loss/value": Definition("value loss", "", "Mean over the iteration's minibatches."),
    "Loss/surrogate": Definition("surrogate loss", "", "Mean over the iteration's minibatches."),
    "Loss/entropy": Definition("entropy of the policy", "nat", "Mean over the iteration's minibatches."),
    "Loss/learning_rate": Definition("learning rate", "", "After the iteration."),
    "Loss/<name>": Definition("<name> loss", "", "Mean over the iteration's minibatches, by rsl_rl's name."),
    "Policy/mean_std": Definition(
        "standard deviation of the actions",
        "raw action",
        "Of the exploration after the iteration, mean over the actions.",
    ),
    "Perf/total_fps": Definition(
        "speed",
        f"{STEPS} / s",
        f"Control steps of {_ALL} by the time of rollout and update; writing files is not counted.",
    ),
    "Perf/collection_time": Definition("time of the rollout", "s", "By the clock."),
    "Perf/learning_time": Definition("time of the update", "s", "By the clock."),
}

# The columns of `wheelleg list runs`, by heading; some are also in a training's progress line and a sweep's table.
LISTED = {
    "done": Definition("done", "", "Iterations, of those that were asked for."),
    "return": Definition("return", "", "`Train/mean_reward` of the last iteration."),
    "time-out": Definition(
        "time-out", SHARE, "`Episode_Termination/time_out` of the last iteration, where a termination has that name."
    ),
    "played": Definition("played", "", "How many of the last play's ended episodes survived, of how many."),
    "evaluated": Definition(
        "evaluated", SHARE, "The last evaluation's protocol, and the share of its first test's episodes that survived."
    ),
    "took": Definition(
        "took", "", "From the run's start to its end. If it was resumed: the sum of its iterations, without the pauses."
    ),
}

# Keys of the manifest; its results hold scalars of the last iteration besides.
MANIFEST = {
    "results.iterations": Definition("iterations", "", "How many were done."),
    "results.seconds": Definition(
        "seconds", "s", "Of the iterations, by the clock; building and exporting are not counted."
    ),
    "last_ended_by": Definition(
        "last episode ended by",
        "",
        "How many environments, by what ended their last episode, each counted once; `none`: nothing ended one.",
    ),
}

# What a training ended as, by the beginnings of keys.
ENDED_AS = (
    *("Train/mean_reward", "Train/mean_episode_length", "Episode_Termination/"),
    *("Metrics_per_step/", "Episode_Metrics/"),
)


def curve_title(key: str) -> str:
    """Return what stands over a curve of a scalar: its label and, of a running mean, what that is of."""
    found = scalar_definition(key)
    if found is None:
        return key
    text = f"{found.label} of {found.of}" if found.of == LAST else found.label
    return text[:1].upper() + text[1:]


def scalar_definition(key: str) -> Definition | None:
    """Return the definition of a scalar, its label with the names of the key; None for one of another program."""
    for pattern, found in SCALARS.items():
        match = re.fullmatch(_NAME.sub(r"(?P<\1>.+)", pattern), key)
        if match:
            label = found.label
            for name, value in match.groupdict().items():
                label = label.replace(f"<{name}>", value)
            return replace(found, label=label)
    return None


ROLLOUT_ABOUT = (
    "Of the first episode of each environment. Height and pitch are over all control steps after `settle_s` of all "
    "these episodes together: who falls counts until then, and who stands longer counts for more; the label says "
    "after how many seconds."
)
# By the keys of figures.json and of the manifest's additions.
ROLLOUT = {
    "episodes": Definition("episodes", "", "How many: as many as environments. Later ones count for nothing."),
    "unfinished": Definition(
        "still running", "", "How many of them had not ended when the run did. They are in height and pitch alone."
    ),
    "survival": Definition(
        "survived to the time-out",
        SHARE,
        "Of the ended episodes: those that a time-out ended, and no failure in the same step. None when none ended.",
    ),
    "settle_s": Definition(
        "settling time", "s", "Left out of height and pitch at an episode's start: `play.settle_s` (1 s); agents 0 s."
    ),
    "settled_episodes": Definition("episodes in height and pitch", "", "How many lasted longer than that."),
    "settled_steps": Definition("control steps in height and pitch", "", "How many there are, of all episodes."),
    "height_rmse_m": Definition(
        "base height, RMSE to target",
        "m",
        "Root mean square of height minus target, the `target_height` of the first reward that has one.",
    ),
    "height_mean_m": Definition(
        "base height, mean", "m", "Mean height of the root link's origin above the world's zero."
    ),
    "pitch_rms_deg": Definition("pitch, RMS", "°", "Root mean square of the pitch against upright."),
    "pitch_mean_deg": Definition("pitch, mean", "°", "Mean of the pitch: the lean, forwards positive."),
    "mean_return": Definition(
        "return, mean",
        "",
        "Mean over the ended episodes of the sum of their rewards, not discounted; without those that ended because a "
        "number was not finite.",
    ),
    "non_finite": Definition(
        "ended by numbers that are not finite",
        "",
        "How many episodes, by the config key whose numbers these were: they are in no return, and in height and pitch "
        "up to then. Only where there are some.",
    ),
    "ended_by": Definition(
        "ended by",
        "",
        "How many episodes; each counts once: what two terminations ended in one step, under both names.",
    ),
}

MOTION_ABOUT = (
    "How it moved and what its motors bore (`wheelleg play`): over the same control steps as height and pitch. Where a "
    "figure has one value for each actuator group, its label names the group."
)
# By the keys of figures.json; the last three have one value for each actuator group.
MOTION = {
    "drift_m": Definition(
        "strayed from its place",
        "m",
        "Largest distance in the plane from where the base was once settled, mean over the episodes that settled.",
    ),
    "yaw_drift_deg": Definition(
        "turned from its heading", "°", "Largest turn from the heading that the base had once settled, likewise."
    ),
    "action_rate_per_s": Definition(
        "actions change", "1/s", "Mean size of an action component's change from step to step, per second."
    ),
    "power_net_w": Definition(
        "power, net of armature",
        "W",
        "Mean of the joints' mechanical power, sizes summed: (τ − I q̈) q̇ with the armature I, whose swinging takes no "
        "energy in the end, over every physics step.",
    ),
    "torque_rms_nm": Definition("torque, RMS", "N·m", "Root mean square over joints and physics steps."),
    "at_limit": Definition("at the effort limit", SHARE, "Of the physics steps: those at 99 % of the limit or more."),
    "sign_changes_per_s": Definition(
        "torque changes its sign",
        "1/s",
        "How often a joint's torque passes from beyond a thousandth of its limit on one side to beyond it on the "
        "other.",
    ),
}

CONTACTS_ABOUT = (
    "What each link of an agent's robot carries (`contacts`): over the control steps of all episodes and environments"
    " from 0.2 s after a reset on in which the robot is tilted by less than 0.2 rad."
)
# By the keys of figures.json below `contacts.<sensor>`.
CONTACTS = {
    "mean_n": Definition(
        "mean", "N", "Mean size of the net normal force at the end of these steps; 0 without contact."
    ),
    "max_n": Definition("largest", "N", "Largest size of that force at the end of a step."),
    "contact_share": Definition("in contact", SHARE, "Of these steps: those with any force at their end."),
    "steps": Definition("steps", "", "How many these are."),
}


def rollout_label(key: str, settle_s: float | None) -> str:
    """Return the label of a figure with the part of an episode that it is of; ``settle_s`` is None where not known."""
    if key in MOTION:
        return f"{MOTION[key].label}, {settled_window(settle_s)}"
    text = ROLLOUT[key].label
    return f"{text}, {settled_window(settle_s)}" if key.startswith(("height_", "pitch_")) else text


def settled_window(settle_s: float | None) -> str:
    """Return which part of an episode height and pitch are of, in words."""
    if settle_s is None:
        return "once settled"
    return f"after {settle_s:g} s" if settle_s else "from the start"


DRIVE_ABOUT = (
    "Of one robot over all control steps of the drive, its falls and new starts included. There is one drive for each "
    "checkpoint and each ground that was chosen."
)
# By the keys of figures.json below play/, and of the manifest's additions of kind `drive`.
DRIVE = {
    "duration_s": Definition("driven", "s", "Simulated time; pauses and the times that falls are shown do not count."),
    "steps": Definition("control steps", "", "How many these are."),
    "distance_m": Definition("distance", "m", "Length of the way of the root link's origin over the ground plane."),
    "falls": Definition("fell", "", "How many episodes ended by themselves, by what ended them."),
    "resets": Definition("resets", "", "How often the robot was reset by who drives."),
    "pushes": Definition("pushes", "", "How often it was pushed by who drives."),
    "height_mean_m": Definition("base height, mean", "m", "Mean height of the root link's origin above the ground."),
    "reward": Definition("return", "", "Sum of the rewards of all steps."),
    "tracking_rmse": Definition(
        "RMS error",
        "m/s, rad/s",
        "By axis of the commands: root mean square of what the robot does minus the command, from the step on in which "
        "the command was given.",
    ),
}


def drive_rows(figures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return figures as rows of a table: label and value."""
    found = []
    for key, definition in DRIVE.items():
        value = figures[key]
        unit = f" {definition.unit}" if definition.unit else ""
        if isinstance(value, Mapping):
            found += [(f"{definition.label}: {name}", _number_text(part)) for name, part in value.items()]
            found += [] if value or key != "falls" else [(definition.label, "never")]
        else:
            found.append((definition.label, _number_text(value) + unit))
    return found


def _number_text(value: float) -> str:
    return f"{value}" if isinstance(value, int) else f"{value:.3f}"


RECORDED_ABOUT = (
    "A whole episode was recorded from beginning to end; others are counted and are in no figure of episodes: one "
    "that was under way when recording began is likely a long one, and one that has not ended has no sum of rewards. "
    "Of a training without `--iteration`, `--from` and `--to` the figures are of the last sample that holds a whole "
    "episode, of anything else of all frames; of all recorded environments together, unless `--env` chooses one."
)
_WHOLE = {
    "survival": Definition("survived", SHARE, "Of the whole episodes: those that a time-out ended, and no failure."),
    "mean_duration_s": Definition("lasted, mean", "s", "Mean over the whole episodes."),
    "mean_reward": Definition(
        "return, mean", "", "Mean over the whole episodes of the sum of rewards, not discounted."
    ),
}
# By the title of the table, then by the figure's name in the summary's JSON.
RECORDED = {
    "samples": {
        "iterations": Definition("iterations", "", "Of the sample's first and last frame."),
        "episodes": Definition("whole episodes", "", "How many."),
        "cut": Definition("cut off", "", "How many were recorded in part."),
        **_WHOLE,
    },
    "episodes": {
        "count": Definition("episodes", "", "How many whole ones, and how many others."),
        "ended_by": Definition(
            "ended by", "", "How many whole episodes; each counts once: what two terminations ended, under both names."
        ),
        "longest_s": Definition("lasted, longest", "s", "The longest whole episode."),
        **_WHOLE,
    },
    "base": {
        "mean": Definition("mean", "", "Of height (m), roll and pitch (rad) over the frames."),
        "std": Definition("std", "", "Standard deviation, over n."),
        "rms": Definition("RMS", "", "Root mean square of the value itself, not of its distance from the mean."),
        "minimum": Definition("least", "", "Smallest value."),
        "maximum": Definition("most", "", "Largest value."),
        "maximum_at": Definition("most at", "", "When that was first reached."),
    },
    "tracking": {
        "rmse": Definition("RMS error", "", "Root mean square of velocity minus command in the base's axes."),
        "mean": Definition("mean error", "", "Mean of that difference, with its sign."),
        "largest": Definition("largest error", "", "Largest size of that difference."),
        "mean_command": Definition("mean command", "", "Mean of what was asked for."),
    },
    "contact forces": {
        "largest_n": Definition(
            "largest",
            "N",
            "Largest size of the net normal force within the physics steps that the sensor keeps (3: one and a half "
            "control steps); of older recordings at the end of a step.",
        ),
        "at": Definition("at", "", "When that was."),
        "mean_n": Definition("mean", "N", "Mean size of the force at the end of the steps; 0 without contact."),
        "contact_share": Definition("in contact", SHARE, "Of the frames: those with any force at their end."),
    },
    "efforts": {
        "rms": Definition(
            "RMS", "N·m, or N", "Root mean square of the effort that was applied in the last physics step."
        ),
        "largest": Definition("largest", "N·m, or N", "Its largest size."),
        "limit": Definition("limit", "N·m, or N", "The joint's effort limit."),
        "saturated_share": Definition("at the limit", SHARE, "Of the frames: those in which it is at the limit."),
    },
    "rewards": {
        "weight": Definition("weight", "", "As configured; a curriculum may change it on the way."),
        "mean": Definition("mean", "1/s", "Mean of the weighted value per second."),
        "share": Definition("share by size", SHARE, "Of the sum of the sizes of all terms: this term's."),
    },
    "events": {"times": Definition("times", "", "How often it happened.")},
    "training": {
        "first": Definition("first", "", "In the first iteration that has it."),
        "last": Definition("last", "", "In the last iteration that has it."),
        "lowest": Definition("lowest", "", "Over the iterations, and where."),
        "highest": Definition("highest", "", "Over the iterations, and where."),
    },
}


def recorded_headings(table: str, *keys: str) -> tuple[str, ...]:
    """Return the headings of a table's columns with their units, by default of all."""
    return tuple(RECORDED[table][key].heading for key in keys or RECORDED[table])


def recorded_label(table: str, key: str) -> str:
    """Return the label of a figure."""
    return RECORDED[table][key].label
