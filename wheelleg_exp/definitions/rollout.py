"""The figures of plays and agents: of the first episode of each environment."""

from __future__ import annotations

from wheelleg_exp.definitions.definition import SHARE, Definition

ABOUT = (
    "Of the first episode of each environment. Height and pitch are over all control steps after `settle_s` of all "
    "these episodes together: who falls counts until then, and who stands longer counts for more; the label says "
    "after how many seconds."
)
# By the keys of figures.json and of the manifest's additions.
FIGURES = {
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


def label(key: str, settle_s: float | None) -> str:
    """Return the label of a figure with the part of an episode that it is of; ``settle_s`` is None where not known."""
    if key in MOTION:
        return f"{MOTION[key].label}, {window(settle_s)}"
    text = FIGURES[key].label
    return f"{text}, {window(settle_s)}" if key.startswith(("height_", "pitch_")) else text


def window(settle_s: float | None) -> str:
    """Return which part of an episode height and pitch are of, in words."""
    if settle_s is None:
        return "once settled"
    return f"after {settle_s:g} s" if settle_s else "from the start"
