"""A scene for viewing a converted robot: floor, light, and a time step at which gains and contacts are stable."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from wheelleg_exp.asset.mjcf.compile_mjcf import load, mujoco_warnings
from wheelleg_exp.asset.mjcf.mjcf_document import HOME
from wheelleg_exp.asset.mjcf.mjcf_elements import Element, Value
from wheelleg_exp.asset.robot_description import Numbered, RobotDescription
from wheelleg_exp.files import write_text

SUFFIX, STAND = "_scene", "stand"
MARK = "Made by 'wheelleg convert'"
STEPS = (0.002, 0.001, 0.0005, 0.00025)  # s
TRIAL = 0.5  # s
NUDGE = 0.01  # m/s and rad/s
MOST_DOFS, MOST_GEOMS = 200, 500
CLEARANCE = 0.002  # m above the floor
FAST = 10.0  # m/s beyond free fall


def scene_path(model: Path) -> Path:
    """Return the path of an MJCF's preview scene."""
    return model.with_name(f"{model.stem}{SUFFIX}.xml")


def write_scene(robot: RobotDescription, model: Path) -> Path | None:
    """Write the preview scene next to a robot's MJCF; return None if an unrelated file has the scene's path."""
    path = scene_path(model)
    if path.exists() and MARK not in path.read_text(encoding="utf-8", errors="replace"):
        return None
    alone = load(model, model.name)
    # The temporary scene file includes the MJCF file by a relative path, so both files must be in one folder.
    draft = path.with_name(f".{path.stem}.trying.xml")
    try:
        write_text(draft, _text(robot, model, alone, STEPS[0]))
        trial = load(draft, path.name)
    finally:
        draft.unlink(missing_ok=True)
    steps = STEPS if trial.nv <= MOST_DOFS and trial.ngeom <= MOST_GEOMS else STEPS[:1]
    with mujoco_warnings():
        step = next((step for step in steps[:-1] if _is_calm(trial, step)), steps[-1])
    write_text(path, _text(robot, model, alone, step))
    return path


def _text(robot: RobotDescription, model: Path, alone: mujoco.MjModel, step: float) -> str:
    root = Element("mujoco", {"model": f"{robot.name} scene"})
    root.comment = f"{robot.name} on a floor, to look at. {MARK}."
    root.add("include", file=model.name)
    root.add("option", timestep=step, integrator="discrete")
    extent = _short(alone.stat.extent)
    root.add("statistic", center=tuple(_short(value) for value in alone.stat.center), extent=extent)
    visual = root.add("visual")
    visual.add("headlight", diffuse=(0.6, 0.6, 0.6), ambient=(0.3, 0.3, 0.3), specular=(0.0, 0.0, 0.0))
    floors = [geom for geom in robot.static_geoms if geom.kind == "plane" and geom.collides]
    if not floors:
        asset = root.add("asset")
        sky: dict[str, Value] = {"rgb1": (0.3, 0.5, 0.7), "rgb2": (0.0, 0.0, 0.0), "width": 512, "height": 3072}
        asset.add("texture", sky, type="skybox", builtin="gradient")
    world = root.add("worldbody")
    world.add("light", pos=(0.0, 0.0, _short(5 * extent)), dir=(0.0, 0.0, -1.0), type="directional")
    height, poses = _stands(alone)
    if not floors:
        floor = Numbered(geom.name for geom in robot.static_geoms).take("floor")
        size = (0.0, 0.0, _short(max(0.01, extent / 10)))
        world.add("geom", name=floor, type="plane", size=size, pos=(0.0, 0.0, height), rgba=(0.5, 0.55, 0.6, 1.0))
    if poses is not None:
        key = Numbered([HOME, *(item.name for item in robot.keyframes)]).take(STAND)
        root.add("keyframe").add("key", name=key, qpos=poses[0], ctrl=poses[1] if any(poses[1]) else None)
    return root.text() + "\n"


def _short(value: float) -> float:
    return float(f"{round(float(value), 6):.4g}") + 0.0


def _stands(alone: mujoco.MjModel) -> tuple[float, tuple[list[float], list[float]] | None]:
    """Return the floor's height (m) and, for a floating robot with a home keyframe, its standing qpos and ctrl."""
    data = mujoco.MjData(alone)
    mujoco.mj_kinematics(alone, data)
    at_zero = round(_lowest(alone, data), 5)
    index = mujoco.mj_name2id(alone, mujoco.mjtObj.mjOBJ_KEY, HOME)
    if index < 0:
        return at_zero - CLEARANCE, None
    mujoco.mj_resetDataKeyframe(alone, data, index)
    mujoco.mj_kinematics(alone, data)
    at_home, floor = _lowest(alone, data), at_zero - CLEARANCE
    free = alone.jnt_qposadr[alone.jnt_type == mujoco.mjtJoint.mjJNT_FREE].tolist()
    if not free:
        return min(floor, at_home - CLEARANCE), None
    for address in free:
        data.qpos[address + 2] = round(float(data.qpos[address + 2] + floor + CLEARANCE - at_home), 6)
    return round(floor, 6), ([float(v) for v in data.qpos], [float(v) for v in data.ctrl])


def _lowest(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    moving = np.flatnonzero(model.geom_bodyid)
    solid = [g for g in moving if model.geom_contype[g] or model.geom_conaffinity[g]]
    lows = []
    for geom in solid or moving:
        down = data.geom_xmat[geom].reshape(3, 3)[2]
        center, half = model.geom_aabb[geom][:3], model.geom_aabb[geom][3:]
        lows.append(float(data.geom_xpos[geom][2] + down @ center - np.abs(down) @ half))
    return min(lows, default=0.0)


def _is_calm(model: mujoco.MjModel, step: float) -> bool:
    """Simulate a model from qpos0 and from its last keyframe, and return whether both simulations are stable."""
    model.opt.timestep = step
    gravity = float(np.linalg.norm(model.opt.gravity))
    bound = FAST + float(np.sqrt(2 * gravity * model.stat.extent))
    for key in (None, model.nkey - 1)[: 2 if model.nkey else 1]:
        data = mujoco.MjData(model)
        if key is not None:
            mujoco.mj_resetDataKeyframe(model, data, key)
        data.qvel += NUDGE
        for _ in range(round(TRIAL / step)):
            mujoco.mj_step(model, data)
            linear = np.abs(data.cvel[:, 3:]).max(initial=0.0)
            if any(item.number for item in data.warning) or not linear < bound:
                return False
    return True
