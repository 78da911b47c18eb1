"""The figures of drives, by hand or by a script."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from wheelleg_exp.definitions.definition import Definition

ABOUT = (
    "Of one robot over all control steps of the drive, its falls and new starts included. There is one drive for each "
    "checkpoint and each ground that was chosen."
)
# By the keys of figures.json below play/, and of the manifest's additions of kind `drive`.
FIGURES = {
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


def rows(figures: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return figures as rows of a table: label and value."""
    found = []
    for key, definition in FIGURES.items():
        value = figures[key]
        unit = f" {definition.unit}" if definition.unit else ""
        if isinstance(value, Mapping):
            found += [(f"{definition.label}: {name}", _shown(part)) for name, part in value.items()]
            found += [] if value or key != "falls" else [(definition.label, "never")]
        else:
            found.append((definition.label, _shown(value) + unit))
    return found


def _shown(value: float) -> str:
    return f"{value}" if isinstance(value, int) else f"{value:.3f}"
