"""How figures are printed by the commands that run a policy or an agent."""

from __future__ import annotations

import math
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from wheelleg_exp.cli.common import print_table

if TYPE_CHECKING:
    from wheelleg_exp.jobs.figures import ContactFigures, StandFigures


def print_figures(figures: StandFigures) -> None:
    """Print how a policy stood."""
    rows = [
        ("episodes", f"{figures.episodes}"),
        *((("still running", f"{figures.unfinished}"),) if figures.unfinished else ()),
        ("survived to the time-out", f"{figures.survival:.1%}"),
        ("base height, RMSE to target", _millimetres(figures.height_rmse_m)),
        ("base height, mean", _millimetres(figures.height_mean_m)),
        ("pitch, RMS", _degrees(figures.pitch_rms_deg)),
        ("pitch, mean", _degrees(figures.pitch_mean_deg)),
        ("mean return", f"{figures.mean_return:.2f}"),
        *((f"ended by {name}", f"{count}") for name, count in figures.ended_by.items()),
    ]
    print_table(("figure", "value"), rows)


def print_contacts(sensor: str, rows: list[ContactFigures]) -> None:
    """Print what each link carried while the robot stood."""
    cells = [(r.body, f"{r.mean_n:.3f}", f"{r.max_n:.3f}", f"{r.contact_share:.1%}") for r in rows]
    print(f"\n{sensor}: normal force between landing and tipping over")
    print_table(("link", "mean (N)", "largest (N)", "in contact"), cells)


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


def _millimetres(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{1e3 * value:.2f} mm"


def _degrees(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.2f} deg"
