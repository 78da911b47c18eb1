"""Writes the tables of isaaclab.md from the code itself: what Isaac Lab has by name, and what is here of it.

    python docs/make_isaaclab.py

isaaclab_names.yaml lists Isaac Lab 2.3.2's names and, where something is not here, why. A test holds the page.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from wheelleg_exp.build import build_env
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.isaaclab.envs import mdp
from wheelleg_exp.isaaclab.utils import math
from wheelleg_exp.sim.absent import absent_members

FOLDER = Path(__file__).resolve().parent
MARK = "<!-- Made by docs/make_isaaclab.py. -->"


def names() -> dict[str, Any]:
    """Return the names of Isaac Lab by class or module, and the reasons for what is absent."""
    found: dict[str, Any] = yaml.safe_load((FOLDER / "isaaclab_names.yaml").read_text(encoding="utf-8"))
    return found


def holders() -> dict[str, Any]:
    """Return what has the names here, alive."""
    more = "+sensor@env.scene.sensors=[height_scanner,depth_camera,imu]"
    env = build_env(compose(["task=stand", "env.num_envs=1", "env.sim.nthread=1", more]).config)
    managers = {f"{name}Manager": getattr(env, f"{name.lower()}_manager") for name in (
        "Action", "Command", "Observation", "Event", "Reward", "Termination", "Curriculum"
    )}  # fmt: skip
    return {
        "ArticulationData": env.scene.robot.data,
        "Articulation": env.scene.robot,
        "ManagerBasedRLEnv": env,
        "InteractiveScene": env.scene,
        **managers,
        "ContactSensorData": env.scene.sensors["contact_forces"].data,
        "RayCasterData": env.scene.sensors["height_scanner"].data,
        "CameraData": env.scene.sensors["depth_camera"].data,
        "ImuData": env.scene.sensors["imu"].data,
        "mdp": mdp,
        "utils.math": math,
    }


def rows(section: str, holder: Any, reasons: dict[str, str], listed: list[str]) -> Iterator[tuple[str, str]]:
    """Yield each name and what is said of it; an empty text where nobody says why it is absent."""
    absent = absent_members(type(holder))
    for name in listed:
        if name in absent:
            yield name, f"absent: {absent[name]}"
        elif name in vars(holder) or hasattr(type(holder), name):
            yield name, _told(holder, name)
        else:
            why = next((why for key, why in reasons.items() if re.fullmatch(key, f"{section}.{name}")), "")
            yield name, f"absent: {why}" if why else ""


def _told(holder: Any, name: str) -> str:
    member = getattr(type(holder), name, None) or vars(holder).get(name)
    text = (getattr(member, "__doc__", None) or "") if callable(member) or isinstance(member, property) else ""
    kinds = type(holder).__mro__ if not text else ()
    lines = [line.strip() for kind in kinds for line in (kind.__doc__ or "").splitlines()]
    said = next((line.split(":", 1)[1].strip() for line in lines if line.startswith(f"{name}:")), "")
    return (text.strip().splitlines() or [""])[0] or said or "as in Isaac Lab"


def tables() -> str:
    """Return all tables."""
    data = names()
    parts = []
    found = holders()
    for section, listed in data["names"].items():
        holder = found[section] if section in found else found["mdp"]
        told = list(rows(section, holder, data["absent"], listed))
        here = [name for name, text in told if not text.startswith("absent")]
        parts.append(f"### `{section}`: {len(here)} of {len(listed)}\n")
        parts.append("| name | here |\n|---|---|")
        parts += [f"| `{name}` | {text.replace('|', chr(92) + '|')} |" for name, text in told]
        parts.append("")
    return "\n".join(parts)


def page() -> str:
    """Return the page with its tables made anew."""
    text = (FOLDER / "isaaclab.md").read_text(encoding="utf-8")
    return text[: text.index(MARK)] + f"{MARK}\n\n{tables()}"


if __name__ == "__main__":
    (FOLDER / "isaaclab.md").write_text(page(), encoding="utf-8")
