"""Bundles without training, and logs that their robots write in plain MuJoCo: pushed, noisy, and with faults."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from wheelleg_exp.build import prepare_asset
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.files import write_json
from wheelleg_exp.jobs.export import bundle as package
from wheelleg_exp.jobs.export import export_bundle
from wheelleg_exp.jobs.export.bundle_specification import specification

NOISE = {"base_ang_vel": 0.01, "projected_gravity": 0.003, "joint_pos": 0.001, "joint_vel": 0.05}
PUSH = np.array([0.06, 0.06, 0.0, 0.3, 0.3, 1.0])  # m/s and rad/s
Columns = dict[str, np.ndarray]


def bundle_of(robot: str, folder: Path) -> tuple[Path, dict[str, Any], Path]:
    """Write a bundle of ``task=stand`` with a linear policy; return the bundle, the ``env`` config, and the MJCF.

    ``linear_policy.npz`` was fitted by least squares to the actions of a trained policy, and balances the robot.
    """
    composed = compose(["task=stand", f"robot={robot}"])
    mjcf, config = prepare_asset(composed.config).output, export_bundle.as_configured(composed.config["env"])
    env = ManagerBasedRLEnv(config, mjcf, 0)
    spec = specification(env, composed.config["agent"], {})
    spec["network"] = {"widths": [spec["action_width"]], "activations": ["identity"]}
    write_json(folder / "policy.json", spec)
    (folder / "policy.npz").write_bytes(Path(__file__).with_name("linear_policy.npz").read_bytes())
    export_bundle._write_robot(folder / "robot", mjcf, config, env)
    return folder, config, mjcf


def programs(*names: str) -> list[ModuleType]:
    """Import programs of a bundle, which import one another by their file names."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(str(package.__file__)).parent))
        for name in ("runner", "simulate", "chirps"):
            sys.modules.pop(name, None)
        return [__import__(name) for name in names]


def drive(
    bundle: Path,
    seconds: float,
    seed: int = 3,
    noise: float = 1.0,
    gain: float = 1.0,
    step: float = 1.0,
    edit: Callable[[Any], None] = lambda model: None,
) -> Columns:
    """Return the log of a balancing robot that is pushed twice per second; its drives have ``gain`` times the gains.

    A control step takes ``step`` times the control step of the training; ``edit`` changes the MuJoCo model.
    """
    runner, simulate = programs("runner", "simulate")
    spec = json.loads((bundle / "policy.json").read_text())
    robot, policy = simulate.Robot(spec, bundle / "robot" / "scene.xml"), runner.Policy(bundle)
    for index, (one, actuators) in enumerate(robot.drives):
        robot.model.actuator_biasprm[actuators, 1:3] *= gain
        gains = {key: (gain * np.array(one[key])).tolist() for key in ("stiffness", "damping")}
        robot.drives[index] = ({**one, **gains}, actuators)
    robot.model.opt.timestep *= step
    edit(robot.model)
    simulate.mujoco.mj_setConst(robot.model, robot.data)
    robot.reset()
    rng, rows = np.random.default_rng(seed), []
    for row in range(round(seconds / spec["step_dt"])):
        if row % 30 == 29:
            robot.data.qvel[:6] += rng.uniform(-1, 1, 6) * PUSH
        readings = robot.readings({name: np.zeros(3) for name in spec["commands"]})
        readings["projected_gravity"] = runner.projected_gravity(readings["base_quat"])
        seen = {name: np.array(readings[name]) for name in {*NOISE, *spec["readings"]}}
        for name, sigma in NOISE.items():
            seen[name] = seen[name] + noise * sigma * rng.standard_normal(seen[name].shape)
        targets = policy.step(seen)
        found = {"time": row * step * spec["step_dt"], "status": 0.0, "reset": float(row == 0)}
        for name, values in (seen | {f"target_{kind}": values for kind, values in targets.items()}).items():
            joints = name.startswith(("joint_", "target_"))
            parts = spec["joint_names"] if joints else "012" if name.startswith("commands") else "xyz"
            found |= {f"{name}.{part}": float(x) for part, x in zip(parts, values, strict=True)}
        rows.append(found)
        for _ in range(spec["decimation"]):
            robot.drive(targets)
            simulate.mujoco.mj_step(robot.model, robot.data)
            targets = policy.targets(robot.data.qpos[robot.qpos])
    assert robot.upright > 0.9
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}
