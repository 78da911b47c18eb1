"""Convert folders for deployment (unitree_rl_lab, rl_sar, LimX), without the training, to the form of ``env.yaml``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from wheelleg_exp.asset.robot_description import Dof
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.isaaclab_import.import_report import ASSUMED, DROPPED, RULE, ImportReport
from wheelleg_exp.isaaclab_import.run_folder import RunFolder, read_mapping
from wheelleg_exp.jobs.export.isaaclab_run import Tree
from wheelleg_exp.project.robot_yaml import natural_speed
from wheelleg_exp.project.survey import survey

_MDP = "isaaclab.envs.mdp"
_STEP = 0.005  # s; physics step of Isaac Lab's locomotion tasks
_SETTLING = 0.01  # m; the robot starts above the ground by this height
# rl_sar's observations: Isaac Lab's function, and the key of the scale.
_OBSERVATIONS = {
    "lin_vel": ("base_lin_vel", "lin_vel_scale"),
    "ang_vel": ("base_ang_vel", "ang_vel_scale"),
    "gravity_vec": ("projected_gravity", None),
    "commands": ("generated_commands", "commands_scale"),
    "dof_pos": ("joint_pos_rel", "dof_pos_scale"),
    "dof_vel": ("joint_vel_rel", "dof_vel_scale"),
    "actions": ("last_action", None),
}
# LimX's runner multiplies the position of the joystick by 0.5 and by these keys of ``user_cmd_scales``.
_JOYSTICK, _KEYS = 0.5, ("lin_vel_x", "lin_vel_y", "ang_vel_yaw")
_LIMX_LOOP = 0.002  # s; the step of the loop of tron2_hw in tron2_rl_deploy_ros
_FASTEST = {"lin_vel_x": [-1.0, 1.0], "lin_vel_y": [0.0, 0.0], "ang_vel_z": [-1.0, 1.0]}


def as_isaac_lab(folder: RunFolder, robot: Path, dofs: Mapping[str, Dof], report: ImportReport) -> tuple[Tree, Tree]:
    """Return the config of a deployment folder in the structure of ``env.yaml``, and the sizes of the robot."""
    convert = {"deploy.yaml": _unitree, "config.yaml": _rl_sar, "params.yaml": _limx}
    tree = convert[folder.kind](folder, list(dofs), report)
    pose = tree["scene"]["robot"]["init_state"]["joint_pos"]
    found = survey(robot, compose(["task=stand"]).config["env"], pose, allow_missing=True)
    height = round(found.facts.standing_height + _SETTLING, 4)
    tree["scene"]["robot"]["init_state"]["pos"] = [0.0, 0.0, height]
    sizes = {"standing_height": found.facts.standing_height, "wheel_radius": found.facts.wheel_radius or None}
    sizes |= {"size": found.size, "mass": found.facts.mass, "natural_speed": natural_speed(found)}
    text = f"{height} m: the height of the default pose, plus {_SETTLING} m"
    report.add("scene.robot.init_state.pos", ASSUMED, text)
    report.add("rewards", ASSUMED, "none: a deployment folder does not describe the training")
    report.add("terminations", ASSUMED, "the end of the episode, and a tilt of 1 rad")
    report.add("scene.terrain", ASSUMED, "a plane with friction 1")
    return tree, sizes


def _tree(joints: Sequence[str], pose: Sequence[float], step: Sequence[float], actuators: Tree) -> Tree:
    """Return the parts of ``env.yaml`` that both kinds of folders share; ``step`` is (physics step, decimation)."""
    base_reset = {"func": f"{_MDP}.events:reset_root_state_uniform", "mode": "reset"}
    joint_reset = {"func": f"{_MDP}.events:reset_joints_by_scale", "mode": "reset"}
    scales = {"position_range": [1.0, 1.0], "velocity_range": [0.0, 0.0]}
    tilt = {"func": f"{_MDP}.terminations:bad_orientation", "params": {"limit_angle": 1.0}}
    material = {"static_friction": 1.0, "dynamic_friction": 1.0}
    state = {"joint_pos": _by_joint(joints, pose), "joint_vel": {".*": 0.0}}
    robot: Tree = {"class_type": "isaaclab.assets:Articulation", "joint_order": list(joints), "init_state": state}
    return {
        "decimation": step[1],
        "episode_length_s": 20.0,
        "sim": {"dt": step[0], "physx": {}, "physics_material": material},
        "scene": {
            "num_envs": 64,
            "robot": {**robot, "actuators": actuators},
            "terrain": {"class_type": "isaaclab.terrains:TerrainImporter", "physics_material": material},
        },
        "events": {
            "reset_base": {**base_reset, "params": {"pose_range": {}, "velocity_range": {}}},
            "reset_robot_joints": {**joint_reset, "params": scales},
        },
        "terminations": {
            "time_out": {"func": f"{_MDP}.terminations:time_out", "time_out": True},
            "bad_orientation": tilt,
        },
        "rewards": {},
        "curriculum": {},
    }


def _by_joint(joints: Sequence[str], values: Sequence[object]) -> Tree:
    return dict(zip(joints, values, strict=True))


def _picked(items: Sequence[Any], indices: Sequence[int], key: str, where: str) -> list[Any]:
    """Return the items at the indices, which must not be negative."""
    if wrong := [index for index in indices if index not in range(len(items))]:
        message, expected = f"{wrong[0]} is not an index of a joint", f"0 to {len(items) - 1}"
        raise RunDirectoryError(message, key=key, where=where, expected=expected)
    return [items[index] for index in indices]


def _command(ranges: Mapping[str, object]) -> Tree:
    limits = {axis: ranges.get(axis) or [0.0, 0.0] for axis in _FASTEST}
    node = {"class_type": f"{_MDP}.commands.velocity_command:UniformVelocityCommand", "ranges": limits}
    return {"base_velocity": {**node, "resampling_time_range": [10.0, 10.0], "heading_command": False}}


def _action(kind: str, joints: Sequence[str], **settings: object) -> Tree:
    node = {"class_type": f"{_MDP}.actions.joint_actions:{kind}", "joint_names": joints, "preserve_order": True}
    return node | settings


def _observation(function: str, params: Mapping[str, object] | None, **settings: object) -> Tree:
    return {"func": f"{_MDP}.observations:{function}", "params": params or {}, **settings}


def _actuators(joints: Sequence[str], wheels: Sequence[str] = (), **gains: Sequence[float]) -> Tree:
    """Return the actuators of legs and wheels, with gains and limits in the order of ``joints``."""
    groups = {"legs": [joint for joint in joints if joint not in wheels], "wheels": list(wheels)}
    given = {name: _by_joint(joints, [float(value) for value in values]) for name, values in gains.items()}
    return {
        group: {"class_type": "isaaclab.actuators:ImplicitActuator", "joint_names_expr": members}
        | {name: {joint: values[joint] for joint in members} for name, values in given.items()}
        for group, members in groups.items()
        if members
    }


def _unitree(folder: RunFolder, names: list[str], report: ImportReport) -> Tree:
    config, where = folder.config, str(folder.config_file)
    order = config["joint_ids_map"]  # the motor of each joint; a robot can lack some motors
    if len(set(order)) != len(names):
        message = f"the policy has {len(set(order))} joints, but the robot file has {len(names)}"
        raise RunDirectoryError(message, key="joint_ids_map", where=where, expected="the robot of the policy")
    if min(order) < 0:
        raise RunDirectoryError("a motor's number is negative", key="joint_ids_map", where=where, expected="0 or more")
    joints = [names[sorted(order).index(motor)] for motor in order]
    text = f"the motors have the order of the joints in the robot file; the policy's order is {', '.join(joints)}"
    report.add("joint_ids_map", ASSUMED, text)
    step = (_STEP, round(config["step_dt"] / _STEP))
    report.add("sim.dt", ASSUMED, f"{_STEP} s, Isaac Lab's step for locomotion; {step[1]} steps per control step")
    gains = {name: _picked(config[name], order, name, where) for name in ("stiffness", "damping")}
    tree = _tree(joints, config["default_joint_pos"], step, _actuators(joints, **gains))
    velocity = (config.get("commands") or {}).get("base_velocity")
    if velocity is None:
        report.add("commands.base_velocity", ASSUMED, f"{_FASTEST}: the folder has no velocity command")
    tree["commands"] = _command(_FASTEST if velocity is None else velocity["ranges"])
    (kind, action), *more = config["actions"].items()
    if more:
        raise RunDirectoryError("the policy has several actions", key="actions", where=where, expected="one action")
    moved = _picked(joints, action.get("joint_ids") or range(len(joints)), f"actions.{kind}.joint_ids", where)
    settings = {name: _by_joint(moved, action[name]) for name in ("clip", "scale", "offset") if action.get(name)}
    tree["actions"] = {"joint_pos": _action(kind, moved, **settings, use_default_offset=False)}
    tree["observations"] = {"policy": _unitree_observations(config["observations"], where)}
    return tree


def _unitree_observations(terms: Tree, where: str) -> Tree:
    """Return the observation group of a policy; with named groups, the first, as the policy has one input."""
    first = next(iter(terms.values()), None)
    if isinstance(first, Mapping) and any(isinstance(v, Mapping) and "params" in v for v in first.values()):
        terms = dict(first)
    flags = {name: terms.get(name, False) for name in ("use_gym_history", "scale_first")}
    group: Tree = {"concatenate_terms": True, "enable_corruption": False}
    if flags["use_gym_history"]:  # successive steps, not successive terms
        group["history_order"] = "time"
    for name, term in terms.items():
        if name in flags:
            continue
        settings = {key: term[key] for key in ("scale", "clip", "history_length") if term.get(key) is not None}
        if flags["scale_first"] and settings.keys() >= {"scale", "clip"}:  # Isaac Lab clips first.
            scale, *others = set(settings["scale"])
            if others or scale <= 0:
                message, key = "the bounds differ between components", f"observations.{name}.clip"
                raise RunDirectoryError(message, key=key, where=where, expected="one positive scale with scale_first")
            settings["clip"] = [bound / scale for bound in settings["clip"]]
        function = "generated_commands" if name == "velocity_commands" else name
        group[name] = _observation(function, term.get("params"), **settings)
    return group


def _rl_sar(folder: RunFolder, names: list[str], report: ImportReport) -> Tree:
    # ``base.yaml`` is in the folder of ``config.yaml``, or one or two folders above.
    bases = [place / "base.yaml" for place in (folder.path, *folder.path.resolve().parents[:2])]
    contents = [read_mapping(base) for base in bases if base.is_file()][:1]
    config, where = Tree(), str(folder.config_file)
    for content in (*contents, folder.config):
        inner = next(iter(content.values()), None)
        config |= inner if isinstance(inner, Mapping) else content
    report.add("commands.base_velocity.ranges", ASSUMED, str(_FASTEST))
    return _of_settings(config, names, where, report) | {"commands": _command(_FASTEST)}


def _limx(folder: RunFolder, names: list[str], report: ImportReport) -> Tree:
    """Convert a wheel-foot policy of LimX; its runner is a class ``WheelfootController``."""
    if "Tron2Cfg" in folder.config:
        return _limx_with_kinds(folder, names, report)
    config = folder.config["PointfootCfg"]
    control, normal, listed = config["control"], config["normalization"], config["joint_names"]
    legs = _picked(listed, config["size"]["jointpos_idxs"], "size.jointpos_idxs", str(folder.config_file))
    number, scales, order = len(listed), normal["obs_scales"], list(range(len(listed)))
    observed = [scales["lin_vel"], scales["lin_vel"], scales["ang_vel"]]
    if folder.policy is not None and folder.policy.parent.name == "isaaclab":  # left and right joints alternate
        order = [index for pair in zip(order[: number // 2], order[number // 2 :], strict=True) for index in pair]
        observed = [1.0, 1.0, 1.0]
    report.add("user_cmd_scales", ASSUMED, f"the policy observes its command times {observed}, as in its training")
    wheels = [listed[index] not in legs for index in order]
    damping = control["wheel_joint_damping"]
    of_joints = {
        "rl_kp": (control["stiffness"], 0.0),
        "rl_kd": (control["damping"], damping),
        "action_scale": (control["action_scale_pos"], damping),
        "torque_limits": (control["user_torque_limit"], control["wheel_joint_torque_limit"]),
    }
    settings: Tree = {
        **{key: [pair[is_wheel] for is_wheel in wheels] for key, pair in of_joints.items()},
        **{f"{name}_scale": scales[name] for name in ("ang_vel", "dof_pos", "dof_vel")},
        "default_dof_pos": [config["init_state"]["default_joint_angle"][listed[index]] for index in order],
        "commands_scale": observed,
        "joint_names": listed,
        "joint_mapping": order,
        "dt": 1.0 / config["loop_frequency"],
        "decimation": control["decimation"],
    }
    speeds = [_JOYSTICK * config["user_cmd_scales"][key] / scale for key, scale in zip(_KEYS, observed, strict=True)]
    text = "the policy observes its actions before the limit of the torque, LimX's runner after it"
    report.add("control.user_torque_limit", ASSUMED, text)
    return _encoded(settings, config, wheels, speeds, names, str(folder.config_file), report)


def _limx_with_kinds(folder: RunFolder, names: list[str], report: ImportReport) -> Tree:
    """Convert a wheel-foot policy of tron2_rl_deploy_ros."""
    config, where = folder.config["Tron2Cfg"], str(folder.config_file)
    control, joints = config["control"], config["init_state"]["joint_names"]
    needed = (("gait", "enabled", False), ("init_state", "sensor_joint_names", joints))
    for part, key, value in needed:
        if config[part][key] != value:
            message = "the policy observes a gait, or another order of joints than that of its actions"
            raise RunDirectoryError(message, key=f"{part}.{key}", where=where, expected=str(value))
    wheels = [mode == "velocity" for mode in control["joint_control_modes"]]
    kinds = [  # The runner chooses the gains by these parts of the names.
        "wheel" if is_wheel else "light" if "yaw_" in joint or "ankle_pitch_" in joint else "leg"
        for joint, is_wheel in zip(joints, wheels, strict=True)
    ]
    period = _LIMX_LOOP * control["decimation"]
    steps = max(1, round(period / _STEP))
    settings: Tree = {
        "rl_kp": [0.0 if kind == "wheel" else control[f"{kind}_joint_stiffness"] for kind in kinds],
        "rl_kd": [control[f"{kind}_joint_damping"] for kind in kinds],
        "torque_limits": [control[f"{kind}_joint_torque_limit"] for kind in kinds],
        "action_scale": [control["action_scale_vel" if is_wheel else "action_scale_pos"] for is_wheel in wheels],
        **{"ang_vel_scale": 0.25, "dof_pos_scale": 1.0, "dof_vel_scale": 0.05, "commands_scale": [1.0] * 3},
        "default_dof_pos": [config["init_state"]["default_joint_angle"][joint] for joint in joints],
        "joint_names": joints,
        "dt": period / steps,
        "decimation": steps,
    }
    text = f"{period} s per control step: LimX's loop has {1 / _LIMX_LOOP:g} Hz"
    report.add("control.decimation", ASSUMED, text)
    speeds = [config["commands"]["max"][key] for key in _KEYS]
    return _encoded(settings, config, wheels, speeds, names, where, report)


def _encoded(
    settings: Tree,
    config: Tree,
    wheels: Sequence[bool],
    speeds: Sequence[float],
    names: list[str],
    where: str,
    report: ImportReport,
) -> Tree:
    """Convert the settings of a policy with an encoder, which observes ``speeds`` (m/s, m/s, rad/s) at most."""
    clips = config["normalization"]["clip_scales"]
    settings |= {
        "clip_actions_lower": [-clips["clip_actions"]] * len(wheels),
        "clip_actions_upper": [clips["clip_actions"]] * len(wheels),
        "wheel_indices": [place for place, is_wheel in enumerate(wheels) if is_wheel],
        "observations": ["ang_vel", "gravity_vec", "dof_pos", "dof_vel", "actions", "commands"],
        "clip_obs": clips["clip_observations"],
    }
    tree = _of_settings(settings, names, where, report)
    joints = tree["scene"]["robot"]["joint_order"]
    chosen = [joint for joint, is_wheel in zip(joints, wheels, strict=True) if not is_wheel]
    positions = {"asset_cfg": {"name": "robot", "joint_names": chosen, "body_names": None, "preserve_order": True}}
    group = tree["observations"]["policy"]
    group |= {"history_length": config["size"]["obs_history_length"], "history_order": "time"}
    group["dof_pos"] |= {"params": positions, "scale": settings["dof_pos_scale"]}
    tree["commands"] = _command({axis: [-speed, speed] for axis, speed in zip(_FASTEST, speeds, strict=True)})
    report.add("policy", RULE, "encoder.onnx and policy.onnx became one network, which observes the encoder's history")
    return tree


def _of_settings(config: Tree, names: list[str], where: str, report: ImportReport) -> Tree:
    """Convert the settings of rl_sar's ``config.yaml`` and ``base.yaml``."""
    joints, wheels = _rl_sar_joints(config, names, where)
    gains = {"stiffness": config["rl_kp"], "damping": config["rl_kd"]}
    if config.get("torque_limits") is not None:
        gains["effort_limit"] = config["torque_limits"]
    step = (config["dt"], config["decimation"])
    tree = _tree(joints, config["default_dof_pos"], step, _actuators(joints, wheels, **gains))
    tree |= _rl_sar_actions(config, joints, wheels, report)
    tree["observations"] = {"policy": _rl_sar_observations(config, joints, wheels, where, report)}
    return tree


def _rl_sar_joints(config: Tree, names: Sequence[str], where: str) -> tuple[list[str], list[str]]:
    """Return the policy's joints in their order, and those of them that are wheels."""
    listed = config.get("joint_names") or config.get("joint_controller_names")
    if listed is None:
        message, expected = "the joints are not named", "rl_sar's base.yaml in the folder or above it"
        raise RunDirectoryError(message, key="joint_names", where=where, expected=expected)
    unknown = [name for name in listed if name not in names]
    if unknown:
        message = f"the robot file has no joint '{unknown[0]}'"
        raise ConfigError(message, key="joint_names", where=where, expected=", ".join(names))
    joints = _picked(listed, config.get("joint_mapping") or range(len(listed)), "joint_mapping", where)
    return joints, _picked(joints, config.get("wheel_indices") or [], "wheel_indices", where)


def _rl_sar_actions(config: Tree, joints: list[str], wheels: list[str], report: ImportReport) -> Tree:
    """Return the actions, and ``clip_actions`` if all actions have the same bound."""
    scale = _by_joint(joints, config["action_scale"])
    low, high = (_by_joint(joints, config[f"clip_actions_{end}"]) for end in ("lower", "upper"))
    tree: Tree = {"actions": {}}
    for are_wheels, group in groupby(joints, key=lambda joint: joint in wheels):  # in the order of the policy
        moved, kind, name = list(group), *(("Velocity", "joint_vel") if are_wheels else ("Position", "joint_pos"))
        name += f"_{len(tree['actions'])}" if name in tree["actions"] else ""
        tree["actions"][name] = _action(f"Joint{kind}Action", moved, scale={joint: scale[joint] for joint in moved})
    bounds = {abs(bound) for bound in (*low.values(), *high.values())}
    if len(bounds) == 1:
        tree["clip_actions"] = bounds.pop()
        report.add("clip_actions", RULE, f"agent.clip_actions={tree['clip_actions']}")
        return tree
    report.add("clip_actions", RULE, "bounds of the targets; the observation of the last action has no bounds")
    centre = _by_joint(joints, config["default_dof_pos"])
    for node in tree["actions"].values():
        chosen = node["joint_names"]
        node["clip"] = {name: [end[name] * scale[name] + centre[name] for end in (low, high)] for name in chosen}
    return tree


def _rl_sar_observations(config: Tree, joints: list[str], wheels: list[str], where: str, report: ImportReport) -> Tree:
    group: Tree = {"concatenate_terms": True, "enable_corruption": False}
    history = config.get("observations_history")
    if history:
        if history != list(range(len(history)))[::-1]:
            message, expected = "this order of the history does not exist here", "successive steps, the oldest first"
            raise RunDirectoryError(message, key="observations_history", where=where, expected=expected)
        group["history_length"] = len(history)
        if config.get("observations_history_priority") == "time":
            group["history_order"] = "time"
    for name in config["observations"]:
        if name not in _OBSERVATIONS:
            message, expected = f"the observation '{name}' does not exist here", ", ".join(_OBSERVATIONS)
            raise RunDirectoryError(message, key="observations", where=where, expected=expected)
        function, key = _OBSERVATIONS[name]
        settings = {} if key is None else {"scale": config[key]}
        if name == "dof_pos" and wheels:
            settings["scale"] = [float(settings["scale"]) * (joint not in wheels) for joint in joints]
            report.add("observations.dof_pos", RULE, "the angles of wheels are 0: their scale is 0")
        params = {"command_name": "base_velocity"} if name == "commands" else {}
        group[name] = _observation(function, params, **settings)
    report.add("clip_obs", DROPPED, f"{config.get('clip_obs')}: observations are not clipped here")
    return group
