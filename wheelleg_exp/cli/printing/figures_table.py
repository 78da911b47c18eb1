"""Print the figures of plays and agents."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp.cli.printing.terminal import hanging, print_table
from wheelleg_exp.definitions import CONTACTS, MOTION, percent, rollout_label

if TYPE_CHECKING:
    from wheelleg_exp.jobs.rollout_figures import ContactFigures, MotionFigures, StandFigures


_SETTLED = ("height_rmse_m", "height_mean_m", "pitch_rms_deg", "pitch_mean_deg")  # do not cover the settling time

_MOTION: Mapping[str, Callable[[float], str]] = {
    "drift_m": lambda value: f"{1e3 * value:.1f} mm",
    "yaw_drift_deg": lambda value: f"{value:.2f} deg",
    "action_rate_per_s": lambda value: f"{value:.2f} /s",
    "power_net_w": lambda value: f"{value:.3f} W",
    "torque_rms_nm": lambda value: f"{value:.4f} N·m",
    "at_limit": percent,
    "sign_changes_per_s": lambda value: f"{value:.1f} /s",
}


def print_figures(figures: StandFigures, motion: MotionFigures | None = None) -> None:
    """Print the figures of standing and moving, each with the steps or episodes that it covers."""
    ended, settled = _counted(figures.ended, "ended episode"), _settled(figures)
    of = {"survival": ended, "mean_return": ended, **dict.fromkeys(_SETTLED, settled)}
    values = {
        "survival": _share(figures.survival),
        "height_rmse_m": _millimetres(figures.height_rmse_m),
        "height_mean_m": _millimetres(figures.height_mean_m),
        "pitch_rms_deg": _degrees(figures.pitch_rms_deg),
        "pitch_mean_deg": _degrees(figures.pitch_mean_deg),
        "mean_return": "-" if figures.mean_return is None else f"{figures.mean_return:.2f}",
    }
    rows = [
        (rollout_label("episodes", None), f"{figures.episodes}", "the first of each environment"),
        *(((rollout_label("unfinished", None), f"{figures.unfinished}", ""),) if figures.unfinished else ()),
        *((rollout_label(key, figures.settle_s), value, of[key]) for key, value in values.items()),
        *(() if motion is None else _motion(motion, figures)),
        *((f"{rollout_label('ended_by', None)} {name}", f"{count}", "") for name, count in figures.ended_by.items()),
    ]
    of_numbers = rollout_label("non_finite", None)
    rows += [(f"{of_numbers}: {key}", f"{count}", "episodes") for key, count in figures.non_finite.items()]
    print_table(("figure", "value", "of"), rows)


def print_contacts(sensor: str, rows: list[ContactFigures]) -> None:
    """Print the contact force on each link while the robot stood."""
    from wheelleg_exp.jobs.run_agent import SETTLE_S, UPRIGHT_RAD

    steps = _counted(rows[0].steps if rows else 0, "step")
    words = (
        f"{sensor}: normal force at the end of a step, over {steps} of all episodes and environments, "
        f"at least {SETTLE_S:g} s after a reset and with a tilt below {UPRIGHT_RAD:g} rad"
    )
    print(f"\n{hanging(words, 0)}")
    cells = [(r.body, f"{r.mean_n:.3f}", f"{r.max_n:.3f}", percent(r.contact_share)) for r in rows]
    print_table(("link", *(CONTACTS[key].heading for key in ("mean_n", "max_n", "contact_share"))), cells)


def print_recording(path: Path | None) -> None:
    """Print the path of a recording, and the command that opens it."""
    if path is not None:
        print(f"\nrecording: {shown(path)}\nopen it:   {tool('rerun')} {shown(path)}")


def tool(name: str) -> str:
    """Return the command for a program of this environment: its name, or its path if it is not on the PATH."""
    installed = Path(sys.executable).parent / name
    return name if shutil.which(name) or not installed.exists() else shown(installed)


def shown(path: Path) -> str:
    """Return a path relative to the current folder, if it is inside."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


def _motion(motion: MotionFigures, figures: StandFigures) -> Iterator[tuple[str, str, str]]:
    """Yield a row for each figure of motion, and one for each actuator group if the figure has several values."""
    ways, settled = _counted(figures.settled_episodes, "episode"), _settled(figures)
    found = motion.as_dict()
    for key, shown in _MOTION.items():
        name, value = rollout_label(key, figures.settle_s), found[key]
        of = ways if MOTION[key].label.startswith(("strayed", "turned")) else settled
        if isinstance(value, dict):
            yield from ((f"{name} ({group})", shown(each), of) for group, each in value.items())
        else:
            yield name, "-" if value is None else shown(value), of


def _settled(figures: StandFigures) -> str:
    if not figures.settled_steps:
        return "no episode lasted that long"
    return f"{_counted(figures.settled_steps, 'step')} of {_counted(figures.settled_episodes, 'episode')}"


def _counted(count: int, one: str) -> str:
    return f"{count} {one}" if count == 1 else f"{count} {one}s"


def _share(value: float | None) -> str:
    return "-" if value is None else percent(value)


def _millimetres(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{1e3 * value:.2f} mm"


def _degrees(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f} deg"
