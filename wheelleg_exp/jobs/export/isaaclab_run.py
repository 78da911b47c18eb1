"""Export a run as a run folder of Isaac Lab 2.3.2: its configs, its IO descriptors, and its policy.

Settings without a counterpart in Isaac Lab become notes. The import of Isaac Lab's runs reads the same tables.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rsl_rl.models import MLPModel

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.files import write_bytes, write_text
from wheelleg_exp.managers.observation_term import ObservationTerm
from wheelleg_exp.plain_data import dump_yaml
from wheelleg_exp.rl import export as formats
from wheelleg_exp.sim import actuators
from wheelleg_exp.sim.robot import Robot
from wheelleg_exp.terms.term_binding import RESERVED, TARGET, resolve_target, signature_parameters

Tree = dict[str, Any]  # Isaac Lab or the config defines the keys.
_OF_POLICY = ("commands", "actions", "observations")  # Terms that a policy needs are written with their own code.
_MDP, _TASKS = "isaaclab.envs.mdp", "isaaclab_tasks.manager_based.locomotion.velocity.mdp"
KINDS = ("commands", "actions", "observations", "events", "rewards", "terminations", "curriculum", "recorders")
RUNNER = ("num_steps_per_env", "max_iterations", "save_interval", "clip_actions")
PPO = (
    *("num_learning_epochs", "num_mini_batches", "clip_param", "gamma", "lam", "value_loss_coef", "entropy_coef"),
    *("learning_rate", "max_grad_norm", "use_clipped_value_loss", "schedule", "desired_kl"),
    *("normalize_advantage_per_mini_batch", "optimizer"),
)
# Isaac Lab's functions, and the classes here.
NOISES = {"uniform_noise": "UniformNoise", "gaussian_noise": "GaussianNoise", "constant_noise": "ConstantNoise"}
MODIFIERS = {"scale": "Scale", "clip": "Clip", "bias": "Bias"}
PATTERNS = {"grid_pattern": "GridPattern", "lidar_pattern": "LidarPattern", "bpearl_pattern": "BpearlPattern"}
TILES = {
    "flat_terrain": "Flat", "random_uniform_terrain": "RandomUniform", "pyramid_sloped_terrain": "PyramidSlope",
    "pyramid_stairs_terrain": "PyramidStairs", "inverted_pyramid_stairs_terrain": "PyramidStairs",
    "random_grid_terrain": "RandomGrid", "discrete_obstacles_terrain": "DiscreteObstacles", "wave_terrain": "Waves",
    "stepping_stones_terrain": "SteppingStones", "gap_terrain": "Gap", "rails_terrain": "Rails", "box_terrain": "Box",
    "pit_terrain": "Box",
}  # fmt: skip
INVERTED = ("inverted_pyramid_stairs_terrain", "pit_terrain")
PIT_NAMES = {"pit_depth_range": "box_height_range", "double_pit": "double_box"}
_MESH_TILES = ("Flat", "PyramidStairs", "RandomGrid", "Gap", "Rails", "Box")
# Terms here that Isaac Lab does not have.
OWN_TERMS = frozenset(
    """
    action_acceleration_l2 action_delay_levels air_time_variance ang_vel_cmd_levels apply_body_impulse base_height
    base_height_exp base_height_over_ground_l2 base_roll_pitch body_air_time body_contact_forces body_contacts
    command_levels_by_skill command_range_levels feet_clearance_l2 feet_stumble flat_orientation_exp gait_phase
    height_error joint_acc joint_effort_commanded joint_pos_sin_cos joint_power joint_symmetry_l1 joint_vel_rate_l2
    jump_apex jump_clearance jump_landing JumpCommand lin_vel_cmd_levels no_contact_count non_finite_state
    pitch_orientation_l2 randomize_effort_limits randomize_encoder_bias randomize_floor_slope randomize_imu_errors
    randomize_rigid_body_com_cumulative randomize_rigid_body_inertia reset_to_resting_pose
    root_height_over_ground_below_minimum root_link_lin_vel set_root_velocity standing_exp stuck
    terrain_levels_by_distance terrain_tile_left track_base_height_exp track_base_tilt_exp travel_error travel_error_l2
    UniformBasePoseCommand UniformVelocityTravelCommand upward wheel_slip wheel_spin_in_air_l1 WheeledBasePoseCommand
    while_commanded
    """.split()  # noqa: SIM905
)
# Terms that have another name in Isaac Lab.
RENAMED = {
    "body_lin_acc_norm_sum": "body_lin_acc_l2",
    "no_desired_contact": "desired_contacts",
    "push_by_adding_velocity": "push_by_setting_velocity",
    "set_permanent_body_wrench": "apply_external_force_torque",
}
# Terms of Isaac Lab's velocity tasks.
TASK_TERMS = frozenset(
    """
    feet_air_time feet_air_time_positive_biped feet_slide stand_still_joint_deviation_l1 terrain_levels_vel
    terrain_out_of_bounds track_ang_vel_z_world_exp track_lin_vel_xy_yaw_frame_exp
    """.split()  # noqa: SIM905
)
# Parameters that the term, sensor, or tile of the same name in Isaac Lab does not have.
_OF_MESHES = ("border_width", "horizontal_scale", "boxes", "gap_depth")
OWN_PARAMETERS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(TILES.values(), ("boxes",)),
    **dict.fromkeys(_MESH_TILES, _OF_MESHES),
    "PyramidStairs": _OF_MESHES[1:],
    **dict.fromkeys(("BinaryJointPositionAction", "BinaryJointVelocityAction"), ("preserve_order",)),
    "TerrainGenerator": ("origin_window",),
    "Imu": ("accelerometer", "gyroscope"),
    "feet_slide": ("threshold",),
    "joint_pos": ("measured",),
    "joint_pos_rel": ("measured",),
    "push_by_setting_velocity": ("frame", "curriculum_name"),
    "randomize_physics_scene_gravity": ("per_env",),
    "terrain_levels_vel": ("command_name",),
    "UniformVelocityCommand": ("limit_ranges",),
}
# Keys of nodes that are converted separately.
_MATERIAL = ("static_friction", "dynamic_friction", "restitution")
_OF_GENERATOR = (*_MATERIAL, "max_init_terrain_level", "sub_terrains")
_DELAYS = ("delay", "delay_jitter")
_ROBOT, _GROUND = "{ENV_REGEX_NS}/Robot", "/World/ground"
_NOISE_FUNCTIONS = {here: there for there, here in NOISES.items()}
_MODIFIER_FUNCTIONS = {here: there for there, here in MODIFIERS.items()}


def write_isaac_lab_run(
    folder: Path, env: ManagerBasedRLEnv, num_envs: int, agent: Tree, policy: MLPModel, task: str
) -> list[str]:
    """Write the run folder of a training with ``num_envs``; return notes about the settings that Isaac Lab lacks."""
    converted = IsaacLabEnv({**env.cfg, "num_envs": num_envs}, env.seed)
    notes, role = converted.notes, "student" if "student" in agent else "actor"
    groups, exported = agent["obs_groups"][role], converted.tree["observations"]
    lost = [name for group in groups for name in env.observation_manager.terms(group) if name not in exported[group]]
    if lost:
        notes.insert(0, f"write these observations in Isaac Lab before you run the policy: {', '.join(lost)}")
    if role == "actor":
        actor, critic = agent["actor"], agent["critic"]
        if agent.get("warm_start"):
            notes.append("agent.warm_start: Isaac Lab starts from random networks, and needs more iterations")
        noise = actor.get("distribution_cfg") or {}
        network = {"class_name": "ActorCritic", "activation": actor["activation"]}
        network |= {"init_noise_std": noise.get("init_std", 1.0), "noise_std_type": noise.get("std_type", "scalar")}
        for part, own in (("actor", actor), ("critic", critic)):
            network |= {f"{part}_{name}": own[name] for name in ("hidden_dims", "obs_normalization")}
        known = ("class_name", *PPO[:-1])  # Isaac Lab 2.3.2 has no ``optimizer``.
        algorithm = {name: agent["algorithm"][name] for name in known if name in agent["algorithm"]}
        sets = {"policy": agent["obs_groups"]["actor"], "critic": agent["obs_groups"]["critic"]}
        runner = {"seed": env.seed, **{name: agent[name] for name in RUNNER if name in agent}}
        runner |= {"experiment_name": task, "obs_groups": sets, "policy": network, "algorithm": algorithm}
        write_text(folder / "params" / "agent.yaml", dump_yaml(runner))
        unknown = [name for name, value in agent["algorithm"].items() if name not in (*known, "optimizer") and value]
        notes += [f"agent.algorithm.{name}: set it in Isaac Lab's config of the agent" for name in unknown]
        if critic["activation"] != actor["activation"]:
            notes.append(f"agent.critic.activation: {critic['activation']}, but Isaac Lab has one for both networks")
    else:
        notes.append("agent: Isaac Lab has no distillation from a checkpoint")
    head = "".join(f"# not exported: {note}\n" for note in notes)
    write_text(folder / "params" / "env.yaml", head + dump_yaml(converted.tree))
    descriptors = io_descriptors(env, groups)
    write_text(folder / "io_descriptors" / "IO_descriptors.yaml", dump_yaml(descriptors))
    write_bytes(folder / "exported" / "policy.pt", formats.torchscript(policy))
    write_bytes(folder / "exported" / "policy.onnx", formats.onnx(policy))
    return notes


class IsaacLabEnv:
    """Converts an ``env`` config to the content of ``env.yaml``; ``notes`` names what Isaac Lab does not have."""

    def __init__(self, env: Tree, seed: int) -> None:
        self.notes: list[str] = []
        scene, sim = env["scene"], env["sim"]
        robot, terrain = self._robot(env["robot"]), self._terrain(scene["terrain"], env["robot"])
        sensors = self._each(self._sensor, scene["sensors"], "scene.sensors")
        robot["spawn"]["activate_contact_sensors"] = bool(sensors)
        self.tree: Tree = {name: env[name] for name in ("decimation", "episode_length_s")}
        self.tree |= {"is_finite_horizon": env.get("is_finite_horizon", False), "seed": seed}
        self.tree["sim"] = {"dt": sim["dt"], "gravity": sim["gravity"], "render_interval": env["decimation"]}
        self.tree["sim"] |= {"physx": {}, "physics_material": terrain["physics_material"]}
        self.notes.append("sim: the settings of MuJoCo's solver")
        self.tree["scene"] = {"num_envs": env["num_envs"], "env_spacing": scene["env_spacing"]}
        self.tree["scene"] |= {"robot": robot, "terrain": terrain, **sensors}
        for kind in KINDS:
            convert = self._group if kind == "observations" else self._term
            self.tree[kind] = self._each(convert, env.get(kind) or {}, kind)

    def _each(self, convert: Callable[[str, Tree], object], nodes: Tree, key: str) -> Tree:
        """Convert each node that is not null, and return those that Isaac Lab has."""
        made = {name: convert(f"{key}.{name}", node) for name, node in nodes.items() if node is not None}
        return {name: node for name, node in made.items() if node is not None}

    def _values(self, key: str, name: str, node: Tree, skipped: Collection[str] = ()) -> Tree:
        """Return a node's values without those in ``skipped``; ``name`` is the class or function in Isaac Lab."""
        found = {}
        for parameter, value in node.items():
            if parameter in OWN_PARAMETERS.get(name, ()):
                default = signature_parameters(resolve_target(node[TARGET], key))[parameter].default
                if value != default:
                    self.notes.append(f"{key}.{parameter}: Isaac Lab's {name} has no such setting")
            elif parameter != TARGET and parameter not in skipped:
                found[parameter] = self._value(f"{key}.{parameter}", value)
        return found

    def _value(self, key: str, value: object) -> object:
        if isinstance(value, list):
            made = [(item, self._value(key, item)) for item in value]
            return [there for item, there in made if there is not None or item is None]
        if not isinstance(value, dict):
            return value
        name = _name(value)
        if name in _NOISE_FUNCTIONS:
            return {"func": f"isaaclab.utils.noise:{_NOISE_FUNCTIONS[name]}", **self._values(key, name, value)}
        if name in _MODIFIER_FUNCTIONS:
            function = f"isaaclab.utils.modifiers:{_MODIFIER_FUNCTIONS[name]}"
            return {"func": function, "params": self._values(key, name, value)}
        if name == "NoiseModelWithAdditiveBias":
            return {"class_type": f"isaaclab.utils.noise:{name}", **self._values(key, name, value)}
        if name == "SceneEntityCfg":
            return {"joint_names": None, "body_names": None, "preserve_order": False, **self._values(key, name, value)}
        if name:
            self.notes.append(f"{key}: Isaac Lab has no {name}")
            return None
        return self._values(key, name, value)

    def _robot(self, robot: Tree) -> Tree:
        fixed = {"fixed": True, "floating": False}.get(robot["base"])
        properties = {"enabled_self_collisions": robot["self_collisions"], "fix_root_link": fixed}
        spawn: Tree = {"articulation_props": properties}
        if robot["asset"].endswith(".urdf"):
            spawn |= {"func": "isaaclab.sim.spawners.from_files:spawn_from_urdf", "asset_path": robot["asset"]}
            spawn |= {"fix_base": bool(fixed), "joint_drive": {"gains": {"stiffness": 0.0, "damping": 0.0}}}
        else:
            spawn |= {"func": "isaaclab.sim.spawners.from_files:spawn_from_usd", "usd_path": robot["asset"]}
        self.notes.append(f"robot.asset: set the path in scene.robot.spawn to your file {robot['asset']}")
        if robot.get("joint_order"):
            self.notes.append(f"robot.joint_order: the policy's order is {', '.join(robot['joint_order'])}")
        found: Tree = {"class_type": "isaaclab.assets:Articulation", "prim_path": _ROBOT, "spawn": spawn}
        found |= {name: robot[name] for name in ("init_state", "soft_joint_pos_limit_factor")}
        return found | {"actuators": self._each(self._actuator, robot["actuators"], "robot.actuators")}

    def _actuator(self, key: str, node: Tree) -> Tree | None:
        kind = _name(node)
        if not hasattr(actuators, kind):
            self.notes.append(f"{key}: Isaac Lab has no {kind}")
            return None
        if node.get("delay") is not None:
            self.notes.append(f"{key}.delay: use a DelayedPDActuator in Isaac Lab")
        values = self._values(key, kind, node, ("delay",))
        if kind == "ImplicitActuator":
            values |= {f"{limit}_sim": values.pop(limit) for limit in ("effort_limit", "velocity_limit")}
        return {"class_type": f"isaaclab.actuators:{kind}", **values}

    def _terrain(self, node: Tree, robot: Tree) -> Tree:
        kind, key = _name(node), "scene.terrain"
        material = {name: node[name] for name in _MATERIAL}
        material["friction_combine_mode"] = robot.get("friction_combine_mode", "average")
        found: Tree = {"class_type": "isaaclab.terrains:TerrainImporter", "prim_path": _GROUND}
        found |= {"terrain_type": "plane", "physics_material": material}
        if kind == "TerrainGenerator":
            generator = self._values(key, kind, node, _OF_GENERATOR)
            tile = partial(self._tile, min(node["size"]))
            generator["sub_terrains"] = self._each(tile, node["sub_terrains"], f"{key}.sub_terrains")
            found |= {"terrain_type": "generator", "terrain_generator": generator}
            found["max_init_terrain_level"] = node.get("max_init_terrain_level")
        elif kind != "Plane":
            self.notes.append(f"{key}: a plane replaces the {kind}")
        return found

    def _tile(self, edge: float, key: str, node: Tree) -> Tree | None:
        kind = _name(node)
        turned = kind in ("PyramidStairs", "Box") and bool(node.get("inverted"))
        function = next((f for f, made in TILES.items() if made == kind and (f in INVERTED) == turned), None)
        if function is None:
            self.notes.append(f"{key}: Isaac Lab has no tile {kind}")
            return None
        module = "trimesh.mesh_terrains" if kind in _MESH_TILES else "height_field.hf_terrains"
        values = self._values(key, kind, node, ("inverted",) if kind in _MESH_TILES else ())
        renamed = {"flat_patch_sampling": "flat_patches"} | (PIT_NAMES if function == "pit_terrain" else {})
        for there, here in renamed.items():
            if here in values:
                values[there] = values.pop(here)
        if kind == "PyramidStairs":  # Isaac Lab's outermost ring is a step higher than the border.
            width, inner = values["step_width"], edge - 2 * values.get("border_width", 0.0)
            steps = math.ceil((inner - values["platform_width"]) / (2 * width) - 1e-9)
            steps = min(steps, math.ceil(inner / (2 * width) - 1e-9) - 1)  # a tile has no room for more
            values["border_width"] = round((edge - inner) / 2 + width, 9)
            values["platform_width"] = round(inner - (2 * steps - 1) * width, 9)
        if kind == "PyramidSlope":
            values["slope_range"] = [math.tan(angle) for angle in values["slope_range"]]
        return {"function": f"isaaclab.terrains.{module}:{function}", **values}

    def _sensor(self, key: str, node: Tree) -> Tree | None:
        kind = _name(node)
        if kind not in ("ContactSensor", "RayCaster", "Imu"):
            self.notes.append(f"{key}: Isaac Lab's {kind} has other settings")
            return None
        others = ("body_names", "body_name", "filter_body_names", "pattern", "max_contacts")
        found: Tree = {"class_type": f"isaaclab.sensors:{kind}", **self._values(key, kind, node, others)}
        names = node["body_names"] if kind == "ContactSensor" else node["body_name"]
        found["prim_path"] = _prim_path("|".join([names] if isinstance(names, str) else names))
        if node.get("filter_body_names"):
            found["filter_prim_paths_expr"] = [_prim_path(name) for name in node["filter_body_names"]]
        if kind == "RayCaster":
            pattern = _name(node["pattern"])
            function = next(function for function, name in PATTERNS.items() if name == pattern)
            found["pattern_cfg"] = {"func": f"isaaclab.sensors.ray_caster.patterns:{function}"}
            found["pattern_cfg"] |= self._values(f"{key}.pattern", pattern, node["pattern"])
            found["mesh_prim_paths"] = [_GROUND]
        return found

    def _group(self, key: str, group: Tree) -> Tree:
        terms = self._each(self._term, group["terms"], key)
        if group.get("history_order", "term") != "term":
            self.notes.append(f"{key}.history_order: Isaac Lab orders histories by term")
        return self._values(key, "", group, ("terms", "history_order")) | terms

    def _term(self, key: str, node: Tree) -> Tree | None:
        kind, name, target = key.partition(".")[0], _name(node), resolve_target(node[TARGET], key)
        module = target.__module__
        if any(node.get(parameter) for parameter in _DELAYS):
            self.notes.append(f"{key}.delay: Isaac Lab's terms have no delay")
        if module.startswith("wheelleg_exp.") and name in OWN_TERMS:
            if kind not in _OF_POLICY:
                self.notes.append(f"{key}: Isaac Lab has no {name}")
                return None
            self.notes.append(f"{key}: Isaac Lab has no {name}: it needs the class or function in {module}")
        elif module.startswith("wheelleg_exp."):
            name = RENAMED.get(name, name)
            module = _TASKS if name in TASK_TERMS else _MDP
        values = self._values(key, name, node, _DELAYS)
        if kind in ("actions", "commands", "recorders"):
            asset = {"asset_name": "robot"} if "asset_name" in signature_parameters(target) else {}
            return {"class_type": f"{module}:{name}", **asset, **values}
        fields = {parameter: values.pop(parameter) for parameter in RESERVED[kind] if parameter in values}
        return {"func": f"{module}:{name}", "params": values, **fields}


def io_descriptors(env: ManagerBasedRLEnv, groups: Sequence[str]) -> Tree:
    """Return the content of ``IO_descriptors.yaml``, for the observation groups of a policy."""
    robot = env.scene.robot
    found: Tree = {"observations": {}, "actions": []}
    for group in groups:
        terms = env.observation_manager.terms(group).values()
        found["observations"][group] = [_observation(term, robot) for term in terms]
    for name, width in zip(env.action_manager.active_terms, env.action_manager.action_term_dim, strict=True):
        term: Any = env.action_manager.get_term(name)
        entry: Tree = {"name": type(term).__name__, "mdp_type": "Action", "action_type": "JointAction"}
        entry |= {"shape": [width], "dtype": "torch.float32", "joint_names": list(term.joint_names), "extras": {}}
        entry["scale"] = term._scale.tolist() if hasattr(term, "_scale") else None
        entry["offset"] = term._offset[0].tolist() if hasattr(term, "_offset") else None
        entry["clip"] = None if term._low is None else torch.stack((term._low, term._high), dim=1).tolist()
        found["actions"].append(entry)
    fields = ("joint_pos", "joint_vel", "joint_pos_limits", "joint_damping", "joint_stiffness", "joint_armature")
    defaults = {f"default_{name}": getattr(robot.data, f"default_{name}")[0].tolist() for name in fields}
    defaults["default_joint_friction"] = robot.data.default_joint_friction_coeff[0].tolist()
    found["articulations"] = {"robot": {"joint_names": list(robot.joint_names), **defaults}}
    found["scene"] = {"physics_dt": env.physics_dt, "dt": env.step_dt, "decimation": env.cfg["decimation"]}
    return found


def _observation(term: ObservationTerm, robot: Robot) -> Tree:
    bound = term.term
    overloads = {key: bound.fields.get(key) for key in ("scale", "clip", "flatten_history_dim")}
    overloads["history_length"] = term.history_length
    entry: Tree = {"name": _name({TARGET: bound.target}), "mdp_type": "Observation", "dtype": "torch.float32"}
    entry |= {"shape": [term.width], "overloads": overloads, "extras": {"term": bound.name}}
    if entry["name"].startswith("joint_"):
        chosen = getattr(bound.params.get("asset_cfg"), "joint_ids", slice(None))
        joints = torch.arange(len(robot.joint_names))[chosen].tolist()
        entry["joint_names"] = [robot.joint_names[joint] for joint in joints]
    return entry


def _name(node: Tree) -> str:
    """Return the name of a node's class or function; an empty string without one."""
    return str(node.get(TARGET, "")).rpartition(".")[2]


def _prim_path(expression: str) -> str:
    """Return the prim path of the ground, or of the bodies that match an expression."""
    if expression == "ground":
        return _GROUND
    return f"{_ROBOT}/({expression})" if "|" in expression else f"{_ROBOT}/{expression}"
