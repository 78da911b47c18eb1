"""Play chirps on the joints, one after another, for ``wheelleg identify LOG``; ``python chirps.py LOG.csv`` simulates.

Hang up the robot by its base, or clamp the base, so that legs and wheels move freely. On the robot:

    chirps, rows = Chirps(json.load(open("policy.json"))), []
    for step in range(chirps.steps):                   # every step_dt seconds
        readings = read_sensors()                      # joint_pos, joint_vel, joint_effort, projected_gravity
        send(chirps.targets(step))                     # position, velocity, effort of all joints
        rows.append(chirps.row(step * chirps.dt, readings, step))
    write("chirps.csv", rows)

Each joint rests for 1.5 s, then moves for ``SECONDS``: first from low to high frequency, later from high to low. A
joint with a stiffness follows position targets, a joint without stiffness follows velocity targets. ``scale`` shrinks
all amplitudes.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SECONDS, REST = 6.0, 1.5
LOWEST, HIGHEST = 0.3, 8.0  # Hz; the frequency grows exponentially, and is limited to an eighth of the control rate.
AMPLITUDE, SPEED = 0.3, 0.3  # rad; share of the velocity limit
EFFORT = 0.5  # largest planned share of the effort limit


class Chirps:
    """The targets of all joints over time: J joints, two chirps each."""

    def __init__(self, spec: Any, scale: float = 1.0) -> None:
        self.spec, self.dt, self.scale = spec, spec["step_dt"], scale
        self.default = np.array(spec["default_joint_pos"], float)
        self.rest, self.length = round(REST / self.dt), round((SECONDS + REST) / self.dt)
        self.driven = [i for drive in spec["actuators"] for i in drive["joint_ids"]]
        self.steps = 2 * len(self.driven) * self.length + self.rest

    def targets(self, step: int) -> dict[str, np.ndarray]:
        """Return the targets ``position`` (rad), ``velocity`` (rad/s), and ``effort`` (N·m), (J,) each, of a step."""
        found = {"position": self.default.copy(), "velocity": np.zeros_like(self.default)}
        number, inside = divmod(step, self.length)
        time = (inside - self.rest) * self.dt
        if time >= 0 and number < 2 * len(self.driven):
            turn, place = divmod(number, len(self.driven))
            joint, high = self.driven[place], min(HIGHEST, 0.125 / self.dt)
            time, sign = (SECONDS - time, -1.0) if turn else (time, 1.0)
            rate = np.log(high / LOWEST) / SECONDS
            wave = sign * np.sin(2 * np.pi * LOWEST * np.expm1(rate * time) / rate)
            kind, amplitude = self.amplitude(joint, high)
            found[kind][joint] += self.scale * amplitude * wave
        return found | {"effort": np.zeros_like(self.default)}

    def amplitude(self, joint: int, high: float) -> tuple[str, float]:
        """Return what a joint's chirp moves, ``position`` or ``velocity``, and its amplitude within the limits."""
        spec, effort = self.spec, self.spec["effort_limit"][joint] or np.inf
        if spec["stiffness"][joint]:
            bounds = zip(spec["joint_pos_limits"][joint], (-np.inf, np.inf), strict=True)
            low, top = (bound if missing is None else missing for missing, bound in bounds)
            room = 0.8 * min(top - self.default[joint], self.default[joint] - low)
            return "position", min(AMPLITUDE, room, EFFORT * effort / spec["stiffness"][joint])
        inertia = (spec["armature"][joint] or 0.0) + spec["inertia"][joint]
        most = EFFORT * effort / (2 * np.pi * high * inertia)
        return "velocity", min(SPEED * (spec["velocity_limit"][joint] or 30.0), most)

    def row(self, time: float, readings: Mapping[str, Sequence[float] | np.ndarray], step: int) -> dict[str, float]:
        """Return one row of the log: the readings at ``time`` (s), and the targets that were sent after them."""
        names, found = self.spec["joint_names"], {"time": time, "status": 0.0}
        parts: dict[str, Sequence[str]] = {"projected_gravity": "xyz"}
        for name in ("joint_pos", "joint_vel", "joint_effort", "projected_gravity"):
            if name in readings:
                found |= {f"{name}.{p}": float(x) for p, x in zip(parts.get(name, names), readings[name], strict=True)}
        for kind, values in self.targets(step).items():
            found |= {f"target_{kind}.{name}": float(x) for name, x in zip(names, values, strict=True)}
        return found


def write(path: str | Path, rows: Sequence[Mapping[str, float]]) -> None:
    """Write a log as CSV."""
    with Path(path).open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)


def main(words: Sequence[str]) -> int:
    """Simulate the chirps, and write their log to the file that is the only argument."""
    if len(words) != 1 or words[0].startswith("-"):
        print("usage: python chirps.py LOG.csv", file=sys.stderr)
        return 2
    from simulate import HungRobot  # A robot plays chirps without mujoco.

    spec = json.loads(Path(__file__).with_name("policy.json").read_text(encoding="utf-8"))
    rows = HungRobot(spec).play(Chirps(spec))
    write(words[0], rows)
    print(f"wrote {len(rows)} rows ({len(rows) * spec['step_dt']:.0f} s) to {words[0]}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
