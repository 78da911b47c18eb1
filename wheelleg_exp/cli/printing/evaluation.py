"""How the metrics of an evaluation are printed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from wheelleg_exp.cli.printing.tables import hanging, print_table

_DEGREES = {"rad": "°", "rad/s": "°/s"}


def print_evaluation(content: Mapping[str, Any]) -> None:
    """Print what ``evaluation.json`` holds: one table for each group of metrics; angles in degrees."""
    about, protocol = content["about"], content["protocol"]
    dt, step = about.get("physics_dt_s"), about.get("step_dt_s")
    print(f"protocol {protocol['name']}, seed {content['seed']}, scenarios {content['scenarios_sha256'][:12]}")
    print(f"robot profile {about.get('profile')}, {about.get('engine')}, physics step {dt:.6g} s, control {step:.6g} s")
    for group, found in groupby(content["metrics"], lambda name: name.split("/")[0]):
        print()
        names = list(found)
        rows = [_row(name, content["metrics"][name]) for name in names if content["metrics"][name]["episodes"]]
        print_table((group, "value", "95 % interval", "unit", "episodes"), rows)
        print_untold([name.split("/", 1)[1] for name in names if not content["metrics"][name]["episodes"]])


def print_untold(names: Sequence[str]) -> None:
    """Say of which metrics there is nothing to tell, as of the drift of robots that all fell at once."""
    if names:
        print(hanging(f"no episode tells of: {', '.join(names)}", 4))


def _row(name: str, figure: Mapping[str, Any]) -> tuple[str, str, str, str, str]:
    unit = figure["unit"]
    factor = 180.0 / math.pi if unit in _DEGREES else 1.0
    value, low, high = (_number(figure[key], factor) for key in ("value", "low", "high"))
    between = "-" if "-" in (low, high) else f"{low} to {high}"
    return name.split("/", 1)[1], value, between, _DEGREES.get(unit, unit), str(figure["episodes"])


def _number(value: float | None, factor: float) -> str:
    return "-" if value is None else f"{value * factor:.4g}"
