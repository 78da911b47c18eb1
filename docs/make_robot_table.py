"""Write the table of docs/robots.md and its pictures.

    MUJOCO_GL=egl python docs/make_robot_table.py DETAILS PIPELINE [...]

Each PIPELINE is the folder of ``wheelleg train pipeline=first_drive`` for one robot, ``runs/pipelines/<time>``.
DETAILS is a JSON file that maps the name of a robot's config to ``name``, ``file``, and ``source``.
The rows are added to ``docs/tables/robots.json``, from which the table is written, also without arguments.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Mapping
from datetime import timedelta
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from images.make_robots import drawn, scene
from PIL import Image

from wheelleg_exp.evaluation.lqr_balancer import Reference
from wheelleg_exp.files import dump_json, write_text
from wheelleg_exp.jobs.saved_evaluation import RESULT, read_content
from wheelleg_exp.run import run_config
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_index import PipelineIndex
from wheelleg_exp.run.timestamps import parse_utc

DOCS = Path(__file__).parent
ROWS, PAGE, PICTURES = DOCS / "tables" / "robots.json", DOCS / "robots.md", DOCS / "images" / "robots"
PROTOCOL = "first_drive"
START, END = "<!-- robots: written by docs/make_robot_table.py -->", "<!-- end of robots -->"
TITLES = (
    *("", "robot", "kg", "h, m", "leg joints", "iterations, walk + realism", "min", "survived", "with all errors"),
    *("drift in 60 s", "commands within 10 %", "error of the speed", "kick, worst of 8", "delay", "slope", "payload"),
)
HEAD = f"| {' | '.join(TITLES)} |\n|{'---|' * len(TITLES)}\n"
METRICS = ("*/survival", "stand/drift", "walk/*_area", "walk/error_vx_steady", "push/limit_worst_0s", "robust/margin/*")
TILE = 160  # px


def row_of(run: RunDirectory, details: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the newest evaluations of a run with the protocol measured, for the policy and the reference."""
    env, _ = run_config.load_params(run)
    robot: Mapping[str, Any] = env["robot"]
    found = [read_content(path.parent) for path in sorted(run.evaluation.glob(f"*/{RESULT}"))]
    row: dict[str, Any] = {
        **details[robot["profile"]],
        **{key: robot[key] for key in ("size", "mass")},
        "legs": len(robot["joint_sets"]["legs"]),
        "wheels": len(robot["joint_sets"]["wheels"]),
    }
    for content in found:
        values = {name: figure["value"] for name, figure in content["metrics"].items()}
        if content["protocol"]["name"] == PROTOCOL:
            who = "reference" if content.get("policy") == Reference.name else "policy"
            row[who] = {name: value for name, value in values.items() if any(map(partial(fnmatchcase, name), METRICS))}
        elif content["protocol"]["realism"] == "own":
            row["with_errors"] = values["walk/survival"]
    return row


def line_of(name: str, row: Mapping[str, Any]) -> str:
    """Return a row of the table; the reference's figures follow the policy's in brackets."""

    def both(metric: str, unit: str, scale: float = 1.0, digits: int = 2) -> str:
        made = [row[who].get(metric) for who in ("policy", "reference") if who in row]
        texts = ["–" if value is None else f"{float(f'{scale * value:.{digits}g}'):g}{unit}" for value in made]
        return f"{texts[0]} ({texts[1]})" if len(texts) > 1 else "".join(texts)

    speed = math.sqrt(9.81 * row["size"])
    survived = [row["policy"][f"{test}/survival"] for test in ("stand", "walk", "steps")] if "policy" in row else []
    cells = [
        f"![{row['name']}](images/robots/{name}.png)",
        f"{row['name']} ({row['file']}, {row['source']})",
        f"{row['mass']:.3g}",
        f"{row['size']:.2g}",
        str(row["legs"]),
        f"{row['iterations']}",
        "–" if row["minutes"] is None else f"{row['minutes']:.0f}",
        f"{100 * min(survived):.3g} %" if survived else row["why"],
        f"{100 * row['with_errors']:.0f} %" if "with_errors" in row else "",
        both("stand/drift", " mm", 1e3),
        both("walk/commandable_area", " %", 100, 3),
        both("walk/error_vx_steady", " mm/s", 1e3),
        both("push/limit_worst_0s", " √(g·h)", 1 / speed),
        both("robust/margin/delay", " ms", 1e3),
        both("robust/margin/slope", "°", 180 / math.pi),
        both("robust/margin/payload", " %", 100 / row["mass"]),
    ]
    return f"| {' | '.join(cells)} |\n"


def picture(run: RunDirectory, to: Path) -> None:
    """Draw the robot of a run in its default pose, from the front left."""
    robot = run_config.load_params(run)[0]["robot"]
    model, data = scene(run.asset / "robot.xml")
    for joint in range(model.njnt):
        name, at = model.joint(joint).name, model.jnt_qposadr[joint]
        values = [v for key, v in robot["init_state"]["joint_pos"].items() if re.fullmatch(key, name)]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            data.qpos[at + 3 : at + 7] = robot["init_state"]["rot"]
        elif values:
            data.qpos[at] = values[0]
    mujoco.mj_forward(model, data)
    looks = model.geom_group < 3  # They hide the colliders of the same body.
    model.geom_rgba[~looks & np.isin(model.geom_bodyid, model.geom_bodyid[looks]), 3] = 0.0
    image = drawn(model, data).resize((TILE, TILE), Image.Resampling.LANCZOS)
    to.parent.mkdir(exist_ok=True)
    image.quantize(64).save(to, optimize=True)


def main(words: list[str]) -> None:
    """Add the rows of the given runs, draw their robots, and write the table."""
    rows: dict[str, Any] = json.loads(ROWS.read_text()) if ROWS.is_file() else {}
    details = json.loads(Path(words[0]).read_text()) if words else {}
    for word in words[1:]:
        index = PipelineIndex.load(word)
        started = [phase for phase in index.phases if phase["run"]]
        run = RunDirectory(Path(index.run_of(started[-1]) or word))
        name = run_config.load_params(run)[0]["robot"]["profile"]
        finished = index.phases[-1]["status"] == "passed"
        is_whole = index.data["status"] == "finished" and not index.data["resumes"]
        took = parse_utc(str(started[-1]["ended"])) - parse_utc(index.data["started"]) if is_whole else timedelta()
        rows[name] = {
            **row_of(run, details),
            "minutes": took.total_seconds() / 60 or None,
            "iterations": " + ".join(str(phase["trained"]) for phase in index.phases),
            "why": None if finished else f"gate of {started[-1]['name']}: {'; '.join(started[-1]['gates'][-1]['why'])}",
        }
        picture(run, PICTURES / f"{name}.png")
    write_text(ROWS, dump_json(dict(sorted(rows.items()))) + "\n")
    before, rest = PAGE.read_text().split(START)
    table = HEAD + "".join(line_of(name, row) for name, row in sorted(rows.items()))
    write_text(PAGE, f"{before}{START}\n{table}{END}{rest.split(END)[1]}")


if __name__ == "__main__":
    main(sys.argv[1:])
