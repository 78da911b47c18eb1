"""Logs made by simulation: a bundle's robot in plain MuJoCo, with pushes, noise, and mistakes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

NOISE = {"base_ang_vel": 0.01, "projected_gravity": 0.003, "joint_pos": 0.001, "joint_vel": 0.05}


def drive(bundle: Path, seconds: float = 12.0, noise: float = 1.0, seed: int = 0, gain: float = 1.0, command=None,
          change=None, push=1.0):
    """Return the columns of a log; the robot is pushed once per second. ``change`` changes the readings in the loop."""
    sys.path.insert(0, str(bundle))
    sys.modules.pop("runner", None), sys.modules.pop("simulate", None)
    import runner
    import simulate

    sys.path.remove(str(bundle))
    spec = json.loads((bundle / "policy.json").read_text())
    robot, policy = simulate.Robot(spec), runner.Policy(bundle)
    rng = np.random.default_rng(seed)
    robot.model.actuator_biasprm[:, 1:3] *= gain
    for drive_, _ in robot.drives:
        for key in ("stiffness", "damping"):
            drive_[key] = [gain * v for v in drive_[key]]
    names, rows = spec["joint_names"], []
    width = {k: v["width"] for k, v in spec["readings"].items()}
    every = max(1, round(0.5 / spec["step_dt"]))
    for k in range(round(seconds / spec["step_dt"])):
        if k % every == every - 1:
            robot.data.qvel[:6] += rng.uniform(-1, 1, 6) * push * np.array([0.06, 0.06, 0.0, 0.3, 0.3, 1.0])
        ask = {n: (np.zeros(width[f"commands.{n}"]) if command is None else command(k * spec["step_dt"])) for n in spec["commands"]}
        readings = robot.readings(ask)
        readings["projected_gravity"] = runner.projected_gravity(readings["base_quat"])
        seen = {n: np.array(readings[n], float) for n in {*NOISE, *spec["readings"]}}
        for n, sigma in NOISE.items():
            seen[n] = seen[n] + noise * sigma * rng.standard_normal(seen[n].shape)
        if change is not None:
            seen = change(k, seen)
        targets = policy.step(seen)
        row = {"time": k * spec["step_dt"], "status": 0, "reset": int(k == 0)}
        for n, v in seen.items():
            parts = names if n.startswith("joint_") else ("xyz" if len(v) == 3 and not n.startswith("commands") else range(len(v)))
            row |= {f"{n}.{p}": float(x) for p, x in zip(parts, v)}
        for kind, v in targets.items():
            row |= {f"target_{kind}.{j}": float(x) for j, x in zip(names, v)}
        rows.append(row)
        for _ in range(spec["decimation"]):
            robot.drive(targets)
            simulate.mujoco.mj_step(robot.model, robot.data)
            targets = policy.targets(robot.data.qpos[robot.qpos])
        if robot.upright < 0.5:
            print("fell", k)
            break
    return {n: np.array([r[n] for r in rows]) for n in rows[0]}
