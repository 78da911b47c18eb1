"""Write the table, the plot, and the pictures of docs/arena.md.

    MUJOCO_GL=egl python docs/make_arena.py DETAILS

DETAILS is a JSON file that maps a row's name to ``policy``, ``source``, ``licence``, ``trained``, ``proof``, and
``run``, the run directory with evaluations of ``protocol=arena``; the newest of each test counts. ``physx`` is the run
directory with evaluations of the engine ``physx``, if they are not in ``run``. The rows are added to
``docs/tables/arena.json``, and replace rows of the same names. The page is written from that file, also without
arguments.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
from make_robot_table import DOCS, picture

from wheelleg_exp.files import dump_json, write_text
from wheelleg_exp.jobs.saved_evaluation import RESULT, read_content
from wheelleg_exp.run import run_config
from wheelleg_exp.run.run_directory import RunDirectory

ROWS, PAGE, PICTURES = DOCS / "tables" / "arena.json", DOCS / "arena.md", DOCS / "images" / "arena"
START, END = "<!-- arena: written by docs/make_arena.py -->", "<!-- end of arena -->"
# Title, metric, unit, factor, and whether the figure is divided by √(g·h), by the mass, or by the largest command.
COLUMNS: tuple[tuple[str, str, str, float, str], ...] = (
    ("stands 60 s", "stand/survival", " %", 100, ""),
    ("creep", "stand/drift_speed", " mm/s", 1e3, ""),
    ("drives", "walk/survival", " %", 100, ""),
    ("gain of the speed", "walk/gain_vx", "", 1, ""),
    ("gain of the yaw rate", "walk/gain_wz", "", 1, ""),
    ("stop distance", "steps/stop_distance_vx", " mm", 1e3, ""),
    ("kick, worst of 8", "push/limit_worst_0s", " √(g·h)", 1, "speed"),
    ("push of 0.15 s", "push/limit_worst_0.15s", " √(g·h)", 1, "speed"),
    ("delay", "robust/margin/delay", " ms", 1e3, ""),
    ("noise", "robust/margin/noise", "", 1, ""),
    ("friction 0.2", "robust/friction/0.2/survival", " %", 100, ""),
    ("slope", "robust/margin/slope", "°", 180 / math.pi, ""),
    ("payload", "robust/margin/payload", " %", 100, "mass"),
    ("step up", "terrain/levels_passed/step_up", " r", 0.25, ""),
    ("step down", "terrain/levels_passed/step_down", " r", 0.25, ""),
    ("cost of transport", "walk/cost_of_transport_net", "", 1, ""),
    ("chatter", "walk/fast_power_share", " %", 100, ""),
    ("torque of the legs", "walk/torque_share_legs", " %", 100, ""),
    ("torque of the wheels", "walk/torque_share_wheels", " %", 100, ""),
)
# The figures of the plot, each with the value that reaches the right edge.
DOTS = {
    "drives": 100,
    "kick, worst of 8": 2,
    "push of 0.15 s": 2.5,
    "delay": 100,
    "slope": 29,
    "payload": 400,
    "step up": 1.5,
}


def measured(run: RunDirectory, engine: str) -> tuple[dict[str, list[float]], dict[str, Any]]:
    """Return the figures of a run's newest evaluations with the protocol in an engine, and facts about the newest."""
    contents = [read_content(path.parent) for path in sorted(run.evaluation.glob(f"*/{RESULT}"))]
    found = [c for c in contents if (c["protocol"]["name"], c["about"]["engine"]) == ("arena", engine)]
    metrics = {name: value for content in found for name, value in content["metrics"].items()}
    shown = {
        metric: [metrics[metric][part] for part in ("value", "low", "high")]
        for _, metric, *_ in COLUMNS
        if metrics.get(metric, {}).get("value") is not None
    }
    return shown, found[-1]["about"] if found else {}


def row_of(run: RunDirectory, details: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row with the metrics of a run's newest evaluations."""
    env, _ = run_config.load_params(run)
    found, about = measured(run, "mujoco")
    second, engine = measured(RunDirectory(Path(details.get("physx", details["run"]))), "physx")
    if not found:
        raise SystemExit(f"{run.path} has no evaluation of protocol=arena")
    robot, ranges = env["robot"], env["commands"]["base_velocity"]["ranges"]
    return {
        **{key: value for key, value in details.items() if key not in ("run", "physx")},
        "mass": about["mass_kg"],
        "size": robot.get("size") or details.get("size"),  # old run directories lack it
        "commands": [max(map(abs, ranges[axis])) for axis in ("lin_vel_x", "ang_vel_z")],
        "versions": {"MuJoCo": about["mujoco"], **({"ovphysx": engine["promise"]["version"]} if second else {})},
        "figures": found,
        "physx": second,
    }


def figures(row: Mapping[str, Any], column: tuple[str, str, str, float, str], of: str = "figures") -> list[float]:
    """Return a figure of a row in the unit of its column, and the ends of its interval; empty if it is missing.

    ``of`` is the row's key: ``figures`` for MuJoCo's, ``physx`` for PhysX's.
    """
    _, metric, _, factor, by = column
    divisor = {"": 1.0, "mass": row["mass"], "speed": math.sqrt(9.81 * row["size"]) if row["size"] else math.nan}[by]
    return [factor * value / divisor for value in row.get(of, {}).get(metric, [])]


def table(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table of all rows, and their details."""
    titles = ["", "policy", "kg", "h, m", "commands", "proof", *(column[0] for column in COLUMNS)]
    lines = [titles, ["---"] * len(titles)]
    for name, row in rows.items():
        cells = [f"![{row['policy']}](images/arena/{name}.png)", row["policy"], f"{row['mass']:.3g}"]
        cells.append("–" if row["size"] is None else f"{row['size']:.2g}")
        cells += ["{:.3g} m/s, {:.3g} rad/s".format(*row["commands"]), row["proof"]]
        for column in COLUMNS:
            found = figures(row, column)
            value, low, high = map(_number, found) if found else "–  "
            spread = f" ({low}…{high})" if low != high else ""
            cells.append(f"{value}{column[2]}{spread}" if found else "–")
        lines.append(cells)
    text = "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
    about = "".join(f"- **{r['policy']}**: {r['source']}, {r['licence']}; {r['trained']}.\n" for r in rows.values())
    return f"![Figures of all policies](images/arena/dots.png)\n\n{both(rows)}\n{text}\n{about}"


def _number(one: float) -> str:
    return f"{one:.2g}" if abs(one) < 100 else f"{one:.0f}"


def both(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table of the figures that PhysX confirms, by 10 % or 2 points of survival, and of the others."""
    versions = sorted({f"{name} {version}" for row in rows.values() for name, version in row["versions"].items()})
    shown = [row for row in rows.values() if row["physx"]]
    columns = [column for column in COLUMNS if any(column[1] in row["physx"] for row in shown)]
    lines = [["policy", "agree", *(column[0] for column in columns)], ["---"] * (len(columns) + 2)]
    for row in shown:
        cells = []
        for column in columns:
            ours, theirs = figures(row, column), figures(row, column, "physx")
            if not (ours and theirs):
                cells.append("–")
                continue
            limit = 2.0 if column[1].endswith("survival") else 0.1 * abs(ours[0])
            differs = f"**{_number(ours[0])} → {_number(theirs[0])}{column[2]}**"
            cells.append("✓" if abs(ours[0] - theirs[0]) <= limit + 1e-6 else differs)
        known = len(cells) - cells.count("–")
        lines.append([row["policy"], f"{cells.count('✓')} of {known}", *cells])
    table = "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
    rule = "✓ marks figures that differ by at most 10 %, or by 2 points of survival"
    return f"MuJoCo → PhysX, hollow in the plot ({', '.join(versions)}); {rule}:\n\n{table}"


def _is_outside(row: Mapping[str, Any]) -> bool:
    return bool(row["proof"] != "–")


def plot(rows: Mapping[str, Mapping[str, Any]]) -> None:
    """Draw one row of dots per property, further to the right is better.

    Stock policies are squares. Hollow dots are PhysX's.
    """
    columns = [column for column in COLUMNS if column[0] in DOTS]
    figure, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    for place, row in enumerate(rows.values()):
        heights = [index + 0.06 * (place - len(rows) / 2) for index in range(len(columns))]
        marker, colour = "o" if _is_outside(row) else "s", plt.get_cmap("tab20")(place)
        for of, look in (("figures", {"label": row["policy"]}), ("physx", {"markerfacecolor": "none"})):
            shown = [(figures(row, column, of) or [math.nan])[0] / DOTS[column[0]] for column in columns]
            axes.plot(shown, heights, marker, color=colour, markersize=6, **look)
    axes.plot([], [], "o", color="grey", markersize=6, markerfacecolor="none", label="hollow: PhysX")
    axes.set_yticks(range(len(columns)), [f"{c[0]}, up to {DOTS[c[0]]:g}{c[2]}" for c in columns])
    axes.invert_yaxis()
    axes.set_xlim(-0.03, 1.1)
    axes.set_xticks([])
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1, 0.5))
    PICTURES.mkdir(exist_ok=True)
    figure.savefig(PICTURES / "dots.png", dpi=110)


def main(words: list[str]) -> None:
    """Add the rows of the given runs, draw their robots, and write the page."""
    rows: dict[str, Any] = json.loads(ROWS.read_text()) if ROWS.is_file() else {}
    for name, details in (json.loads(Path(words[0]).read_text()) if words else {}).items():
        run = RunDirectory(Path(details["run"]))
        rows[name] = row_of(run, details)
        picture(run, PICTURES / f"{name}.png")
    rows = dict(sorted(rows.items(), key=lambda item: not _is_outside(item[1])))
    write_text(ROWS, dump_json(rows) + "\n")
    plot(rows)
    before, rest = PAGE.read_text().split(START)
    write_text(PAGE, f"{before}{START}\n{table(rows)}{END}{rest.split(END)[1]}")


if __name__ == "__main__":
    main(sys.argv[1:])
