"""Define every reported number, such as the mean return: its label, its unit, and its meaning."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

SHARE = "share"  # shown as a percentage
STEPS = "steps"  # control steps
NOT_FINITE = "a number that is not finite"


@dataclass(frozen=True)
class Definition:
    """The definition of a reported number: its label, its unit, and its meaning.

    ``unit`` is empty for a ratio, a count, and a text. ``meaning`` states which episodes, environments, and steps are
    covered, and how the number is computed. ``of`` names the episodes or steps over which a mean is taken.
    """

    label: str
    unit: str
    meaning: str
    of: str = ""

    @property
    def heading(self) -> str:
        """The heading of a table column: a reported number's label and unit. A percentage needs no unit."""
        return f"{self.label} ({self.unit})" if self.unit not in ("", SHARE) else self.label


def ending(terms: Iterable[str]) -> str:
    """Return the names of the terms that ended an episode; without one, a reward or a state was not finite."""
    return " and ".join(terms) or NOT_FINITE


def percent(share_: float) -> str:
    """Return a share as a percentage, such as ``93.8%``. Only the exact shares 0 and 1 are shown as 0.0% and 100.0%."""
    shown = min(max(round(100.0 * share_, 1), 0.1), 99.9) if 0.0 < share_ < 1.0 else 100.0 * share_
    return f"{shown:.1f}%"


def share(part: int, whole: int) -> str:
    """Return the share ``part`` of ``whole`` as text, such as ``93.8% (60 of 64)``, or a dash if ``whole`` is 0."""
    return f"{percent(part / whole)} ({part} of {whole})" if whole else "-"


# --- training ---

LAST = "the last 100 ended episodes"
EPISODE_REWARD = "sum of an episode / longest episode's seconds"
_ALL = "all environments"
_ENDED = "the iteration's ended episodes"
_ALL_STEPS = "all control steps of all environments in the iteration"
_NAME = re.compile(r"<(\w+)>")

TRAINING_ABOUT = (
    "One value for each iteration, measured with the exploring policy. Steps are control steps. The scalars that are "
    "logged when environments are reset (`Episode_*`, `Metrics`, `Curriculum`, `Diagnostics`) are means over the "
    "resets of the iteration. Each reset contributes the mean over its environments, whatever their number. An "
    "iteration without a reset has no such value. These means are biased: an environment that falls early ends more "
    "episodes, and shorter ones. `*_per_step/…` has no such bias: every environment counts equally in every control "
    "step of the iteration. Command errors are sampled once per control step, after the resets of that step."
)
# SCALARS defines TensorBoard scalars by key. <NAME> in a key matches any name; the first matching key counts.
SCALARS = {
    "Train/mean_reward": Definition("return, mean", "",
        f"Mean sum of rewards of {LAST}, of {_ALL}; not discounted.", LAST),
    "Train/mean_episode_length": Definition("episode length, mean", STEPS, f"Mean over {LAST} of {_ALL}.", LAST),
    "Episode_Termination/<term>": Definition("last episode ended by <term>", SHARE,
        f"Share of {_ALL} whose last ended episode was ended by this termination. An episode that two terminations "
        "ended in one step counts for both. An environment without an ended episode counts for none.", _ALL),
    "Episode_Reward/<term>": Definition(f"<term>, {EPISODE_REWARD}", "1/s",
        "Sum of the weighted term over an episode, divided by the seconds of the longest possible episode, not by the "
        "length of this episode.", _ENDED),
    "Episode_Metrics/<command>/error_vel_xy_per_step": Definition("mean planar velocity error (<command>)", "m/s",
        "Size of velocity minus command in the base's axes, mean over an episode's control steps.", _ENDED),
    "Episode_Metrics/<command>/error_vel_yaw_per_step": Definition("mean yaw rate error (<command>)", "rad/s",
        "Size of yaw rate minus command, mean over an episode's control steps.", _ENDED),
    "Episode_Metrics/<command>/<metric>_per_step": Definition("mean <metric> (<command>)", "",
        "The error that the command itself defines, mean over an episode's control steps.", _ENDED),
    "Metrics/<command>/<metric>": Definition("<metric>, added up over an episode (<command>)", "",
        "Isaac Lab's metric: the sum of the error over an episode's control steps, times the control step, divided by "
        "the longest time between two commands. It grows with the length of the episode; `Episode_Metrics` does not.",
        _ENDED),
    "Metrics_per_step/<command>/error_vel_xy": Definition("planar velocity error (<command>)", "m/s",
        f"Size of velocity minus command in the base's axes, mean over {_ALL_STEPS}.", _ALL_STEPS),
    "Metrics_per_step/<command>/error_vel_yaw": Definition("yaw rate error (<command>)", "rad/s",
        f"Size of yaw rate minus command, mean over {_ALL_STEPS}.", _ALL_STEPS),
    "Metrics_per_step/<command>/<metric>": Definition("<metric> (<command>)", "",
        f"The error that the command itself defines, mean over {_ALL_STEPS}.", _ALL_STEPS),
    "Rewards_per_step/<term>": Definition("<term>, reward per second", "1/s",
        f"The weighted term per second, mean over {_ALL_STEPS}.", _ALL_STEPS),
    "Terminations_per_step/<term>": Definition("steps that <term> ended", SHARE,
        f"Share of {_ALL_STEPS} in which this termination fired.", _ALL_STEPS),
    "Curriculum/<term>": Definition("curriculum <term>", "", "The last return value of the term."),
    "Diagnostics/joint_over_speed": Definition("a joint beyond its velocity limit", SHARE,
        "Share of the ended episodes, in their last step.", _ENDED),
    "Diagnostics/<sensor>_overflow": Definition("more contacts than <sensor> sums", SHARE,
        "Share of the ended episodes.", _ENDED),
    "Diagnostics/non_finite/<key>": Definition("episodes ended by numbers of <key> that were not finite", "",
        "Number of such episodes in the iteration. The key is that of a reward, of the physics (`env.sim`), or of the "
        "actions."),
    "Loss/value": Definition("value loss", "", "Mean over the iteration's minibatches."),
    "Loss/surrogate": Definition("surrogate loss", "", "Mean over the iteration's minibatches."),
    "Loss/entropy": Definition("entropy of the policy", "nat", "Mean over the iteration's minibatches."),
    "Loss/learning_rate": Definition("learning rate", "", "Value after the iteration."),
    "Loss/<name>": Definition("<name> loss", "", "Mean over the iteration's minibatches, with rsl_rl's name."),
    "Policy/mean_std": Definition("standard deviation of the actions", "raw action",
        "Exploration noise after the iteration, mean over the actions."),
    "Perf/total_fps": Definition("speed", f"{STEPS} / s",
        f"Control steps of {_ALL} divided by the time of rollout and update. Writing files is not counted."),
    "Perf/collection_time": Definition("time of the rollout", "s", "Wall-clock time."),
    "Perf/learning_time": Definition("time of the update", "s", "Wall-clock time."),
}  # fmt: skip

# LISTED defines the columns of the table that the command `wheelleg list runs` prints.
LISTED = {
    "done": Definition("done", "", "Finished iterations, and the requested number."),
    "return": Definition("return", "", "`Train/mean_reward` of the last iteration."),
    "time-out": Definition("time-out", SHARE,
        "`Episode_Termination/time_out` of the last iteration, if a termination has that name."),
    "played": Definition("played", "", "Number of ended episodes of the last play that survived, and their total."),
    "evaluated": Definition("evaluated", SHARE,
        "The last evaluation's protocol, and the share of its first test's episodes that survived."),
    "took": Definition("took", "",
        "Time from the start of the run to its end. For a resumed run: the sum of its iterations."),
}  # fmt: skip

# MANIFEST defines keys of a run's file manifest.json, which also contains the last iteration's training scalars.
MANIFEST = {
    "results.iterations": Definition("iterations", "", "Number of finished iterations."),
    "results.seconds": Definition("seconds", "s",
        "Wall-clock time of the iterations. Building and exporting are not counted."),
    "last_ended_by": Definition("last episode ended by", "",
        "Number of environments for each ending of their last episode. Each environment counts once. `none` means that "
        "no episode of the environment has ended."),
}  # fmt: skip

# ENDED_AS has key prefixes of TensorBoard scalars whose last values are the reported result of a training.
ENDED_AS = (
    *("Train/mean_reward", "Train/mean_episode_length", "Episode_Termination/"),
    *("Metrics_per_step/", "Episode_Metrics/"),
)


def curve_title(key: str) -> str:
    """Return the title of a scalar's curve: its label and, for a running mean, the range of the mean."""
    found = scalar_definition(key)
    if found is None:
        return key
    text = f"{found.label} of {found.of}" if found.of == LAST else found.label
    return text[:1].upper() + text[1:]


def scalar_definition(key: str) -> Definition | None:
    """Return the definition of a TensorBoard scalar by its key; None for an unknown key."""
    for pattern, found in SCALARS.items():
        match = re.fullmatch(_NAME.sub(r"(?P<\1>.+)", pattern), key)
        if match:
            label = found.label
            for name, value in match.groupdict().items():
                label = label.replace(f"<{name}>", value)
            return replace(found, label=label)
    return None


# --- evaluated episodes ---

ROLLOUT_ABOUT = (
    "These figures cover the first episode of each environment. Height and pitch cover all control steps after "
    "`settle_s`, of all these episodes together: an episode that ends early counts with fewer steps. The label says "
    "after how many seconds."
)
# ROLLOUT defines the keys that `wheelleg play` writes to the file figures.json and to the run's file manifest.json.
ROLLOUT = {
    "episodes": Definition("episodes", "", "Number of episodes, one for each environment. Later ones do not count."),
    "unfinished": Definition("still running", "",
        "Number of episodes that had not ended when the rollout ended. Only height and pitch include them."),
    "survival": Definition("survived to the time-out", SHARE,
        "Share of the ended episodes that a time-out ended, without a failure in the same step. Missing if no episode "
        "ended."),
    "settle_s": Definition("settling time", "s",
        "Time at the start of an episode that height and pitch leave out: `play.settle_s` (1 s); 0 s for agents."),
    "settled_episodes": Definition("episodes in height and pitch", "",
        "Number of episodes that lasted longer than the settling time."),
    "settled_steps": Definition("control steps in height and pitch", "", "Number of these steps, of all episodes."),
    "height_rmse_m": Definition("base height, RMSE to target", "m",
        "Root mean square of height minus target. The target is `target_height` of the first reward that has one."),
    "height_mean_m": Definition("base height, mean", "m",
        "Mean height of the root link's origin above the world's zero."),
    "pitch_rms_deg": Definition("pitch, RMS", "°", "Root mean square of the pitch against upright."),
    "pitch_mean_deg": Definition("pitch, mean", "°", "Mean of the pitch. Leaning forwards is positive."),
    "mean_return": Definition("return, mean", "",
        "Mean over the ended episodes of the sum of their rewards, not discounted. Episodes that ended with a "
        "number that was not finite are left out."),
    "non_finite": Definition("ended by numbers that are not finite", "",
        "Number of episodes for each config key whose numbers were not finite. The return leaves these episodes out; "
        "height and pitch cover them until then. Shown only if there are such episodes."),
    "ended_by": Definition("ended by", "",
        "Number of episodes for each ending. Each episode counts once: an episode that two terminations ended in one "
        "step is listed under both names together."),
}  # fmt: skip

MOTION_ABOUT = (
    "The robot's motion and the load of its motors (`wheelleg play`), over the same control steps as height and pitch. "
    "If a figure has one value for each actuator group, its label names the group."
)
# MOTION defines the keys in figures.json that describe the robot's motion and the load of its motors.
# In figures.json, torque_rms_nm, at_limit, and sign_changes_per_s have one value for each actuator group.
MOTION = {
    "drift_m": Definition("strayed from its place", "m",
        "Largest distance in the plane from the base's position at the settling time, mean over the episodes that "
        "lasted longer."),
    "yaw_drift_deg": Definition("turned from its heading", "°",
        "Largest turn from the base's heading at the settling time, mean over the same episodes."),
    "action_rate_per_s": Definition("actions change", "1/s",
        "Mean size of an action component's change from step to step, per second."),
    "power_net_w": Definition("power, net of armature", "W",
        "Mean over all physics steps of the summed sizes of the joints' mechanical power, (τ − I q̈) q̇. The armature I "
        "is subtracted, because swinging it back and forth takes no energy in the end."),
    "torque_rms_nm": Definition("torque, RMS", "N·m", "Root mean square over joints and physics steps."),
    "at_limit": Definition("at the effort limit", SHARE, "Share of the physics steps at 99 % of the limit or more."),
    "sign_changes_per_s": Definition("torque changes its sign", "1/s",
        "How often a joint's torque changes from more than a thousandth of its limit in one direction to more than a "
        "thousandth in the other."),
}  # fmt: skip

CONTACTS_ABOUT = (
    "The contact force on each link of an agent's robot (`contacts`). Of all episodes and environments, the figures "
    "cover the control steps at least 0.2 s after a reset in which the robot is tilted by less than 0.2 rad."
)
# CONTACTS defines the keys below `contacts.<sensor>` in figures.json, which describe a contact sensor's forces.
CONTACTS = {
    "mean_n": Definition("mean", "N",
        "Mean size of the net normal force at the end of these steps; 0 without contact."),
    "max_n": Definition("largest", "N", "Largest size of the net normal force at the end of a step."),
    "contact_share": Definition("in contact", SHARE, "Share of these steps with any force at their end."),
    "steps": Definition("steps", "", "Number of these steps."),
}  # fmt: skip


def rollout_label(key: str, settle_s: float | None) -> str:
    """Return a number's label, such as ``LABEL, after 1 s`` for a number that ignores an episode's first second."""
    if key in MOTION:
        return f"{MOTION[key].label}, {settled_window(settle_s)}"
    text = ROLLOUT[key].label
    return f"{text}, {settled_window(settle_s)}" if key.startswith(("height_", "pitch_")) else text


def settled_window(settle_s: float | None) -> str:
    """Return a text such as ``after 1 s``, which says that a number ignores the first second of each episode."""
    if settle_s is None:
        return "once settled"
    return f"after {settle_s:g} s" if settle_s else "from the start"


# --- drives ---

DRIVE_ABOUT = (
    "These figures cover one robot over all control steps of the drive, including its falls and restarts. There is one "
    "drive for each selected checkpoint and each selected ground."
)
# DRIVE defines the keys in figures.json and manifest.json that describe a session in which a user steers the robot.
DRIVE = {
    "duration_s": Definition("driven", "s", "Simulated time. Pauses, and the time for which falls are shown, are out."),
    "steps": Definition("control steps", "", "Number of control steps."),
    "distance_m": Definition("distance", "m", "Length of the path of the root link's origin over the ground plane."),
    "falls": Definition("fell", "", "Number of episodes that a termination ended, for each termination."),
    "resets": Definition("resets", "", "Number of resets by the user."),
    "pushes": Definition("pushes", "", "Number of pushes by the user."),
    "jumps": Definition("jumps", "", "Number of jumps that the user commanded."),
    "height_mean_m": Definition("base height, mean", "m", "Mean height of the root link's origin above the ground."),
    "reward": Definition("return", "", "Sum of the rewards of all steps."),
    "tracking_rmse": Definition("RMS error", "m/s, rad/s",
        "For each axis of the commands: root mean square of the robot's velocity minus the command, from the step in "
        "which the command was given."),
}  # fmt: skip


def drive_rows(figures: Mapping[str, object]) -> Iterator[tuple[str, str]]:
    """Yield table rows (label, value) about a session in which a user steers the robot."""
    for key, definition in DRIVE.items():
        value = figures[key]
        unit = f" {definition.unit}" if definition.unit else ""
        if isinstance(value, Mapping):
            yield from ((f"{definition.label}: {name}", _number_text(part)) for name, part in value.items())
            if key == "falls" and not value:
                yield definition.label, "never"
        else:
            yield definition.label, _number_text(value) + unit


def _number_text(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else f"{value}"


# --- recordings ---

RECORDED_ABOUT = (
    "A whole episode was recorded from start to end. Only whole episodes count in the figures of episodes; other "
    "episodes are just counted. An episode that was already running when the recording started is likely a long one, "
    "and an episode that has not ended has no sum of rewards. For a training without `--iteration`, `--from` and "
    "`--to`, the figures cover the last sample that contains a whole episode. Otherwise they cover all frames. They "
    "cover all recorded environments together, unless `--env` selects one."
)
_WHOLE = {
    "survival": Definition("survived", SHARE,
        "Share of the whole episodes that a time-out ended, without a failure in the same step."),
    "mean_duration_s": Definition("lasted, mean", "s", "Mean over the whole episodes."),
    "mean_reward": Definition("return, mean", "",
        "Mean over the whole episodes of the sum of rewards, not discounted."),
}  # fmt: skip
# RECORDED maps the title of each table of `wheelleg inspect` to the table's columns or rows, by JSON key.
RECORDED = {
    "samples": {
        "iterations": Definition("iterations", "", "Iterations of the sample's first and last frame."),
        "episodes": Definition("whole episodes", "", "Number of whole episodes."),
        "cut": Definition("cut off", "", "Number of episodes that were recorded in part."),
        **_WHOLE,
    },
    "episodes": {
        "count": Definition("episodes", "", "Number of whole episodes, and number of other episodes."),
        "ended_by": Definition("ended by", "",
            "Number of whole episodes for each ending. Each episode counts once: an episode that two terminations "
            "ended is listed under both names together."),
        "longest_s": Definition("lasted, longest", "s", "Duration of the longest whole episode."),
        **_WHOLE,
    },
    "base": {
        "mean": Definition("mean", "", "Mean of height (m), roll and pitch (rad) over the frames."),
        "std": Definition("std", "", "Standard deviation, over n."),
        "rms": Definition("RMS", "", "Root mean square of the value itself, not of its distance from the mean."),
        "minimum": Definition("least", "", "Smallest value."),
        "maximum": Definition("most", "", "Largest value."),
        "maximum_at": Definition("most at", "", "Time at which the largest value was first reached."),
    },
    "tracking": {
        "rmse": Definition("RMS error", "", "Root mean square of velocity minus command in the base's axes."),
        "mean": Definition("mean error", "", "Mean of velocity minus command, with its sign."),
        "largest": Definition("largest error", "", "Largest size of velocity minus command."),
        "mean_command": Definition("mean command", "", "Mean of the command."),
    },
    "contact forces": {
        "largest_n": Definition("largest", "N",
            "Largest size of the net normal force within the physics steps that the sensor stores (3: one and a half "
            "control steps). Older recordings contain the force at the end of a step only."),
        "at": Definition("at", "", "Time of the largest force."),
        "mean_n": Definition("mean", "N", "Mean size of the force at the end of the steps; 0 without contact."),
        "contact_share": Definition("in contact", SHARE, "Share of the frames with any force at their end."),
    },
    "efforts": {
        "rms": Definition("RMS", "N·m, or N", "Root mean square of the applied effort in the last physics step."),
        "largest": Definition("largest", "N·m, or N", "Largest size of the applied effort."),
        "limit": Definition("limit", "N·m, or N", "The joint's effort limit."),
        "saturated_share": Definition("at the limit", SHARE,
            "Share of the frames in which the effort is at the limit."),
    },
    "rewards": {
        "weight": Definition("weight", "", "The configured weight. A curriculum can change it during the training."),
        "mean": Definition("mean", "1/s", "Mean of the weighted value per second."),
        "share": Definition("share by size", SHARE, "Size of this term, as a share of the summed sizes of all terms."),
    },
    "events": {"times": Definition("times", "", "How often the event happened.")},
    "training": {
        "first": Definition("first", "", "Value in the first iteration that has one."),
        "last": Definition("last", "", "Value in the last iteration that has one."),
        "lowest": Definition("lowest", "", "Lowest value over the iterations, and its iteration."),
        "highest": Definition("highest", "", "Highest value over the iterations, and its iteration."),
    },
}  # fmt: skip


def recorded_headings(table: str, *keys: str) -> tuple[str, ...]:
    """Return the column headings of a table of ``wheelleg inspect``, with units; by default, of all columns."""
    return tuple(RECORDED[table][key].heading for key in keys or RECORDED[table])
