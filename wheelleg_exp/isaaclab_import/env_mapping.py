"""Convert Isaac Lab's ``env.yaml`` to the config section ``env``; the report has a row for each node and change."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from wheelleg_exp.asset.robot_description import Dof
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.isaaclab_import.import_report import (
    ASSUMED,
    CODE,
    DROPPED,
    NAME,
    NOT_NEEDED,
    RULE,
    ImportReport,
    Row,
    Section,
    shown,
)
from wheelleg_exp.isaaclab_import.term_mapping import TermMapping, UserTarget, entity, last_name, parameters_of
from wheelleg_exp.isaaclab_import.tile_mapping import convert_generator
from wheelleg_exp.jobs.export.isaaclab_run import KINDS, MODIFIERS, NOISES, PATTERNS, TILES, Tree
from wheelleg_exp.sim.names import compiled, values_by_name

_DRAWN = "nothing is drawn during training"
_STAGE = "there is no Omniverse stage"
_ENGINE = "a setting of another physics engine or of its memory"
_SOLVER = ("solver", "integrator", "cone", "impratio", "iterations", "ls_iterations", "tolerance")
_RECORDED = "runs are recorded in their own format"
_ROOT_DROPPED = {
    _DRAWN: (
        *("viewer", "ui_window_class_type", "rerender_on_reset", "num_rerenders_on_reset", "wait_for_textures"),
        *("class_type", "video_recorders"),
    ),
    "teleoperation is not part of a task": ("xr", "teleop_devices"),
    _RECORDED: ("export_io_descriptors", "log_dir"),
}
_OF_DATASET = re.compile("dataset_|export_in_")
_SIM_DROPPED = {
    "the engine's memory and rendering are set elsewhere": (
        *("device", "render_interval", "render", "use_fabric", "enable_scene_query_support", "create_stage_in_memory"),
    ),
    _STAGE: ("physics_prim_path", "logging_level", "save_logs_to_file", "log_dir", "visualizer_cfgs"),
    _ENGINE: ("physx", "disable_contact_processing", "use_gpu_pipeline", "use_newton_actuators"),
}
_SCENE_DROPPED = (
    *("lazy_sensor_update", "replicate_physics", "filter_collisions", "clone_in_fabric", "class_type", "clone_cfg"),
)
_SPAWN_DROPPED = (
    *("func", "visible", "semantic_tags", "copy_from_source", "activate_contact_sensors", "visual_material_path"),
    *("visual_material", "make_instanceable", "force_usd_conversion", "usd_dir", "usd_file_name", "merge_fixed_joints"),
    "physics_material_path",
)
# Keys that do not change the simulation, of the robot, the terrain, and sensors.
_UNUSED = ("class_type", "prim_path", "collision_group", "debug_vis")
_ROBOT_UNUSED = (*_UNUSED, "articulation_root_prim_path", "actuator_value_resolution_debug_print")
_TERRAIN_UNUSED = (*_UNUSED, "num_envs", "env_spacing", "use_terrain_origins", "visual_material")
_SENSOR_UNUSED = (
    *_UNUSED,
    *("force_visualization_scale", "spawn", "mesh_prim_paths", "global_world_only", "use_cuda_graph"),
    *("max_contact_data_count_per_prim", "max_contact_data_per_prim"),
)
_ISAAC_LAB = re.compile(r"(omni\.isaac\.lab|isaaclab)\w*\.")
# Classes and functions that are recognised by the last part of their path.
_BY_LAST_NAME = {
    *("Articulation", "TerrainImporter", "ContactSensor", "RayCaster", "Imu", "Pva"),
    *(*TILES, *PATTERNS, *NOISES, *MODIFIERS),
}
# Keys of these classes and functions. Terms are recognised by their whole path, so an author's can have such a name.
_OF_LAST_NAME = re.compile(
    r"scene\.[^.]+|scene\..*\.(sub_terrains\.[^.]+|pattern_cfg)|([^.]+\.){3,}(noise|noise_cfg|bias_noise_cfg|modifiers)"
)
_MARKERS = re.compile(".*visualizer_cfg")
_ENVS = "/World/envs/env_.*"
_PARTS = re.compile(r"/(?![^\[]*\])")  # a set such as [^/] can contain the separator
_ONLY = "the scene contains only the robot, the ground, and the robot's sensors"
# PhysX combines two materials with the mode of higher priority.
_COMBINE = ("average", "min", "multiply", "max")
_ACTUATORS = {
    "ImplicitActuator", "IdealPDActuator", "DCMotor", "DelayedPDActuator", "RemotizedPDActuator", "ActuatorNetMLP",
    "ActuatorNetLSTM",
}  # fmt: skip
# Keys with values by joint expression, besides those with ``joint`` in their names.
_BY_JOINT = (
    *("scale", "offset", "clip", "stiffness", "damping", "effort_limit", "velocity_limit", "effort_limit_sim"),
    *("velocity_limit_sim", "armature", "friction", "viscous_friction", "dynamic_friction"),
)
_CONTACTS = 8  # most contacts of a body that are summed; Isaac Lab sums all
_FRICTION = 0.5  # Isaac Lab's default coefficient of a material


class EnvMapping:
    """Converts one ``env.yaml``.

    ``dofs`` and ``links`` are those of the robot file, to which ``names`` maps the run's names; ``directory`` is the
    folder of networks in the asset folder. ``user_target`` returns the target of a function of the author, such as
    ``my_robot.rewards.energy``, or None if its code is unknown. ``convert`` sets ``robot``, ``env``, ``lost``, the
    report's rows of missing terms by observation group, and ``networks``, the file names of actuator networks.
    """

    def __init__(
        self,
        tree: Tree,
        dofs: Mapping[str, Dof],
        user_target: UserTarget,
        report: ImportReport,
        names: Mapping[str, str] | None = None,
        links: Iterable[str] = (),
        directory: str = "networks",
    ) -> None:
        self._directory = directory
        self._names = _Names(names or {}, dofs, links)
        self._dofs, self._user_target, self._report = dofs, user_target, report
        self._foreign: dict[str, list[str]] = {}
        self._root = Section(self._prepared(self._names.applied(tree)), "", report)
        self._robot_name = "robot"
        self._xyzw = is_version_3(tree)  # Isaac Lab 3.0 has quaternions (x, y, z, w).
        self.robot: Tree = {}
        self.env: Tree = {}
        self.seed: int | None = None
        self.lost: dict[str, Row] = {}
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
        self._newton(sim.section("physics"))
        for reason, names in _SIM_DROPPED.items():
            sim.drop(names, reason, DROPPED if reason == _ENGINE else NOT_NEEDED)
        sim.finish()
        self._scene(root.section("scene"), material)
        terms = TermMapping(self.env, self._robot_name, self._user_target, self._report, xyzw=self._xyzw)
        for kind in KINDS:
            part = root.section(kind)
            part.drop([key for key in part.left if _OF_DATASET.match(key)], _RECORDED, NOT_NEEDED)
            self.env[kind] = self.env.get(kind, {}) | terms.section(kind, part)
        self.lost = terms.lost
        for reason, names in _ROOT_DROPPED.items():
            root.drop(names, reason, NOT_NEEDED)
        root.finish()
        absent = tuple(f"{row.key}." for row in self._report.rows if row.outcome in (CODE, DROPPED))
        for key, sources in self._foreign.items():
            if not f"{key}.".startswith(absent):
                text = ", ".join(f"{source} is treated as Isaac Lab's {last_name(source)}" for source in sources)
                self._report.replace(key, ASSUMED, text)
        self._names.require_used()

    def _prepared(self, value: object, key: str = "") -> object:
        """Return the config without markers; note the code outside Isaac Lab that has a name of Isaac Lab."""
        if isinstance(value, list):
            return [self._prepared(item, key) for item in value]
        if not isinstance(value, Mapping):
            return value
        source = str(value.get("class_type") or value.get("func") or value.get("function"))
        if last_name(source) in _BY_LAST_NAME and _OF_LAST_NAME.fullmatch(key) and not _ISAAC_LAB.match(source):
            self._foreign.setdefault(key, []).append(source)
        found: Tree = {}
        for name, item in value.items():
            place = f"{key}.{name}" if key else str(name)
            named, is_node = _MARKERS.fullmatch(str(name)), isinstance(item, Mapping)
            if is_node and (named or item.keys() >= {"prim_path", "markers"}):
                self._report.add(place, NOT_NEEDED, f"markers: {_DRAWN}")
            else:
                found[name] = self._prepared(item, place)
        return found

    def _newton(self, part: Section) -> None:
        """Take over the settings of MuJoCo's solver, with which Isaac Lab 3.0 can simulate, and report the others."""
        solver = part.section("solver_cfg")
        if solver.take("solver_type") == "mujoco_warp":
            self.env["sim"] |= solver.take_if_known(_SOLVER)
            self._report.add(solver.key, NAME, f"MuJoCo's solver: {', '.join(_SOLVER)}")
        steps = part.take("num_substeps", 1)
        if steps != 1:
            text = f"{steps}: divide sim.dt by {steps} and multiply decimation by {steps} for the same physics step"
            self._report.add(f"{part.key}.num_substeps", DROPPED, text)
        solver.finish(_ENGINE)
        part.finish(_ENGINE)

    def _scene(self, scene: Section, material: Section) -> None:
        self.env["num_envs"] = int(scene.take("num_envs", 4096))
        self.env["scene"] = {"env_spacing": scene.take("env_spacing", 2.5), "terrain": None, "sensors": {}}
        scene.drop(_SCENE_DROPPED, "each environment is a simulation of its own", NOT_NEEDED)
        modes: list[str] = []
        frictions = self._frictions(material, modes)
        sensors = {"ContactSensor": self._contact_sensor, "RayCaster": self._ray_caster, "Imu": self._imu}
        sensors["Pva"] = self._imu  # Isaac Lab 3.0's name of the Imu of 2.3.2
        nodes = dict(scene.items())
        mappings = [node for node in nodes.values() if isinstance(node, Mapping)]
        found = [node.get("prim_path") for node in mappings if last_name(node.get("class_type")) == "Articulation"]
        self._robot_path = found[0] if found else None
        robots = 0
        for name, node in nodes.items():
            kind = last_name(node.get("class_type")) if isinstance(node, Mapping) else ""
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
            elif kind in sensors and self._in_scene(part.left.get("prim_path")):
                self.env["scene"]["sensors"][name] = sensors[kind](part)
            elif "spawn_light" in str(node) or "Light" in str(node):
                self._report.add(key, NOT_NEEDED, f"a light: {_DRAWN}")
            elif "spawn_ground_plane" in str(node):
                material_there = Section(_spawn(node), f"{key}.spawn", self._report).section("physics_material")
                self.env["scene"]["terrain"] = _plane(*self._frictions(material_there, modes))
                self._report.add(key, RULE, "a plane")
            else:
                what = kind or last_name(_spawn(node).get("func")) or "object"
                self._report.add(key, DROPPED, f"a {what}: {_ONLY}")
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
        node: Tree = {"_target_": target, "mode": "startup"}
        node |= {"static_friction_range": [static, static], "dynamic_friction_range": [dynamic, dynamic]}
        node |= {"restitution_range": [0.0, 0.0], "num_buckets": 1, "asset_cfg": entity("robot", body_names=[".*"])}
        self.env["events"] = {"default_material": node}
        text = f"friction {static} (static) and {dynamic} (dynamic) of all bodies, as an event"
        self._report.add("sim.physics_material", RULE, text)

    def _robot(self, part: Section) -> None:
        spawn, init, actuators = part.section("spawn"), part.section("init_state"), part.section("actuators")
        articulation = spawn.joined("articulation_props")
        fixed = articulation.take("fix_root_link", spawn.take("fix_root_link", spawn.take("fix_base")))
        state = {
            "pos": init.take("pos", [0.0, 0.0, 0.0]),
            "rot": self._quaternion(init.take("rot"), "scene.robot.init_state.rot"),
            "joint_pos": _per_joint(init.take("joint_pos", {".*": 0.0}), f"{init.key}.joint_pos"),
            "joint_vel": _per_joint(init.take("joint_vel", {".*": 0.0}), f"{init.key}.joint_vel"),
        }
        collide = articulation.take("self_collision_enabled")
        self._require_joints({**state["joint_pos"], **state["joint_vel"]})
        self.robot |= {
            "base": "fixed" if fixed else "floating",
            "init_state": state,
            "joint_order": part.take("joint_order"),
            "soft_joint_pos_limit_factor": part.take("soft_joint_pos_limit_factor", 1.0),
            "friction_source": "static",
            "self_collisions": articulation.take("enabled_self_collisions", collide),
        }
        source = spawn.take("usd_path", spawn.take("asset_path"))
        if source:
            text = f"{shown(source)}: the given robot file is the same robot"
            self._report.add(f"{spawn.key}.usd_path", ASSUMED, text)
        drive = spawn.take("joint_drive")
        gains = drive.get("gains") if isinstance(drive, Mapping) else None
        at_rest = [name for name in ("lin_vel", "ang_vel") if not any(init.left.get(name) or [])]
        init.finish("resets set the velocity by events", skip=at_rest)
        articulation.finish(_ENGINE)
        spawn.finish("the robot file is not changed; PhysX's limits of bodies have no counterpart", skip=_SPAWN_DROPPED)
        self.robot["actuators"] = {name: self._actuator(node, gains or {}) for name, node in actuators.sections()}
        driven = [text for node in self.robot["actuators"].values() for text in _listed(node["joint_names_expr"])]
        free = [name for name in self._dofs if name not in _matching(driven, self._dofs)]
        if free:
            text = f"no actuator drives {', '.join(free)}: these joints of the robot file move freely"
            self._report.add("scene.robot.actuators", ASSUMED, text)
        part.finish(skip=_ROBOT_UNUSED)

    def _actuator(self, part: Section, gains: Tree) -> Tree:
        kind = self._actuator_kind(part)
        node: Tree = {"_target_": f"wheelleg_exp.sim.actuators.{kind}"}
        node["joint_names_expr"] = part.take("joint_names_expr", [".*"])
        accepted, expressions = parameters_of(node["_target_"], part.key), _listed(node["joint_names_expr"])
        self._require_joints(expressions)
        joints = _matching(expressions, self._dofs)
        # Isaac Lab 3.0 has ``actuator_effort_limit`` and ``joint_effort_limit`` instead of ``effort_limit(_sim)``.
        effort, velocity = part.take("effort_limit"), part.take("velocity_limit")
        engine_effort, engine_velocity = (
            part.take(f"joint_{name}", part.take(f"{name}_sim")) for name in ("effort_limit", "velocity_limit")
        )
        if kind == "ImplicitActuator":
            if engine_effort is None:
                engine_effort = part.take("actuator_effort_limit", effort)
            effort, engine_effort = engine_effort, None
            velocity = None  # Isaac Lab ignores the velocity limit of an implicit actuator.
            part.drop(["actuator_effort_limit", "actuator_velocity_limit"], "the solver has only the joint's limits")
        else:
            effort = part.take("actuator_effort_limit", effort)
            velocity = part.take("actuator_velocity_limit", velocity)
        values = {"effort_limit": effort, "velocity_limit": engine_velocity if velocity is None else velocity}
        values |= {name: part.take(name, gains.get(name)) for name in ("stiffness", "damping")}
        for name, value in values.items():
            if name in accepted:
                key = f"{part.key}.{name}"
                node[name] = self._from_file(part.key, name, joints) if value is None else _per_joint(value, key)
        if engine_effort is not None and "effort_limit" in node:
            engine_effort = _per_joint(engine_effort, f"{part.key}.joint_effort_limit")
            node["effort_limit"] = _smaller(part.key, node["effort_limit"], engine_effort, joints)
        network = part.take("network_file")
        if network is not None:
            name = re.split(r"[/\\]", str(network))[-1]
            self.networks.append(name)
            node["network_file"] = f"{self._directory}/{name}"
        part.drop(["dynamic_friction"], "MuJoCo has one friction per joint")
        for name, value in part.take_if_known(accepted).items():
            node[name] = _per_joint(value, f"{part.key}.{name}") if isinstance(value, Mapping) else value
        part.finish()
        return node

    def _actuator_kind(self, part: Section) -> str:
        """Return the class of an actuator. A class of the author is treated as the most similar stock class."""
        source = str(part.take("class_type", ""))
        kind = last_name(source)
        if kind in _ACTUATORS and source.startswith(("isaaclab.", "omni.isaac.lab.")):
            self._report.add(part.key, NAME, kind)
            return kind
        kind = "DelayedPDActuator" if part.left.get("max_delay") else "IdealPDActuator"
        if part.left.get("saturation_effort"):
            kind = "DCMotor"
        self._report.add(part.key, ASSUMED, f"{source or 'an actuator'} is taken as {kind}")
        return kind

    def _require_joints(self, expressions: Iterable[str]) -> None:
        unknown = [text for text in expressions if self._dofs and not _matching([text], self._dofs)]
        if unknown:
            message = f"the robot file has no joint {', '.join(unknown[:5])}"
            expected = f"the robot of the run, or --names FILE; the file has {', '.join(self._dofs)}"
            raise ConfigError(message, key="scene.robot", expected=expected)

    def _from_file(self, key: str, name: str, joints: list[str]) -> float | Tree:
        """Return a gain or limit from the robot's file, as Isaac Lab does for null."""
        found: dict[str, float] = {}
        for joint in joints:
            dof = self._dofs[joint]
            limits = {"velocity_limit": dof.max_velocity, "effort_limit": dof.effort}
            found[joint] = limits[name] or math.inf if name in limits else getattr(dof.drive, name, 0.0)
        value: float | Tree = {re.escape(joint): number for joint, number in found.items()}
        if len(set(found.values())) <= 1:
            value = next(iter(found.values()), 0.0)
        self._report.add(f"{key}.{name}", ASSUMED, f"{shown(value)}, from the robot's file")
        return value

    def _quaternion(self, value: Sequence[float] | None, key: str) -> list[float]:
        if value is None:
            return [1.0, 0.0, 0.0, 0.0]
        if self._xyzw:
            self._report.add(key, RULE, "(x, y, z, w) of Isaac Lab 3.0 became (w, x, y, z)")
            return [value[3], *value[:3]]
        return list(value)

    def _terrain(self, part: Section, modes: list[str]) -> Tree:
        kind = part.take("terrain_type", "plane")
        node = _plane(*self._frictions(part.section("physics_material"), modes))
        generator, level = part.section("terrain_generator"), part.take("max_init_terrain_level")
        if kind == "generator":
            node |= convert_generator(generator, self._report)
            node |= {"max_init_terrain_level": level} if level is not None else {}
            self._report.add(part.key, NAME, "TerrainGenerator")
        elif kind == "plane":
            self._report.add(part.key, NAME, "Plane")
        else:
            self._report.add(part.key, DROPPED, f"terrain of type {kind}: a plane replaces it")
        part.finish(skip=_TERRAIN_UNUSED)
        return node

    def _contact_sensor(self, part: Section) -> Tree:
        node = {
            "_target_": "wheelleg_exp.sim.sensors.ContactSensor",
            "body_names": self._bodies(part.take("prim_path")),
            "history_length": part.take("history_length", 0),
            "track_air_time": part.take("track_air_time", False),
            "max_contacts": _CONTACTS,
            "force_threshold": part.take("force_threshold", 1.0),
        }
        paths = part.take("filter_prim_paths_expr", [])
        if unknown := [path for path in paths if not self._in_scene(path)]:
            self._report.add(f"{part.key}.filter_prim_paths_expr", DROPPED, f"{', '.join(map(str, unknown))}: {_ONLY}")
        if names := [name for path in paths if path not in unknown for name in self._bodies(path)]:
            node["filter_body_names"] = names
        period = part.take("update_period", 0.0)
        if period and period > self.env["sim"]["dt"]:
            node["update_period"] = period
        node |= part.take_if_known(("track_pose", "track_contact_points", "track_friction_forces"))
        self._report.add(part.key, NAME, "ContactSensor")
        part.finish(skip=_SENSOR_UNUSED)
        return node

    def _ray_caster(self, part: Section) -> Tree:
        node = self._mounted(part, "RayCaster")
        yaw = part.take("attach_yaw_only")
        node["ray_alignment"] = part.take("ray_alignment", "yaw" if yaw else "base")
        pattern = part.section("pattern_cfg")
        kind = PATTERNS.get(last_name(pattern.take("func")))
        if kind is None:
            message = "this pattern of rays does not exist here"
            raise ConfigError(message, key=pattern.key, expected=", ".join(PATTERNS))
        target = f"wheelleg_exp.sim.sensors.{kind}"
        node["pattern"] = {"_target_": target, **pattern.take_if_known(parameters_of(target, part.key))}
        pattern.finish()
        node |= part.take_if_known(("max_distance", "drift_range", "ray_cast_drift_range", "update_period"))
        part.finish(skip=("history_length", *_SENSOR_UNUSED))
        return node

    def _imu(self, part: Section) -> Tree:
        node = self._mounted(part, "Imu") | part.take_if_known(("gravity_bias", "update_period"))
        if self._xyzw and "gravity_bias" not in node:  # In Isaac Lab 3.0, only an Imu measures gravity.
            is_imu = last_name(part.left.get("class_type")) == "Imu"
            node["gravity_bias"] = [0.0 - is_imu * axis for axis in self.env["sim"]["gravity"]]
        part.finish(skip=("history_length", *_SENSOR_UNUSED))
        return node

    def _mounted(self, part: Section, kind: str) -> Tree:
        """Return the node of a sensor on a body, with the sensor's pose in the frame of the body."""
        self._report.add(part.key, NAME, kind)
        offset, body = part.section("offset"), self._bodies(part.take("prim_path"))[0]
        pose = {"pos": offset.take("pos", [0.0, 0.0, 0.0]), "rot": self._quaternion(offset.take("rot"), offset.key)}
        return {"_target_": f"wheelleg_exp.sim.sensors.{kind}", "body_name": body, "offset": pose}

    def _in_scene(self, prim_path: object) -> bool:
        """Return whether a prim path, of which each part is an expression, belongs to the robot or to the ground."""
        paths = (str(path or "").replace("{ENV_REGEX_NS}", _ENVS) for path in (prim_path, self._robot_path))
        place, robot = map(_PARTS.split, paths)
        pairs = zip(place, robot, strict=False)
        is_robot = all(a == b or _matching([a], [b]) or _matching([b], [a]) for a, b in pairs)
        is_ground = str(prim_path).startswith("/World/ground")
        return not prim_path or is_ground or (is_robot and len(place) >= len(robot))

    def _bodies(self, prim_path: object) -> list[str]:
        """Return expressions of bodies: the last part of a prim path such as ``/World/envs/env_.*/Robot/.*_foot``."""
        if str(prim_path).startswith("/World/ground"):
            return ["ground"]
        return self._names.of(_PARTS.split(str(prim_path or ".*"))[-1], "link")


def is_version_3(tree: Tree) -> bool:
    """Return whether Isaac Lab 3.0 has written a config: it has ``sim.physics`` instead of ``sim.physx``."""
    return "physx" not in (tree.get("sim") or {"physx": None})


def _spawn(node: object) -> Mapping[str, object]:
    return node.get("spawn") or {} if isinstance(node, Mapping) else {}


class _Names:
    """The run's names of joints and links whose names in the robot file differ.

    With ``{q1: l01}``, ``[q.*]`` becomes ``[l01, q.*]`` if other joints match ``q.*``, and otherwise ``[l01]``.
    """

    def __init__(self, table: Mapping[str, str], joints: Iterable[str], links: Iterable[str]) -> None:
        self._known = {"joint": list(joints), "link": list(links)}
        existing = [*self._known["joint"], *self._known["link"]]
        unknown = [new for new in table.values() if new not in existing]
        if unknown:
            message = f"the robot file has no joint or link '{unknown[0]}'"
            raise ConfigError(message, key="--names", expected=", ".join(existing))
        self._table = table
        self._used: set[str] = set()
        self._expressions: dict[str, None] = {}

    def require_used(self) -> None:
        """Raise ConfigError for a name in the table that no expression of the run matches."""
        for old in self._table:
            if old not in self._used:
                message, known = f"the run names no joint or link '{old}'", list(self._expressions)
                expected = "a name that matches one of " + ", ".join(known)
                raise ConfigError(message, key="--names", expected=expected, nearest=nearest_name(old, known))

    def applied(self, value: object, kind: str = "") -> object:
        """Return ``value`` with new names; ``kind`` is ``joint`` or ``link`` if the value contains such names."""
        if not self._table:
            return value
        if isinstance(value, Mapping):
            found: Tree = {}
            for key, item in value.items():
                joints = "joint" in str(key) or key in _BY_JOINT
                inside = "link" if "bod" in str(key) else "joint" if joints else kind
                found |= dict.fromkeys(self.of(str(key), kind), self.applied(item, inside))
            return found
        if isinstance(value, list):
            new: list[Any] = []
            for item in value:
                new += self.of(item, kind) if isinstance(item, str) else [self.applied(item, kind)]
            return new
        if isinstance(value, str):
            names = self.of(value, kind)
            return names[0] if len(names) == 1 else names
        return value

    def of(self, expression: str, kind: str) -> list[str]:
        """Return the expressions that replace an expression of joints or links."""
        known = self._known.get(kind, [])
        table = {old: new for old, new in self._table.items() if new in known}
        try:
            found = [] if expression == ".*" else [table[old] for old in _matching([expression], table)]
            matches = bool(_matching([expression], known))
            self._expressions |= {expression: None} if kind else {}
            self._used |= set() if expression == ".*" else {*_matching([expression], table)}
        except ConfigError:
            return [expression]
        return [*found, expression] if matches or not found else found


def _smaller(key: str, limit: float | Tree, of_engine: float | Tree, joints: list[str]) -> dict[str, float]:
    """Return the smaller of an explicit actuator's own limit and the engine's, which clips its torques."""
    found = {}
    own = values_by_name(limit, joints, None, key=f"{key}.effort_limit", what="joint")
    engine = values_by_name(of_engine, joints, None, key=f"{key}.joint_effort_limit", what="joint")
    for name, *both in zip(joints, own, engine, strict=True):
        given = [value for value in both if value is not None]
        if given:
            found[re.escape(name)] = min(given)
    return found


def _per_joint(value: object, key: str) -> float | Tree:
    """Return numbers by joint expression as floats, or one number unchanged."""
    if isinstance(value, (int, float)):
        return value
    if not isinstance(value, Mapping) or not all(isinstance(number, (int, float)) for number in value.values()):
        raise ConfigError(f"{shown(value)} is not a number", key=key, expected="a number, or one by joint expression")
    return {str(name): float(number) for name, number in value.items()}


def _matching(expressions: Iterable[str], names: Collection[str]) -> list[str]:
    known = [compiled(expression, names) for expression in expressions]
    return [name for name in names if any(pattern.fullmatch(name) for pattern in known)]


def _listed(expressions: str | Iterable[str]) -> list[str]:
    return [expressions] if isinstance(expressions, str) else list(expressions)


def _plane(static: float, dynamic: float) -> Tree:
    frictions = {"static_friction": static, "dynamic_friction": dynamic, "restitution": 0.0}
    return {"_target_": "wheelleg_exp.sim.terrain.Plane", **frictions}
