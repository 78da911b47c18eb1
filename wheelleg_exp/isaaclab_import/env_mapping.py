"""Convert Isaac Lab's ``env.yaml`` to the config section ``env`` of this project.

Terms have Isaac Lab's names here, so most nodes only change their form. The report has a row for each node, and a row
for each setting that was changed, assumed, or dropped.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from typing import Any

from wheelleg_exp.asset.robot_description import Dof
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.isaaclab_import.import_report import (
    ASSUMED,
    CODE,
    DROPPED,
    NAME,
    NOT_NEEDED,
    RULE,
    ImportReport,
    Section,
    shown,
)
from wheelleg_exp.sim.names import values_by_name
from wheelleg_exp.terms.term_binding import RESERVED, resolve_target, signature_parameters

Tree = Mapping[str, Any]
# Isaac Lab's kinds of terms: the config section here, and the module of ``wheelleg_exp.mdp``.
KINDS = {
    "commands": "commands",
    "actions": "actions",
    "observations": "observations",
    "events": "events",
    "rewards": "rewards",
    "terminations": "terminations",
    "curriculum": "curriculums",
}
_STOCK = re.compile(
    r"(omni\.isaac\.lab|isaaclab)\.|(omni\.isaac\.lab_tasks|isaaclab_tasks)\.manager_based\.locomotion\.velocity\.mdp\b"
)
_DRAWN = "nothing is drawn during training"
_STAGE = "there is no Omniverse stage"
_PHYSX = "a setting of PhysX; MuJoCo solves contacts differently"
_ENGINE = "the engine's memory and rendering are set elsewhere"
_ROOT_DROPPED = {
    _DRAWN: ("viewer", "ui_window_class_type", "rerender_on_reset", "num_rerenders_on_reset", "wait_for_textures"),
    "teleoperation is not part of a task": ("xr", "teleop_devices"),
    "runs are recorded in their own format": ("recorders", "export_io_descriptors", "log_dir"),
}
_SIM_DROPPED = {
    _ENGINE: (
        "device",
        "render_interval",
        "render",
        "use_fabric",
        "enable_scene_query_support",
        "create_stage_in_memory",
    ),
    _STAGE: (
        "physics_prim_path",
        "logging_level",
        "save_logs_to_file",
        "log_dir",
        "visualizer_cfgs",
    ),
    _PHYSX: ("physx", "physics", "disable_contact_processing", "use_gpu_pipeline"),
}
_SCENE_DROPPED = ("lazy_sensor_update", "replicate_physics", "filter_collisions", "clone_in_fabric")
_ROBOT_DROPPED = (
    *("prim_path", "collision_group", "debug_vis", "articulation_root_prim_path", "class_type"),
    "actuator_value_resolution_debug_print",
)
_SPAWN_DROPPED = (
    *("func", "visible", "semantic_tags", "copy_from_source", "activate_contact_sensors", "visual_material_path"),
    *("visual_material", "make_instanceable", "force_usd_conversion", "usd_dir", "usd_file_name", "merge_fixed_joints"),
)
_TERRAIN_DROPPED = (
    *("class_type", "prim_path", "collision_group", "debug_vis", "num_envs", "env_spacing", "use_terrain_origins"),
    *("visual_material", "use_cache", "cache_dir", "color_scheme"),
)
_SENSOR_DROPPED = ("debug_vis", "visualizer_cfg", "class_type", "prim_path")
# PhysX combines two materials with the mode of higher priority.
_COMBINE = ("average", "min", "multiply", "max")
_ACTUATORS = {
    "ImplicitActuator", "IdealPDActuator", "DCMotor", "DelayedPDActuator", "RemotizedPDActuator", "ActuatorNetMLP",
    "ActuatorNetLSTM",
}  # fmt: skip
NOISES = {"uniform_noise": "UniformNoise", "gaussian_noise": "GaussianNoise", "constant_noise": "ConstantNoise"}
MODIFIERS = {"scale": "Scale", "clip": "Clip", "bias": "Bias"}
PATTERNS = {"grid_pattern": "GridPattern", "lidar_pattern": "LidarPattern", "bpearl_pattern": "BpearlPattern"}
# Isaac Lab's functions of terrain tiles: the class here, and settings that the function implies.
TILES: dict[str, tuple[str, dict[str, Any]]] = {
    "flat_terrain": ("Flat", {}),
    "random_uniform_terrain": ("RandomUniform", {}),
    "pyramid_sloped_terrain": ("PyramidSlope", {}),
    "pyramid_stairs_terrain": ("PyramidStairs", {}),
    "inverted_pyramid_stairs_terrain": ("PyramidStairs", {"inverted": True}),
    "random_grid_terrain": ("RandomGrid", {}),
    "discrete_obstacles_terrain": ("DiscreteObstacles", {}),
    "wave_terrain": ("Waves", {}),
    "stepping_stones_terrain": ("SteppingStones", {}),
    "gap_terrain": ("Gap", {}),
    "rails_terrain": ("Rails", {}),
    "box_terrain": ("Box", {}),
    "pit_terrain": ("Box", {"inverted": True}),
}
TILE_NAMES = {
    "pit_depth_range": "box_height_range",
    "double_pit": "double_box",
    "flat_patch_sampling": "flat_patches",
}
# Keys with values by joint expression, besides those with ``joint`` in their names.
_BY_JOINT = (
    *("scale", "offset", "clip", "stiffness", "damping", "effort_limit", "velocity_limit", "effort_limit_sim"),
    *("velocity_limit_sim", "armature", "friction", "viscous_friction", "dynamic_friction"),
)
_CONTACTS = 8  # most contacts of a body that are summed; Isaac Lab sums all
_FRICTION = 0.5  # Isaac Lab's default coefficient of a material


class EnvMapping:
    """Converts one ``env.yaml``.

    ``dofs`` are the robot file's joints by name, and ``links`` the names of its links. ``names`` maps the run's names
    of joints and links to other names in the robot file.

    ``user_target`` returns the target of a function of the author, such as ``my_robot.rewards.energy``, or None if its
    code is unknown. After ``convert``, ``robot`` and ``env`` contain the config, and ``lost`` the names of observation
    groups that lack a term, and ``networks`` the file names of actuator networks.
    """

    def __init__(
        self,
        tree: Tree,
        dofs: Mapping[str, Dof],
        user_target: Callable[[str, Iterable[str]], str | None],
        report: ImportReport,
        names: Mapping[str, str] | None = None,
        links: Iterable[str] = (),
    ) -> None:
        self._names = _Names(names or {}, dofs, links)
        self._root = Section(self._names.applied(tree), "", report)
        self._dofs, self._user_target, self._report = dofs, user_target, report
        self._robot_name = "robot"
        # Isaac Lab 3.0 has ``sim.physics`` instead of ``sim.physx``, and quaternions (x, y, z, w).
        self._xyzw = "physx" not in (tree.get("sim") or {"physx": None})
        self.robot: dict[str, Any] = {}
        self.env: dict[str, Any] = {}
        self.seed: int | None = None
        self.lost: list[str] = []
        self.networks: list[str] = []

    def convert(self) -> None:
        """Convert the whole file."""
        root = self._root
        self.seed = root.take("seed")
        for name in ("decimation", "episode_length_s"):
            value = root.take(name)
            if value is None:
                raise ConfigError("the key is missing", key=f"env.yaml: {name}", expected="Isaac Lab's env.yaml")
            self.env[name] = value
        if root.take("is_finite_horizon"):
            self.env["is_finite_horizon"] = True
        sim = root.section("sim")
        material = sim.section("physics_material")
        self.env["sim"] = {"dt": sim.take("dt", 1 / 60), "gravity": sim.take("gravity", [0.0, 0.0, -9.81])}
        for reason, names in _SIM_DROPPED.items():
            sim.drop(names, reason, DROPPED if reason == _PHYSX else NOT_NEEDED)
        sim.finish()
        self._scene(root.section("scene"), material)
        for kind in KINDS:
            self.env[kind] = self._terms(kind, root.section(kind))
        for reason, names in _ROOT_DROPPED.items():
            root.drop(names, reason, NOT_NEEDED)
        root.finish()

    # --- scene ---

    def _scene(self, scene: Section, material: Section) -> None:
        self.env["num_envs"] = int(scene.take("num_envs", 4096))
        self.env["scene"] = {"env_spacing": scene.take("env_spacing", 2.5), "terrain": None, "sensors": {}}
        scene.drop(_SCENE_DROPPED, "each environment is a simulation of its own", NOT_NEEDED)
        modes: list[str] = []
        frictions = self._frictions(material, modes)
        sensors = {"ContactSensor": self._contact_sensor, "RayCaster": self._ray_caster, "Imu": self._imu}
        robots = 0
        for name, node in list(scene.items()):
            kind = _last(node.get("class_type")) if isinstance(node, Mapping) else ""
            key = f"scene.{name}"
            part = Section(node if kind else None, key, self._report)
            if kind == "Articulation":
                robots += 1
                if robots > 1:
                    raise ConfigError("the run has two robots", key=key, expected="one articulation in the scene")
                self._robot_name = name
                self._robot(part)
            elif kind == "TerrainImporter":
                self.env["scene"]["terrain"] = self._terrain(part, modes)
            elif kind in sensors:
                self.env["scene"]["sensors"][name] = sensors[kind](part)
            elif "spawn_light" in str(node) or "Light" in str(node):
                self._report.add(key, NOT_NEEDED, f"a light: {_DRAWN}")
            elif "spawn_ground_plane" in str(node):
                material_there = Section(_spawn(node), f"{key}.spawn", self._report).section("physics_material")
                self.env["scene"]["terrain"] = _plane(*self._frictions(material_there, modes))
                self._report.add(key, RULE, "a plane")
            else:
                what = kind or _last(_spawn(node).get("func")) or "object"
                self._report.add(key, DROPPED, f"a {what}: the scene contains only the robot, the ground, and sensors")
        if not robots:
            raise ConfigError("the run has no articulation", key="env.yaml: scene", expected="a robot")
        if self.env["scene"]["terrain"] is None:
            self._report.add("scene.terrain", ASSUMED, f"a plane with friction {_FRICTION}, Isaac Lab's default")
            self.env["scene"]["terrain"] = _plane(_FRICTION, _FRICTION)
        mode = max(modes, key=_COMBINE.index)
        self.robot["friction_combine_mode"] = mode
        self._report.add("friction_combine_mode", RULE, f"{mode}: the mode of higher priority, as in PhysX")
        self._robot_material(*frictions)

    def _frictions(self, material: Section, modes: list[str]) -> tuple[float, float]:
        """Return the static and dynamic friction of a material, and add its combine mode to ``modes``."""
        modes.append(material.take("friction_combine_mode", "average"))
        material.drop(["restitution"], "MuJoCo's contacts have no restitution")
        static, dynamic = (material.take(f"{kind}_friction", _FRICTION) for kind in ("static", "dynamic"))
        if static != dynamic:
            text = f"{dynamic}: MuJoCo has one coefficient, and the static one ({static}) counts"
            self._report.add(f"{material.key}.dynamic_friction", DROPPED, text)
        return static, dynamic

    def _robot_material(self, static: float, dynamic: float) -> None:
        """Give all bodies the run's default material; a later event of the run can draw other frictions."""
        target = "wheelleg_exp.mdp.events.randomize_rigid_body_material"
        node: dict[str, Any] = {"_target_": target, "mode": "startup"}
        node |= {"static_friction_range": [static, static], "dynamic_friction_range": [dynamic, dynamic]}
        node |= {"restitution_range": [0.0, 0.0], "num_buckets": 1, "asset_cfg": _entity("robot", body_names=[".*"])}
        self.env["events"] = {"default_material": node}
        text = f"friction {static} (static) and {dynamic} (dynamic) of all bodies, as an event"
        self._report.add("sim.physics_material", RULE, text)

    def _robot(self, part: Section) -> None:
        spawn, init = part.section("spawn"), part.section("init_state")
        articulation = spawn.section("articulation_props")
        fixed = articulation.take("fix_root_link", spawn.take("fix_base"))
        source = next((spawn.take(name) for name in ("usd_path", "asset_path") if name in spawn.left), None)
        self.robot |= {
            "base": "fixed" if fixed else "floating",
            "init_state": {
                "pos": init.take("pos", [0.0, 0.0, 0.0]),
                "rot": self._quaternion(init.take("rot"), "scene.robot.init_state.rot"),
                "joint_pos": self._per_joint(init.take("joint_pos", {".*": 0.0})),
                "joint_vel": self._per_joint(init.take("joint_vel", {".*": 0.0})),
            },
            "joint_order": part.take("joint_order"),
            "soft_joint_pos_limit_factor": part.take("soft_joint_pos_limit_factor", 1.0),
            "friction_source": "static",
            "self_collisions": articulation.take("enabled_self_collisions"),
        }
        if source:
            self._report.add(
                f"{spawn.key}.usd_path", ASSUMED, f"{shown(source)}: the given robot file is the same robot"
            )
        init.skip(*(name for name in ("lin_vel", "ang_vel") if not any(init.left.get(name) or [])))
        init.finish("resets set the velocity by events")
        drive = spawn.take("joint_drive", {})
        gains = drive.get("gains") if isinstance(drive, Mapping) else None
        articulation.finish(_PHYSX)
        spawn.skip(*_SPAWN_DROPPED)
        spawn.finish("the robot file is not changed; PhysX's limits of bodies have no counterpart")
        nodes = part.section("actuators")
        self._require_joints({**self.robot["init_state"]["joint_pos"], **self.robot["init_state"]["joint_vel"]})
        self.robot["actuators"] = {
            name: self._actuator(Section(n, f"{nodes.key}.{name}", self._report), gains or {})
            for name, n in nodes.items()
        }
        driven = [text for node in self.robot["actuators"].values() for text in _listed(node["joint_names_expr"])]
        free = [name for name in self._dofs if not any(re.fullmatch(text, name) for text in driven)]
        if free:
            text = f"no actuator drives {', '.join(free)}: these joints of the robot file move freely"
            self._report.add("scene.robot.actuators", ASSUMED, text)
        part.skip(*_ROBOT_DROPPED)
        part.finish()

    def _actuator(self, part: Section, gains: Tree) -> dict[str, Any]:
        source = str(part.take("class_type", ""))
        kind = _last(source)
        if kind not in _ACTUATORS or not source.startswith(("isaaclab.", "omni.isaac.lab.")):
            has = part.left
            kind = "DCMotor" if has.get("saturation_effort") else "IdealPDActuator"
            kind = "DelayedPDActuator" if has.get("max_delay") and kind != "DCMotor" else kind
            self._report.add(part.key, ASSUMED, f"{source or 'an actuator'} is taken as {kind}")
        else:
            self._report.add(part.key, NAME, kind)
        implicit = kind == "ImplicitActuator"
        expressions = part.take("joint_names_expr", [".*"])
        self._require_joints(_listed(expressions))
        accepted = signature_parameters(resolve_target(f"wheelleg_exp.sim.actuators.{kind}", part.key))
        joints = [name for name in self._dofs if any(re.fullmatch(text, name) for text in _listed(expressions))]
        node: dict[str, Any] = {"_target_": f"wheelleg_exp.sim.actuators.{kind}", "joint_names_expr": expressions}
        for name in ("effort_limit", "velocity_limit"):
            own, of_engine = part.take(name), part.take(f"{name}_sim")
            if implicit:
                # Isaac Lab ignores the velocity limit of an implicit actuator.
                own, of_engine = of_engine if of_engine is not None else own if name == "effort_limit" else None, None
            elif name == "velocity_limit":
                own = own if own is not None else of_engine
            if name in accepted:
                limit = self._per_joint(own) if own is not None else self._from_file(part.key, name, joints)
                node[name] = self._smaller(limit, of_engine, joints) if name == "effort_limit" else limit
        for name in ("stiffness", "damping"):
            own = part.take(name)
            own = own if own is not None else gains.get(name)
            if name in accepted:
                node[name] = self._per_joint(own) if own is not None else self._from_file(part.key, name, joints)
        network = part.take("network_file")
        if network is not None:
            self.networks.append(_file_name(network))
            node["network_file"] = _file_name(network)
        dynamic = part.take("dynamic_friction")
        if dynamic:
            self._report.add(
                f"{part.key}.dynamic_friction", DROPPED, f"{shown(dynamic)}: MuJoCo has one friction per joint"
            )
        for name, value in part.take_if_known(accepted).items():
            node[name] = self._per_joint(value) if isinstance(value, Mapping) else value
        part.finish()
        return node

    def _require_joints(self, expressions: Iterable[str]) -> None:
        """Raise ConfigError if an expression matches no joint of the robot file."""
        unknown = [text for text in expressions if self._dofs and not any(re.fullmatch(text, n) for n in self._dofs)]
        if unknown:
            message = f"the robot file has no joint {', '.join(unknown[:5])}"
            expected = f"the robot of the run, or --names FILE; the file has {', '.join(self._dofs)}"
            raise ConfigError(message, key="scene.robot", expected=expected)

    def _smaller(self, limit: Any, of_engine: Any, joints: list[str]) -> Any:
        """Return the smaller of an explicit actuator's own limit and PhysX's, which clips its torques."""
        if of_engine is None:
            return limit
        own, engine = (
            values_by_name(value, joints, None, key="effort_limit", what="joint") for value in (limit, of_engine)
        )
        pairs = zip(joints, own, engine, strict=True)
        return {
            re.escape(name): min(v for v in both if v is not None)
            for name, *both in pairs
            if any(v is not None for v in both)
        }

    def _from_file(self, key: str, name: str, joints: list[str]) -> Any:
        """Return a gain or limit from the robot's file, as Isaac Lab does for null."""
        found: dict[str, float] = {}
        for joint in joints:
            dof = self._dofs[joint]
            drive = dof.drive
            if name == "velocity_limit":
                found[joint] = dof.max_velocity or math.inf
            elif name == "effort_limit":
                limits = [drive.effort] if drive is not None and drive.effort else []
                limits += [max(map(abs, dof.force_range))] if dof.force_range is not None else []
                found[joint] = min(limits, default=math.inf)
            else:
                found[joint] = getattr(drive, name) if drive is not None else 0.0
        same = len(set(found.values())) <= 1
        value: Any = next(iter(found.values()), 0.0) if same else {re.escape(joint): v for joint, v in found.items()}
        self._report.add(f"{key}.{name}", ASSUMED, f"{shown(value)}, from the robot's file")
        return value

    def _per_joint(self, value: Any) -> Any:
        if isinstance(value, Mapping):
            return {str(name): float(number) for name, number in value.items()}
        if isinstance(value, list):
            message = f"{shown(value)} is a list"
            raise ConfigError(message, key="scene.robot: joint_pos or a gain", expected="numbers by joint expression")
        return value

    def _quaternion(self, value: Any, key: str) -> list[float]:
        if value is None:
            return [1.0, 0.0, 0.0, 0.0]
        if self._xyzw:
            self._report.add(key, RULE, "(x, y, z, w) of Isaac Lab 3.0 became (w, x, y, z)")
            return [value[3], *value[:3]]
        return list(value)

    def _terrain(self, part: Section, modes: list[str]) -> dict[str, Any]:
        kind = part.take("terrain_type", "plane")
        node = _plane(*self._frictions(part.section("physics_material"), modes))
        generator, level = part.section("terrain_generator"), part.take("max_init_terrain_level")
        if kind == "generator":
            accepted = signature_parameters(resolve_target("wheelleg_exp.sim.terrain.TerrainGenerator", part.key))
            node["_target_"] = "wheelleg_exp.sim.terrain.TerrainGenerator"
            tiles = generator.section("sub_terrains")
            node |= {
                "num_rows": 1,
                "num_cols": 1,
                "border_width": 0.0,
                "difficulty_range": [0.0, 1.0],
                "curriculum": False,
            }
            node |= {"horizontal_scale": 0.1, "vertical_scale": 0.005}
            node |= generator.take_if_known(accepted)
            node |= {"max_init_terrain_level": level} if level is not None else {}
            node["sub_terrains"] = {}
            for name, tile in tiles.items():
                made = self._tile(Section(tile, f"{tiles.key}.{name}", self._report))
                node["sub_terrains"] |= {} if made is None else {name: made}
            if not node["sub_terrains"]:
                raise ConfigError("none of the tiles exists here", key=tiles.key, expected=", ".join(TILES))
            self._report.add(part.key, NAME, "TerrainGenerator")
            generator.drop(("slope_threshold",), "tiles of boxes have vertical edges, other tiles have slopes")
            generator.drop(("border_height",), "the border ends at the level of the ground")
            generator.skip(*_TERRAIN_DROPPED)
            generator.finish()
        else:
            outcome = NAME if kind == "plane" else DROPPED
            self._report.add(
                part.key, outcome, "Plane" if kind == "plane" else f"terrain of type {kind}: a plane replaces it"
            )
        part.skip(*_TERRAIN_DROPPED)
        part.finish()
        return node

    def _tile(self, part: Section) -> dict[str, Any] | None:
        function = _last(part.take("function"))
        if function not in TILES:
            text = f"'{function}' is no tile here; the shares of the other tiles grow"
            self._report.add(part.key, DROPPED, text)
            return None
        kind, implied = TILES[function]
        node: dict[str, Any] = {"_target_": f"wheelleg_exp.sim.terrain.{kind}", **implied}
        accepted = signature_parameters(resolve_target(node["_target_"], part.key))
        for there, here in TILE_NAMES.items():
            value = part.take(there)
            if value is not None:
                node[here] = value
        if kind == "PyramidSlope":
            low, high = part.take("slope_range")
            node["slope_range"] = [math.atan(low), math.atan(high)]
            self._report.add(
                f"{part.key}.slope_range", RULE, f"[{low}, {high}] (rise over run) became radians, also between them"
            )
        node |= part.take_if_known(accepted)
        self._report.add(part.key, NAME, kind)
        part.skip("size", "vertical_scale")
        part.drop(("slope_threshold",), "the tile has slopes")
        part.finish()
        return node

    def _contact_sensor(self, part: Section) -> dict[str, Any]:
        node: dict[str, Any] = {"_target_": "wheelleg_exp.sim.sensors.ContactSensor"}
        node |= {"body_names": self._bodies(part.take("prim_path")), "history_length": part.take("history_length", 0)}
        node |= {"track_air_time": part.take("track_air_time", False), "max_contacts": _CONTACTS}
        node |= {"force_threshold": part.take("force_threshold", 1.0)}
        paths = part.take("filter_prim_paths_expr", [])
        if paths:
            node["filter_body_names"] = [name for path in paths for name in self._bodies(path)]
        period = part.take("update_period", 0.0)
        if period and period > self.env["sim"]["dt"]:
            node["update_period"] = period
        node |= part.take_if_known(("track_pose", "track_contact_points", "track_friction_forces"))
        self._report.add(part.key, NAME, "ContactSensor")
        part.skip("max_contact_data_count_per_prim", "max_contact_data_per_prim", *_SENSOR_DROPPED)
        part.finish()
        return node

    def _ray_caster(self, part: Section) -> dict[str, Any]:
        node = self._mounted(part, "RayCaster")
        yaw = part.take("attach_yaw_only")
        node["ray_alignment"] = part.take("ray_alignment", "yaw" if yaw else "base")
        pattern = part.section("pattern_cfg")
        kind = PATTERNS.get(_last(pattern.take("func")))
        if kind is None:
            raise ConfigError("this pattern of rays does not exist here", key=pattern.key, expected=", ".join(PATTERNS))
        node["pattern"] = {"_target_": f"wheelleg_exp.sim.sensors.{kind}"}
        node["pattern"] |= pattern.take_if_known(
            signature_parameters(resolve_target(node["pattern"]["_target_"], part.key))
        )
        pattern.finish()
        node |= part.take_if_known(("max_distance", "drift_range", "ray_cast_drift_range", "update_period"))
        part.skip("history_length", "mesh_prim_paths", *_SENSOR_DROPPED)
        part.finish()
        return node

    def _imu(self, part: Section) -> dict[str, Any]:
        node = self._mounted(part, "Imu")
        node |= part.take_if_known(("gravity_bias", "update_period"))
        part.skip("history_length", *_SENSOR_DROPPED)
        part.finish()
        return node

    def _mounted(self, part: Section, kind: str) -> dict[str, Any]:
        """Return the node of a sensor on a body, with the sensor's pose in the frame of the body."""
        self._report.add(part.key, NAME, kind)
        offset, body = part.section("offset"), self._bodies(part.take("prim_path"))[0]
        pose = {
            "pos": offset.take("pos", [0.0, 0.0, 0.0]),
            "rot": self._quaternion(offset.take("rot"), offset.key),
        }
        return {"_target_": f"wheelleg_exp.sim.sensors.{kind}", "body_name": body, "offset": pose}

    def _bodies(self, prim_path: Any) -> list[str]:
        """Return expressions of bodies: the last part of a prim path such as ``/World/envs/env_.*/Robot/.*_foot``."""
        if str(prim_path).startswith("/World/ground"):
            return ["ground"]
        return self._names.of(str(prim_path or ".*").rsplit("/", 1)[-1], "link")

    # --- terms ---

    def _terms(self, kind: str, part: Section) -> dict[str, Any]:
        made: dict[str, Any] = dict(self.env.get(kind) or {})
        for name, node in part.items():
            key = f"{kind}.{name}"
            if not isinstance(node, Mapping):
                self._report.add(key, DROPPED, f"{shown(node)}: not a term")
            elif kind == "observations":
                made[name] = self._group(Section(node, key, self._report), name)
            else:
                term = self._term(kind, Section(node, key, self._report))
                made |= {} if term is None else {name: term}
        return made

    def _group(self, part: Section, name: str) -> dict[str, Any]:
        group: dict[str, Any] = {"terms": {}, "concatenate_terms": True, "enable_corruption": False}
        group |= {"history_length": 0, "flatten_history_dim": True}
        no_history = part.left.get("history_length") == 0  # null leaves each term its own history
        group |= part.take_if_known((*[key for key in group if key != "terms"], "concatenate_dim", "history_order"))
        if group.get("concatenate_dim") == -1:
            del group["concatenate_dim"]
        for term, node in part.items():
            key = f"{part.key}.{term}"
            if not isinstance(node, Mapping):
                self._report.add(key, DROPPED, f"{shown(node)}: not a term")
                continue
            made = self._term("observations", Section(node, key, self._report))
            if made is None:
                self.lost.append(name)
            else:
                if no_history or not made.get("history_length"):
                    made.pop("history_length", None)
                    made.pop("flatten_history_dim", None)
                group["terms"][term] = made
        if not group["history_length"]:
            del group["history_length"]
            del group["flatten_history_dim"]
        return group

    def _term(self, kind: str, part: Section) -> dict[str, Any] | None:
        source = str(part.take("func") or part.take("class_type") or "")
        part.take("class_type")
        params = part.left.get("params")
        target, name = self._target(kind, source, params if isinstance(params, Mapping) else ()), _last(source)
        if target is None:
            reason = getattr(import_module(f"wheelleg_exp.mdp.{KINDS[kind]}"), "ABSENT", {}).get(name)
            text = f"{source} {shown(part.left, 160)}" if reason is None else f"{source}: {reason}"
            self._report.add(part.key, CODE if reason is None else DROPPED, text)
            return None
        node: dict[str, Any] = {"_target_": target}
        own = target.startswith("wheelleg_exp.")
        node |= {key: self._value(key, value) for key, value in part.take_if_known(RESERVED[kind]).items()}
        if kind == "events" and node.get("mode") != "interval":
            node.pop("interval_range_s", None)
            node.pop("is_global_time", None)
        if kind == "events" and node.get("mode") != "reset":
            node.pop("min_step_count_between_reset", None)
        params = part.section("params")
        if kind in ("actions", "commands"):
            params = part
            period = part.left.get("resampling_time_range")
            if isinstance(period, list) and 0.0 in period:
                step = self.env["sim"]["dt"] * self.env["decimation"]
                part.left["resampling_time_range"] = [max(time, step) for time in period]
                self._report.add(
                    f"{part.key}.resampling_time_range", RULE, f"{period}: a new draw in each control step"
                )
            part.skip(*(key for key in part.left if key == "debug_vis" or key.endswith("visualizer_cfg")))
        accepted = set(signature_parameters(resolve_target(target, part.key))) if own else None
        for key, value in params.items():
            if key == "asset_name" and value == self._robot_name:
                continue
            if accepted is not None and key not in accepted:
                self._report.add(f"{params.key}.{key}", DROPPED, f"{shown(value)}: '{name}' has no such parameter here")
            else:
                node[key] = self._value(key, value)
        if kind == "actions" and not node.get("preserve_order") and "joint_names" in node:
            node["joint_names"] = _one_expression(node["joint_names"])
        part.finish()
        self._report.add(part.key, NAME if own else RULE, name if own else f"{source} became {target}")
        return node

    def _target(self, kind: str, source: str, params: Iterable[str]) -> str | None:
        module = f"wheelleg_exp.mdp.{KINDS[kind]}"
        stock = _STOCK.match(source) and callable(getattr(import_module(module), _last(source), None))
        return f"{module}.{_last(source)}" if stock else self._user_target(source, params)

    def _value(self, key: str, value: Any) -> Any:
        if isinstance(value, Mapping):
            if "joint_names" in value and "body_names" in value and "name" in value:
                name = "robot" if value["name"] == self._robot_name else value["name"]
                chosen = {part: value[part] for part in ("joint_names", "body_names") if value[part] is not None}
                if not value.get("preserve_order"):
                    chosen = {part: _one_expression(names) for part, names in chosen.items()}
                for part in ("joint_ids", "body_ids"):
                    ids = value.get(part)
                    if ids is not None and part.replace("ids", "names") not in chosen:
                        if not all(isinstance(number, int) for number in ids):
                            message = f"{shown(ids)} is not a list of numbers"
                            raise ConfigError(message, key=f"{key}.{part}", expected=f"names in {part[:-4]}_names")
                        chosen[part] = ids
                return _entity(name, **chosen, **({"preserve_order": True} if value.get("preserve_order") else {}))
            kind = _last(value.get("func") or value.get("class_type"))
            if key in ("noise", "noise_cfg", "bias_noise_cfg") and kind:
                rest = {
                    name: self._value(name, item) for name, item in value.items() if name not in ("func", "class_type")
                }
                kind = "NoiseModelWithAdditiveBias" if "bias_noise_cfg" in value else NOISES.get(kind, kind)
                return {"_target_": f"wheelleg_exp.mdp.noise.{kind}", **rest}
            return {name: self._value(name, item) for name, item in value.items()}
        if key == "modifiers" and isinstance(value, list):
            made = []
            for item in value:
                kind = _last(item.get("func"))
                settings = {name: setting for name, setting in item.items() if name not in ("func", "params")}
                settings |= item.get("params") or {}
                made.append({"_target_": f"wheelleg_exp.mdp.modifiers.{MODIFIERS.get(kind, kind)}", **settings})
            return made
        return value


def _last(path: Any) -> str:
    """Return the name after the module of a path such as ``isaaclab.envs.mdp.rewards:is_alive``."""
    return re.split(r"[.:]", str(path or ""))[-1]


def _spawn(node: Any) -> Mapping[str, Any]:
    return node.get("spawn") or {} if isinstance(node, Mapping) else {}


class _Names:
    """The run's names of joints and links whose names in the robot file differ.

    For example, with the table ``{q1: l01}``, ``joint_names: [q.*]`` becomes ``[l01, q.*]`` if the robot file has other
    joints that match ``q.*``, and otherwise ``[l01]``.
    """

    def __init__(self, table: Mapping[str, str], joints: Iterable[str], links: Iterable[str]) -> None:
        self._known = {"joint": set(joints), "link": set(links)}
        unknown = [new for new in table.values() if not any(new in names for names in self._known.values())]
        if unknown:
            expected = ", ".join([*self._known["joint"], *self._known["link"]])
            raise ConfigError(f"the robot file has no joint or link '{unknown[0]}'", key="--names", expected=expected)
        self._tables = {
            kind: {old: new for old, new in table.items() if new in names} for kind, names in self._known.items()
        }

    def applied(self, value: Any, kind: str = "") -> Any:
        """Return ``value`` with new names; ``kind`` is the kind of names that it holds, or an empty text."""
        if not self._tables["joint"] and not self._tables["link"]:
            return value
        if isinstance(value, Mapping):
            found: dict[str, Any] = {}
            for key, item in value.items():
                own = "link" if "bod" in str(key) else "joint" if "joint" in str(key) or key in _BY_JOINT else kind
                found |= dict.fromkeys(self.of(str(key), kind), self.applied(item, own))
            return found
        if isinstance(value, list):
            new = [(item, self.applied(item, kind)) for item in value]
            return [part for item, parts in new for part in (self.of(item, kind) if isinstance(item, str) else [parts])]
        if isinstance(value, str):
            names = self.of(value, kind)
            return names[0] if len(names) == 1 else names
        return value

    def of(self, expression: str, kind: str) -> list[str]:
        """Return the expressions that replace an expression of joints or links."""
        table, known = self._tables.get(kind, {}), self._known.get(kind, set())
        try:
            found = [] if expression == ".*" else [new for old, new in table.items() if re.fullmatch(expression, old)]
            matches = any(re.fullmatch(expression, name) for name in known)
        except re.error:
            return [expression]
        return [*found, expression] if matches or not found else found


def _file_name(path: Any) -> str:
    return re.split(r"[/\\]", str(path))[-1]


def _listed(expressions: Any) -> list[str]:
    return [expressions] if isinstance(expressions, str) else list(expressions)


def _one_expression(names: Any) -> Any:
    """Return several expressions as one, because their order has no effect."""
    return ["|".join(names)] if isinstance(names, list) and len(names) > 1 else names


def _entity(name: str, **chosen: Any) -> dict[str, Any]:
    return {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": name, **chosen}


def _plane(static: float, dynamic: float) -> dict[str, Any]:
    node = {"_target_": "wheelleg_exp.sim.terrain.Plane", "static_friction": static, "dynamic_friction": dynamic}
    return {**node, "restitution": 0.0}
