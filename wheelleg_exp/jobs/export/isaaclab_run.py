"""Export a run as a run folder of Isaac Lab 2.3.2: its configs, its IO descriptors, and its policy.

``params/env.yaml`` contains everything that has a counterpart in Isaac Lab. The notes name the rest.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from rsl_rl.models import MLPModel

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.files import write_bytes, write_text
from wheelleg_exp.isaaclab_import.agent_mapping import PPO, RUNNER
from wheelleg_exp.isaaclab_import.env_mapping import PATTERNS, TILE_NAMES, TILES
from wheelleg_exp.isaaclab_import.term_mapping import KINDS, MODIFIERS, NOISES
from wheelleg_exp.managers.observation_term import ObservationTerm
from wheelleg_exp.plain_data import dump_yaml
from wheelleg_exp.rl import export as formats
from wheelleg_exp.sim.robot import Robot
from wheelleg_exp.terms.term_binding import RESERVED, TARGET, resolve_target, signature_parameters

Tree = dict[str, Any]
_MDP, _TASKS = "isaaclab.envs.mdp", "isaaclab_tasks.manager_based.locomotion.velocity.mdp"
# Terms here that Isaac Lab does not have.
OWN_TERMS = frozenset(
    """
    action_acceleration_l2 action_delay_levels air_time_variance ang_vel_cmd_levels apply_body_impulse base_height
    base_height_exp base_height_over_ground_l2 base_roll_pitch body_air_time body_contact_forces body_contacts
    command_levels_by_skill command_range_levels feet_clearance_l2 feet_stumble flat_orientation_exp gait_phase
    joint_acc joint_effort_commanded joint_pos_sin_cos joint_power joint_symmetry_l1 joint_vel_rate_l2
    lin_vel_cmd_levels no_contact_count non_finite_state pitch_orientation_l2 randomize_effort_limits
    randomize_encoder_bias randomize_floor_slope randomize_imu_errors randomize_rigid_body_com_cumulative
    randomize_rigid_body_inertia root_height_over_ground_below_minimum root_link_lin_vel set_root_velocity stuck
    terrain_levels_by_distance terrain_tile_left track_base_height_exp track_base_tilt_exp travel_error travel_error_l2
    UniformBasePoseCommand UniformVelocityTravelCommand upward wheel_slip wheel_spin_in_air_l1
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
# Parameters that Isaac Lab's term, sensor, actuator, or tile of the same name does not have.
_OF_MESHES = ("border_width", "horizontal_scale", "boxes", "gap_depth")
OWN_PARAMETERS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("Flat", "RandomGrid", "Gap", "Rails", "Box"), _OF_MESHES),
    "PyramidStairs": _OF_MESHES[1:],
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
# Keys of nodes that are converted on their own, or that have no effect on the physics in Isaac Lab.
_MATERIAL = ("static_friction", "dynamic_friction", "restitution")
_OF_GENERATOR = (*_MATERIAL, "max_init_terrain_level", "sub_terrains")
_DELAYS = ("delay", "delay_jitter")
_ROBOT, _GROUND = "{ENV_REGEX_NS}/Robot", "/World/ground"
_NOISE_FUNCTIONS = {here: there for there, here in NOISES.items()}
_MODIFIER_FUNCTIONS = {here: there for there, here in MODIFIERS.items()}


def write_isaac_lab_run(
    folder: Path, env: ManagerBasedRLEnv, num_envs: int, agent: Mapping[str, Any], policy: MLPModel
) -> list[str]:
    """Write the run folder; return a note for each part of the config that Isaac Lab does not have.

    ``env`` is a simulation of the run, and ``num_envs`` the number of environments in the training.
    """
    converted = IsaacLabEnv({**env.cfg, "num_envs": num_envs}, env.seed)
    notes = "".join(f"# not here: {note}\n" for note in converted.notes)
    write_text(folder / "params" / "env.yaml", notes + dump_yaml(converted.tree))
    if "actor" in agent:
        write_text(folder / "params" / "agent.yaml", dump_yaml(isaac_lab_agent(agent, env.seed)))
    role = "student" if "student" in agent else "actor"
    descriptors = io_descriptors(env, agent["obs_groups"][role])
    write_text(folder / "io_descriptors" / "IO_descriptors.yaml", dump_yaml(descriptors))
    write_bytes(folder / "exported" / "policy.pt", formats.torchscript(policy))
    write_bytes(folder / "exported" / "policy.onnx", formats.onnx(policy))
    return converted.notes


class IsaacLabEnv:
    """Converts an ``env`` config to the content of ``env.yaml``; ``notes`` names what Isaac Lab does not have."""

    def __init__(self, env: Mapping[str, Any], seed: int) -> None:
        self.notes: list[str] = []
        scene, sim = env["scene"], env["sim"]
        robot, terrain = self._robot(env["robot"]), self._terrain(scene["terrain"], env["robot"])
        self.tree: Tree = {name: env[name] for name in ("decimation", "episode_length_s")}
        self.tree |= {"is_finite_horizon": env.get("is_finite_horizon", False), "seed": seed}
        self.tree["sim"] = {"dt": sim["dt"], "gravity": sim["gravity"], "render_interval": env["decimation"]}
        self.tree["sim"] |= {"physx": {}, "physics_material": terrain["physics_material"]}
        self.tree["scene"] = {"num_envs": env["num_envs"], "env_spacing": scene["env_spacing"]}
        self.tree["scene"] |= {"robot": robot, "terrain": terrain}
        self.tree["scene"] |= self._each(self._sensor, scene["sensors"], "scene.sensors")
        for kind in KINDS:
            convert = self._group if kind == "observations" else self._term
            self.tree[kind] = self._each(convert, env.get(kind) or {}, kind)

    def _each(self, convert: Any, nodes: Mapping[str, Any], key: str) -> Tree:
        """Convert each node that is not null, and return those that Isaac Lab has."""
        made = {name: convert(f"{key}.{name}", node) for name, node in nodes.items() if node is not None}
        return {name: node for name, node in made.items() if node is not None}

    def _values(self, key: str, name: str, node: Mapping[str, Any], skipped: Collection[str] = ()) -> Tree:
        """Return a node's values without those in ``skipped``; ``name`` is the class or function in Isaac Lab."""
        found = {}
        for parameter, value in node.items():
            if parameter in OWN_PARAMETERS.get(name, ()):
                self.notes.append(f"{key}.{parameter}: Isaac Lab's {name} has no such setting")
            elif parameter != TARGET and parameter not in skipped:
                found[parameter] = self._value(f"{key}.{parameter}", value)
        return found

    def _value(self, key: str, value: Any) -> Any:
        if isinstance(value, list):
            return [self._value(key, item) for item in value]
        if not isinstance(value, Mapping):
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

    def _robot(self, robot: Mapping[str, Any]) -> Tree:
        kind, file = ("urdf", "asset_path") if robot["asset"].endswith(".urdf") else ("usd", "usd_path")
        fixed = {"fixed": True, "floating": False}.get(robot["base"])
        spawn = {"func": f"isaaclab.sim.spawners.from_files:spawn_from_{kind}", file: robot["asset"]}
        spawn |= {"articulation_props": {"enabled_self_collisions": robot["self_collisions"], "fix_root_link": fixed}}
        found: Tree = {"class_type": "isaaclab.assets:Articulation", "prim_path": _ROBOT, "spawn": spawn}
        found |= {name: robot[name] for name in ("init_state", "soft_joint_pos_limit_factor")}
        return found | {"actuators": self._each(self._actuator, robot["actuators"], "robot.actuators")}

    def _actuator(self, key: str, node: Mapping[str, Any]) -> Tree:
        kind = _name(node)
        if node.get("delay") is not None:
            self.notes.append(f"{key}.delay: Isaac Lab has a DelayedPDActuator for it")
        values = self._values(key, kind, node, ("delay",))
        if kind == "ImplicitActuator":
            values |= {f"{limit}_sim": values.pop(limit) for limit in ("effort_limit", "velocity_limit")}
        return {"class_type": f"isaaclab.actuators:{kind}", **values}

    def _terrain(self, node: Mapping[str, Any], robot: Mapping[str, Any]) -> Tree:
        kind, key = _name(node), "scene.terrain"
        material = {name: node[name] for name in _MATERIAL}
        material["friction_combine_mode"] = robot.get("friction_combine_mode", "average")
        found: Tree = {"class_type": "isaaclab.terrains:TerrainImporter", "prim_path": _GROUND}
        found |= {"terrain_type": "plane", "physics_material": material}
        if kind == "TerrainGenerator":
            generator = self._values(key, kind, node, _OF_GENERATOR)
            generator["sub_terrains"] = self._each(self._tile, node["sub_terrains"], f"{key}.sub_terrains")
            found |= {"terrain_type": "generator", "terrain_generator": generator}
            found["max_init_terrain_level"] = node.get("max_init_terrain_level")
        elif kind != "Plane":
            self.notes.append(f"{key}: a plane replaces the {kind}")
        return found

    def _tile(self, key: str, node: Mapping[str, Any]) -> Tree | None:
        kind, inverted = _name(node), {"inverted": True} if node.get("inverted") else {}
        made = [function for function, tile in TILES.items() if tile in ((kind, inverted), (kind, {}))]
        if not made:
            self.notes.append(f"{key}: Isaac Lab has no {kind}")
            return None
        module = "trimesh.mesh_terrains" if kind in OWN_PARAMETERS else "height_field.hf_terrains"
        values = self._values(key, kind, node, ("inverted",) if kind in OWN_PARAMETERS else ())
        for there, here in TILE_NAMES.items():
            if here in values:
                values[there] = values.pop(here)
        if kind == "PyramidSlope":
            values["slope_range"] = [math.tan(angle) for angle in values["slope_range"]]
        return {"function": f"isaaclab.terrains.{module}:{made[-1]}", **values}

    def _sensor(self, key: str, node: Mapping[str, Any]) -> Tree | None:
        kind = _name(node)
        if kind not in ("ContactSensor", "RayCaster", "Imu"):
            self.notes.append(f"{key}: Isaac Lab's {kind} has other settings")
            return None
        others = ("body_names", "body_name", "filter_body_names", "pattern", "max_contacts")
        found: Tree = {"class_type": f"isaaclab.sensors:{kind}", **self._values(key, kind, node, others)}
        found["prim_path"] = _prim_paths(node.get("body_names", [node.get("body_name")]), one=True)[0]
        if node.get("filter_body_names"):
            found["filter_prim_paths_expr"] = _prim_paths(node["filter_body_names"])
        if kind == "RayCaster":
            pattern = _name(node["pattern"])
            function = next(function for function, name in PATTERNS.items() if name == pattern)
            found["pattern_cfg"] = {"func": f"isaaclab.sensors.ray_caster.patterns:{function}"}
            found["pattern_cfg"] |= self._values(f"{key}.pattern", pattern, node["pattern"])
            found["mesh_prim_paths"] = [_GROUND]
        return found

    def _group(self, key: str, group: Mapping[str, Any]) -> Tree:
        terms = self._each(self._term, group["terms"], key)
        if group.get("history_order", "term") != "term":
            self.notes.append(f"{key}.history_order: Isaac Lab orders histories by term")
        return self._values(key, "", group, ("terms", "history_order")) | terms

    def _term(self, key: str, node: Mapping[str, Any]) -> Tree | None:
        kind, name, target = key.partition(".")[0], _name(node), resolve_target(node[TARGET], key)
        module = target.__module__
        if any(node.get(parameter) for parameter in _DELAYS):
            self.notes.append(f"{key}.delay: Isaac Lab's terms have no delay")
        if module.startswith("wheelleg_exp."):
            parents = [parent for parent in getattr(target, "__mro__", ()) if parent.__module__ == module]
            name = next((known for known in (name, *(p.__name__ for p in parents)) if known not in OWN_TERMS), "")
            if not name:
                self.notes.append(f"{key}: Isaac Lab has no {_name(node)}")
                return None
            node = self._as_parent(key, node, name)
            name = RENAMED.get(name, name)
            module = _TASKS if name in TASK_TERMS else _MDP
        values = self._values(key, name, node, _DELAYS)
        if kind in ("actions", "commands", "recorders"):
            asset = {"asset_name": "robot"} if "asset_name" in signature_parameters(target) else {}
            return {"class_type": f"{module}:{name}", **asset, **values}
        fields = {parameter: values.pop(parameter) for parameter in RESERVED[kind] if parameter in values}
        return {"func": f"{module}:{name}", "params": values, **fields}

    def _as_parent(self, key: str, node: Mapping[str, Any], parent: str) -> Mapping[str, Any]:
        """Return a node without the parameters that its parent class does not have."""
        if parent == _name(node):
            return node
        known = signature_parameters(resolve_target(node[TARGET].replace(_name(node), parent), key))
        lost = [parameter for parameter in node if parameter not in (TARGET, *known)]
        self.notes.append(f"{key}: a {parent} without {', '.join(lost)}")
        return {parameter: value for parameter, value in node.items() if parameter not in lost}


def isaac_lab_agent(agent: Mapping[str, Any], seed: int) -> Tree:
    """Return the content of ``agent.yaml`` for rsl_rl's runner."""
    actor, critic, groups = agent["actor"], agent["critic"], agent["obs_groups"]
    noise = actor.get("distribution_cfg") or {}
    policy = {"class_name": "ActorCritic", "activation": actor["activation"]}
    policy |= {"init_noise_std": noise.get("init_std", 1.0), "noise_std_type": noise.get("std_type", "scalar")}
    for role, network in (("actor", actor), ("critic", critic)):
        policy |= {f"{role}_{name}": network[name] for name in ("hidden_dims", "obs_normalization")}
    algorithm = {name: agent["algorithm"][name] for name in ("class_name", *PPO) if name in agent["algorithm"]}
    runner = {name: agent[name] for name in RUNNER if name in agent}
    runner["obs_groups"] = {"policy": groups["actor"], "critic": groups["critic"]}
    return {"seed": seed, **runner, "policy": policy, "algorithm": algorithm}


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


def _name(node: Mapping[str, Any]) -> str:
    """Return the name of a node's class or function; an empty string without one."""
    return str(node.get(TARGET, "")).rpartition(".")[2]


def _prim_paths(names: Any, one: bool = False) -> list[str]:
    """Return the prim paths of bodies, given by expressions; ``one`` joins them to one path."""
    listed = [names] if isinstance(names, str) else list(names)
    listed = [f"({'|'.join(listed)})"] if one and len(listed) > 1 else listed
    return [_GROUND if name == "ground" else f"{_ROBOT}/{name}" for name in listed]
