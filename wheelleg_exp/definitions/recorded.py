"""What is made of a recording's rows: the tables of ``wheelleg inspect``, and those of a report that are the same."""

from __future__ import annotations

from wheelleg_exp.definitions.definition import SHARE, Definition

ABOUT = (
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
TABLES = {
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


def headings(table: str, *keys: str) -> tuple[str, ...]:
    """Return the headings of a table's columns with their units, by default of all."""
    return tuple(TABLES[table][key].heading for key in keys or TABLES[table])


def label(table: str, key: str) -> str:
    """Return the label of a figure."""
    return TABLES[table][key].label
