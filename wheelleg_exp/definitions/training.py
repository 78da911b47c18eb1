"""The scalars of a training, by Isaac Lab's and rsl_rl's keys, and what is made of them."""

from __future__ import annotations

import re
from dataclasses import replace

from wheelleg_exp.definitions.definition import SHARE, STEPS, Definition

LAST = "the last 100 ended episodes"
EPISODE_REWARD = "sum of an episode / longest episode's seconds"
_ALL = "all environments"
_ENDED = "the iteration's ended episodes"
_STEPS = "all control steps of all environments in the iteration"
_NAME = re.compile(r"<(\w+)>")

ABOUT = (
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
        f"Size of velocity minus command in the base's axes, mean over {_STEPS}.",
        _STEPS,
    ),
    "Metrics_per_step/<command>/error_vel_yaw": Definition(
        "yaw rate error (<command>)", "rad/s", f"Size of yaw rate minus command, mean over {_STEPS}.", _STEPS
    ),
    "Metrics_per_step/<command>/<metric>": Definition(
        "<metric> (<command>)", "", f"A command's own error, mean over {_STEPS}.", _STEPS
    ),
    "Rewards_per_step/<term>": Definition(
        "<term>, reward per second", "1/s", f"The weighted term per second, mean over {_STEPS}.", _STEPS
    ),
    "Terminations_per_step/<term>": Definition(
        "steps that <term> ended", SHARE, f"Of {_STEPS}: those in which this termination ended an episode.", _STEPS
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


def title(key: str) -> str:
    """Return what stands over a curve of a scalar: its label and, of a running mean, what that is of."""
    found = scalar(key)
    if found is None:
        return key
    text = f"{found.label} of {found.of}" if found.of == LAST else found.label
    return text[:1].upper() + text[1:]


def scalar(key: str) -> Definition | None:
    """Return the definition of a scalar, its label with the names of the key; None for one of another program."""
    for pattern, found in SCALARS.items():
        match = re.fullmatch(_NAME.sub(r"(?P<\1>.+)", pattern), key)
        if match:
            label = found.label
            for name, value in match.groupdict().items():
                label = label.replace(f"<{name}>", value)
            return replace(found, label=label)
    return None
