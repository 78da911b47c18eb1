"""How figures are printed by the commands that run a policy or an agent."""

from __future__ import annotations

import math
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp.cli.printing.tables import hanging, print_table
from wheelleg_exp.definitions.definition import percent
from wheelleg_exp.definitions.rollout import CONTACTS, label

if TYPE_CHECKING:
    from wheelleg_exp.jobs.figures import ContactFigures, StandFigures

_SETTLED = ("height_rmse_m", "height_mean_m", "pitch_rms_deg", "pitch_mean_deg")  # leave out how an episode begins


def print_figures(figures: StandFigures) -> None:
    """Print how a policy stood, each figure with what it is of."""
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
        (label("episodes", None), f"{figures.episodes}", "the first of each environment"),
        *(((label("unfinished", None), f"{figures.unfinished}", ""),) if figures.unfinished else ()),
        *((label(key, figures.settle_s), value, of[key]) for key, value in values.items()),
        *((f"{label('ended_by', None)} {name}", f"{count}", "") for name, count in figures.ended_by.items()),
    ]
    of_numbers = label("non_finite", None)
    rows += [(f"{of_numbers}: {key}", f"{count}", "episodes") for key, count in figures.non_finite.items()]
    print_table(("figure", "value", "of"), rows)


def print_contacts(sensor: str, rows: list[ContactFigures]) -> None:
    """Print what each link carried while the robot stood."""
    from wheelleg_exp.jobs.agents import SETTLE_S, UPRIGHT_RAD

    steps = _counted(rows[0].steps if rows else 0, "step")
    words = (
        f"{sensor}: normal force at the end of a step, of {steps} of all episodes and environments, "
        f"from {SETTLE_S:g} s after a reset on with a tilt below {UPRIGHT_RAD:g} rad"
    )
    print(f"\n{hanging(words, 0)}")
    cells = [(r.body, f"{r.mean_n:.3f}", f"{r.max_n:.3f}", percent(r.contact_share)) for r in rows]
    print_table(("link", *(CONTACTS[key].heading for key in ("mean_n", "max_n", "contact_share"))), cells)


def print_recording(path: Path | None) -> None:
    """Print how to look at a recording."""
    if path is not None:
        print(f"\nrecording: {shown(path)}\nopen it:   {tool('rerun')} {shown(path)}")


def tool(name: str) -> str:
    """Return how a program that came with this one is called from here: by name where it is on the PATH."""
    beside = Path(sys.executable).parent / name
    return name if shutil.which(name) or not beside.exists() else shown(beside)


def shown(path: Path) -> str:
    """Return a path as one would type it from here."""
    here = Path.cwd()
    return str(path.relative_to(here)) if path.is_relative_to(here) else str(path)


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
