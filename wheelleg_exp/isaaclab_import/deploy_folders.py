"""Convert folders for deployment (unitree_rl_lab, rl_sar) to the structure of Isaac Lab's ``env.yaml``.

Such a folder describes the policy's observations and actions, but not the training: rewards, events, and terrain are
unknown, and the report says so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.asset.robot_description import Dof
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.isaaclab_import.import_report import ASSUMED, DROPPED, RULE, ImportReport
from wheelleg_exp.isaaclab_import.run_folder import RunFolder, read_mapping
from wheelleg_exp.project.survey import survey

Tree = dict[str, Any]
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
_FASTEST = {"lin_vel_x": [-1.0, 1.0], "lin_vel_y": [0.0, 0.0], "ang_vel_z": [-1.0, 1.0]}


def as_isaac_lab(folder: RunFolder, robot: Path, dofs: Mapping[str, Dof], report: ImportReport) -> Tree:
    """Return the config of a deployment folder in the structure of ``env.yaml``."""
    convert = _unitree if folder.kind == "deploy.yaml" else _rl_sar
    tree = convert(folder, list(dofs), report)
    pose = tree["scene"]["robot"]["init_state"]["joint_pos"]
    height = survey(robot, compose(["task=stand"]).config["env"], pose, allow_missing=True).facts.standing_height
    height = round(height + _SETTLING, 4)
    tree["scene"]["robot"]["init_state"]["pos"] = [0.0, 0.0, height]
    text = f"{height} m: the height of the default pose, plus {_SETTLING} m"
    report.add("scene.robot.init_state.pos", ASSUMED, text)
    report.add("rewards", ASSUMED, "none: a deployment folder does not describe the training")
    report.add("terminations", ASSUMED, "the end of the episode, and a tilt of 1 rad")
    report.add("scene.terrain", ASSUMED, "a plane with friction 1")
    return tree


def _tree(joints: Sequence[str], pose: Sequence[float], step: Sequence[float], actuators: Tree) -> Tree:
    """Return the parts of ``env.yaml`` that both kinds of folders share; ``step`` is (physics step, decimation)."""
    events: Tree = {"reset_base": {"func": f"{_MDP}.events:reset_root_state_uniform", "mode": "reset"}}
    events["reset_base"]["params"] = {"pose_range": {}, "velocity_range": {}}
    joint_reset = {"position_range": [1.0, 1.0], "velocity_range": [0.0, 0.0]}
    events["reset_robot_joints"] = {
        "func": f"{_MDP}.events:reset_joints_by_scale",
        "mode": "reset",
        "params": joint_reset,
    }
    state = {"joint_pos": dict(zip(joints, pose, strict=True)), "joint_vel": {".*": 0.0}}
    ends = {"time_out": {"func": f"{_MDP}.terminations:time_out", "time_out": True}}
    ends["bad_orientation"] = {"func": f"{_MDP}.terminations:bad_orientation", "params": {"limit_angle": 1.0}}
    material = {"static_friction": 1.0, "dynamic_friction": 1.0}
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
        "events": events,
        "terminations": ends,
        "rewards": {},
        "curriculum": {},
    }


def _command(ranges: Mapping[str, Any]) -> Tree:
    limits = {axis: ranges.get(axis) or [0.0, 0.0] for axis in _FASTEST}
    node = {"class_type": f"{_MDP}.commands.velocity_command:UniformVelocityCommand", "ranges": limits}
    return {"base_velocity": {**node, "resampling_time_range": [10.0, 10.0], "heading_command": False}}


def _observation(function: str, **settings: Any) -> Tree:
    params = {"command_name": "base_velocity"} if function == "generated_commands" else {}
    return {"func": f"{_MDP}.observations:{function}", "params": params, **settings}


def _actuators(joints: Sequence[str], gains: Sequence[Sequence[float]], limits: Sequence[float] | None) -> Tree:
    node: Tree = {"class_type": "isaaclab.actuators:ImplicitActuator", "joint_names_expr": list(joints)}
    for name, values in zip(("stiffness", "damping"), gains, strict=True):
        node[name] = dict(zip(joints, map(float, values), strict=True))
    if limits is not None:
        node["effort_limit"] = dict(zip(joints, map(float, limits), strict=True))
    return {"all": node}


def _unitree(folder: RunFolder, names: list[str], report: ImportReport) -> Tree:
    config, where = folder.config, str(folder.config_file)
    order = config["joint_ids_map"]  # the motor of each joint; a robot can lack some motors
    if len(set(order)) != len(names):
        message = f"the policy has {len(order)} joints, but the robot file has {len(names)}"
        raise RunDirectoryError(message, key="joint_ids_map", where=where, expected="the robot of the policy")
    joints = [names[sorted(order).index(motor)] for motor in order]
    text = f"the motors have the order of the joints in the robot file; the policy's order is {', '.join(joints)}"
    report.add("joint_ids_map", ASSUMED, text)
    step = (_STEP, round(config["step_dt"] / _STEP))
    report.add("sim.dt", ASSUMED, f"{_STEP} s, Isaac Lab's step for locomotion; {step[1]} steps per control step")
    own = [[config[name][motor] for motor in order] for name in ("stiffness", "damping")]
    tree = _tree(joints, config["default_joint_pos"], step, _actuators(joints, own, None))
    velocity = (config.get("commands") or {}).get("base_velocity")
    if velocity is None:
        raise RunDirectoryError("the policy has no command 'base_velocity'", key="commands", where=where)
    tree["commands"] = _command(velocity["ranges"])
    (kind, action), *more = config["actions"].items()
    if more:
        raise RunDirectoryError("the policy has several actions", key="actions", where=where, expected="one action")
    spread = {name: dict(zip(joints, action[name], strict=True)) for name in ("scale", "offset") if action.get(name)}
    node = {"class_type": f"{_MDP}.actions.joint_actions:{kind}", "joint_names": joints, "preserve_order": True}
    node |= {"clip": dict(zip(joints, action["clip"], strict=True))} if action.get("clip") else {}
    tree["actions"] = {"joint_pos": {**node, **spread, "use_default_offset": False}}
    terms = {}
    for name, term in config["observations"].items():
        settings = {key: term[key] for key in ("scale", "clip", "history_length") if term.get(key) is not None}
        function = "generated_commands" if name == "velocity_commands" else name
        terms[name] = _observation(function, **settings) | {"params": term.get("params") or {}}
    tree["observations"] = {"policy": {"concatenate_terms": True, "enable_corruption": False, **terms}}
    return tree


def _rl_sar(folder: RunFolder, names: list[str], report: ImportReport) -> Tree:
    base = next(
        (place / "base.yaml" for place in (folder.path, folder.path.parent) if (place / "base.yaml").is_file()), None
    )
    config: Tree = {}
    for content in ([] if base is None else [read_mapping(base)]) + [folder.config]:
        inner = next(iter(content.values()))
        config |= inner if isinstance(inner, Mapping) else content
    where = str(folder.config_file)
    listed = config.get("joint_names") or config.get("joint_controller_names")
    if listed is None:
        raise RunDirectoryError(
            "the joints are not named", key="joint_names", where=where, expected="rl_sar's base.yaml beside it"
        )
    unknown = [name for name in listed if name not in names]
    if unknown:
        raise ConfigError(
            f"the robot file has no joint '{unknown[0]}'", key="joint_names", where=where, expected=", ".join(names)
        )
    joints = [listed[index] for index in config.get("joint_mapping") or range(len(listed))]
    wheels = [joints[index] for index in config.get("wheel_indices") or []]
    legs = [joint for joint in joints if joint not in wheels]
    if joints != legs + wheels:
        raise RunDirectoryError(
            "wheels and legs alternate in the actions", key="wheel_indices", where=where, expected="legs first"
        )
    limits = config.get("torque_limits")
    gains = (config["rl_kp"], config["rl_kd"])
    tree = _tree(
        joints, config["default_dof_pos"], (config["dt"], config["decimation"]), _actuators(joints, gains, limits)
    )
    tree["commands"] = _command(_FASTEST)
    report.add("commands.base_velocity.ranges", ASSUMED, str(_FASTEST))
    scale, low, high = (
        dict(zip(joints, config[name], strict=True))
        for name in ("action_scale", "clip_actions_lower", "clip_actions_upper")
    )
    bounds = {abs(bound) for bound in (*low.values(), *high.values())}
    tree["actions"] = {}
    for name, kind, chosen in (("joint_pos", "Position", legs), ("joint_vel", "Velocity", wheels)):
        if chosen:
            node: Tree = {"class_type": f"{_MDP}.actions.joint_actions:Joint{kind}Action", "joint_names": chosen}
            node |= {"preserve_order": True, "scale": {joint: scale[joint] for joint in chosen}}
            if len(bounds) > 1:
                centre = dict.fromkeys(wheels, 0.0) | dict(zip(joints, config["default_dof_pos"], strict=True))
                edges = {joint: [end[joint] * scale[joint] + centre[joint] for end in (low, high)] for joint in chosen}
                node["clip"] = edges
            tree["actions"][name] = node
    if len(bounds) > 1:
        report.add("clip_actions", RULE, "bounds of the targets; the observation of the last action has no bounds")
    else:
        tree["clip_actions"] = bounds.pop()
        report.add("clip_actions", RULE, f"agent.clip_actions={tree['clip_actions']}")
    terms = {}
    for name in config["observations"]:
        if name not in _OBSERVATIONS:
            raise RunDirectoryError(
                f"the observation '{name}' does not exist here",
                key="observations",
                where=where,
                expected=", ".join(_OBSERVATIONS),
            )
        function, key = _OBSERVATIONS[name]
        factor: Any = config[key] if key is not None else None
        if name == "dof_pos" and wheels:
            factor = [float(factor) * (joint not in wheels) for joint in joints]
            report.add("observations.dof_pos", RULE, "the angles of wheels are 0: their scale is 0")
        terms[name] = _observation(function, **({} if factor is None else {"scale": factor}))
    report.add("clip_obs", DROPPED, f"{config.get('clip_obs')}: observations are not clipped here")
    group: Tree = {"concatenate_terms": True, "enable_corruption": False}
    history = config.get("observations_history")
    if history:
        if history != list(range(len(history)))[::-1]:
            expected = "successive steps, the oldest first"
            message = "this order of the history does not exist here"
            raise RunDirectoryError(message, key="observations_history", where=where, expected=expected)
        group["history_length"] = len(history)
        if config.get("observations_history_priority") == "time":
            group["history_order"] = "time"
    tree["observations"] = {"policy": {**group, **terms}}
    return tree
