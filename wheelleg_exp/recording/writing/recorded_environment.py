"""One recorded environment: its facts, its shapes, its frames, and the size that frames take in the file."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import mujoco
import numpy as np
import rerun as rr
import torch

from wheelleg_exp import __version__
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.recording.blueprint import EnvLayout
from wheelleg_exp.recording.layout import FORMAT_VERSION, GROUND, EnvPaths
from wheelleg_exp.recording.recording_options import Sample
from wheelleg_exp.recording.writing import rerun_shapes
from wheelleg_exp.recording.writing.recorded_frames import (
    Episodes,
    Frames,
    Stamp,
    has_forces,
    learning_channels,
    robot_channels,
    velocity_command,
)
from wheelleg_exp.recording.writing.rerun_shapes import Columns, Contacts, Ground, VelocityArrows, geom_name, shape
from wheelleg_exp.rendering.render_scene import Array
from wheelleg_exp.rendering.scene_models import Kinematics, body_geoms, is_plane
from wheelleg_exp.state.tensor_trees import host_copy

StaticEntities = Iterator[tuple[str, list[Any]]]
ROBOT = "robot"


def own_facts(env: ManagerBasedRLEnv, env_ids: list[int], purpose: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the property ``wheelleg``: the origin of the recording, and its steps and times.

    Args:
        env: the environment.
        env_ids: the recorded environments.
        purpose: training, play or evaluation.
        given: more values (run id, task, checkpoint), which replace values of the same name.
    """
    found: dict[str, Any] = {
        "format_version": FORMAT_VERSION,
        "purpose": purpose,
        "seed": env.seed,
        "step_dt": env.step_dt,
        "physics_dt": env.physics_dt,
        "decimation": env.decimation,
        "episode_length_s": env.max_episode_length_s,
        "max_episode_length": env.max_episode_length,
        "num_envs": env.num_envs,
        "env_ids": env_ids,
        "version": __version__,
        "rerun_version": rr.__version__,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    return {**found, **{key: value for key, value in given.items() if value is not None}}


def robot_facts(env: ManagerBasedRLEnv, layout: EnvLayout) -> dict[str, Any]:
    """Return the property ``robot``: its bodies and joints, its weight (N) and its height (m)."""
    robot, model = env.scene.robot, env.scene.model
    root = int(model.body(robot.body_names[0]).id)
    facts: dict[str, Any] = {
        "root": robot.body_names[0],
        "bodies": list(robot.body_names),
        "joints": list(robot.joint_names),
        "weight": rerun_shapes.weight(model, root),
        "height": layout.size,
        "contact_sensors": list(layout.sensors),
    }
    return facts if layout.command is None else {**facts, "velocity_command": layout.command}


def term_statics(env: ManagerBasedRLEnv, paths: EnvPaths) -> StaticEntities:
    """Yield the terms of each manager in their order, with weights and widths."""
    observations, actions = env.observation_manager, env.action_manager
    for group, terms in observations.active_terms.items():
        widths = [math.prod(shape) for shape in observations.group_obs_term_dim[group]]
        yield paths.data("observations", group), [rr.AnyValues(terms=terms, widths=widths)]
    rewards = env.reward_manager.active_terms
    # The configured weights, because curricula change the present ones.
    weights = [float(env.cfg["rewards"][name]["weight"]) for name in rewards]
    yield from _listed(paths.data("rewards"), rewards, weights=weights)
    ends = env.termination_manager.active_terms
    over = [int(bool(env.termination_manager.get_term_cfg(name).fields.get("time_out", False))) for name in ends]
    yield from _listed(paths.data("terminations"), ends, time_out=over)
    yield from _listed(paths.data("actions"), actions.active_terms, widths=actions.action_term_dim)
    yield from _listed(paths.data("events"), list(interval_terms(env)))


def interval_terms(env: ManagerBasedRLEnv) -> list[str]:
    """Return the names of the interval events."""
    manager = env.event_manager
    return manager.active_terms.get("interval", [])


def _listed(entity: str, terms: list[str], **values: Any) -> StaticEntities:
    if terms:
        yield entity, [rr.AnyValues(terms=list(terms), **values)]


def joint_statics(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> StaticEntities:
    """Yield each joint's limits and drive, and the environment's origin."""
    robot, data = env.scene.robot, env.scene.robot.data
    yield paths.data("joints"), [rr.AnyValues(names=list(robot.joint_names))]
    drives = _drives(env, env_id)
    for i, joint in enumerate(robot.joint_names):
        low, high = data.joint_pos_limits[env_id, i].tolist()
        stiffness, damping = drives.get(joint, (math.nan, math.nan))
        limits = rr.AnyValues(
            effort_limit=float(data.joint_effort_limits[env_id, i]),
            velocity_limit=float(data.soft_joint_vel_limits[env_id, i]),
            position_low=low,
            position_high=high,
            default_position=float(data.default_joint_pos[env_id, i]),
            stiffness=stiffness,
            damping=damping,
        )
        yield paths.data("joints", joint), [limits]
    yield paths.data("state"), [rr.AnyValues(origin=env.scene.env_origins[env_id].tolist())]


def _drives(env: ManagerBasedRLEnv, env_id: int) -> dict[str, tuple[float, float]]:
    """Return stiffness and damping of every driven joint of an environment."""
    found: dict[str, tuple[float, float]] = {}
    for actuator in env.scene.robot.actuators.values():
        rows = torch.stack((actuator.stiffness[env_id], actuator.damping[env_id]), dim=1).tolist()
        found.update(zip(actuator.joint_names, ((k, d) for k, d in rows), strict=True))
    return found


MEGABYTE = 1_000_000
# Measured bytes: metadata of a chunk plus its index entry; the three times of a row; a transform; a number.
_CHUNK, _TIMES, _TRANSFORM, _NUMBER = 1600 + 500, 24, 28, 8
_FACE, _CELL, _TEXTS = 150, 40, 2 * MEGABYTE


@dataclass(frozen=True)
class Cost:
    """An upper estimate of the size of frames, without compression.

    Attributes:
        entities: number of entities with one row in each frame.
        numbers: number of numbers in a frame.
        bodies: number of bodies whose pose is in a frame.
    """

    entities: int
    numbers: int
    bodies: int

    def frame(self, rows_together: int) -> float:
        """Return the bytes of a frame, given the number of rows that are written at a time."""
        entities = self.entities + self.bodies
        content = _NUMBER * self.numbers + _TRANSFORM * self.bodies + _TIMES * entities
        return content + _CHUNK * entities / rows_together


def total_cost(costs: Iterable[Cost]) -> Cost:
    """Return the cost of several environments together."""
    found = list(costs)
    return Cost(sum(c.entities for c in found), sum(c.numbers for c in found), sum(c.bodies for c in found))


def static_bytes(model: mujoco.MjModel, envs: int) -> float:
    """Return the bytes that are written once: shapes, and an allowance for texts and names."""
    return envs * (_FACE * model.nmeshface + _CELL * model.nhfielddata) + _TEXTS


# Lengths of arrows in robot heights, so that they fit a robot of any size.
_HEIGHTS_PER_WEIGHT = 0.6
_HEIGHTS_PER_SPEED = 2.0
_LIFT = 0.45

_LIGHT, _DARK = (92, 98, 108, 255), (74, 79, 88, 255)
_TILES = 40
_EVENT = (235, 235, 235)
_PALETTE = (
    (86, 156, 255),
    (255, 159, 64),
    (92, 205, 120),
    (240, 98, 98),
    (178, 132, 255),
    (214, 178, 94),
    (255, 136, 200),
    (96, 210, 214),
    (170, 176, 186),
    (190, 214, 72),
    (150, 110, 90),
    (120, 140, 255),
)


class RecordedEnvironment:
    """One recorded environment.

    Poses are relative to the environment's origin at construction, so that the robot starts at the centre.

    Args:
        env: the environment.
        env_id: index of the environment.
        paths: the entity paths of the environment.
        place: number of recorded environments before this one, which decides how far to the side it is drawn.

    Attributes:
        stamps: the times of the buffered frames.
        sample: selects the recorded steps of a training.
        episodes: counts the recorded episodes.
    """

    def __init__(self, env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths, place: int) -> None:
        self.env_id, self.paths = env_id, paths
        self._model = env.scene.model
        self._robot = env.scene.robot
        self._root = int(self._model.body(self._robot.body_names[0]).id)
        self._bodies = {b: paths.body(self._model.body(b).name or f"body_{b}") for b in range(1, self._model.nbody)}
        self._origin: Array = host_copy(env.scene.env_origins[env_id].double())
        self._solver = Kinematics(self._model)
        self._size = self._solver.height(self._root, rerun_shapes.default_pose(self._robot, self._model))
        self._offset = np.array([0.0, 3.0 * self._size * place, 0.0])
        self.stamps: list[Stamp] = []
        self.sample = Sample()
        self.episodes = Episodes()
        learning = learning_channels(env, env_id, paths, self.episodes)
        self.frames = Frames([*robot_channels(env, env_id, paths), *learning])
        self._events = interval_terms(env)
        self._reading = [*term_statics(env, paths), *joint_statics(env, env_id, paths)]
        self._dry_run()
        self._draw(env)
        self._place = place
        self.layout = EnvLayout(
            label=f"env {env_id}",
            paths=paths,
            root=self._bodies[self._root],
            size=self._size,
            command=velocity_command(env),
            sensors=tuple(contact.sensor for contact in self._contacts),
            joints=_position_controlled(env),
            rewards=tuple(env.reward_manager.active_terms),
            observations={group: tuple(terms) for group, terms in env.observation_manager.active_terms.items()},
        )

    @property
    def cost(self) -> Cost:
        """The size of a frame in the file."""
        entities = {entity for channel in self.frames.channels for entity in channel.entities}
        numbers = sum(len(channel.names) for channel in self.frames.channels)
        sensed = sum(len(contact.bodies) for contact in self._contacts)
        drawn = 3 + 2 * len(self._contacts) + 2  # angles, norms and arrows, velocities
        return Cost(len(entities) + drawn, numbers + 4 * sensed + 6, len(self._bodies))

    def capture(self, stamp: Stamp, episode_step: int, *, ends: bool) -> None:
        """Record the state after a control step; ``ends`` says whether the episode ended with the step."""
        self.episodes.advance(stamp.step, episode_step)
        self.sample.steps.append(stamp.step)
        self.sample.took(ends=ends)
        self.frames.append()
        self.stamps.append(stamp)

    def clear(self) -> None:
        """Remove the buffered frames."""
        self.frames.clear()
        self.stamps.clear()

    def statics(self) -> Iterator[tuple[str, list[Any]]]:
        """Yield what is static: places, shapes, names of numbers, colours of arrows."""
        if self._place:
            for path in (self.paths.body(""), self.paths.overlay()):
                yield path, [rr.Transform3D(translation=self._offset)]
        for body, entity in self._bodies.items():
            yield from self._shapes(body, entity)
        yield from self._reading
        yield from self._series()
        yield from self._arrow_styles()

    def surroundings(self) -> Iterator[tuple[str, list[Any]]]:
        """Yield the ground and the other geoms of the world, relative to this environment's origin."""
        if self._ground is not None:
            yield GROUND, [self._ground.mesh(_LIGHT, _DARK)]
        drawn, _ = body_geoms(self._model, 0)
        if drawn:
            yield f"{GROUND}/terrain", [rr.Transform3D(translation=-self._origin)]
        for geom in drawn:
            yield f"{GROUND}/terrain/{geom_name(self._model, geom)}", shape(self._model, geom)

    def columns(self) -> Iterator[Columns]:
        """Yield the buffered frames as columns of entities."""
        blocks = self._with_poses(self.frames.blocks())
        yield from rerun_shapes.scalars([c for c in self.frames.channels if c.entities], blocks)
        yield from rerun_shapes.orientation(self.paths, blocks)
        yield from rerun_shapes.transforms(self._bodies, blocks)
        for contact in self._contacts:
            yield from contact.columns(self.paths, blocks)
        if self._velocity is not None:
            yield from self._velocity.columns(self.paths, blocks)
        if self._ground is not None and self._place == 0:
            yield from self._ground.columns(self.paths, blocks)

    def _with_poses(self, blocks: dict[str, Array]) -> dict[str, Array]:
        """Add the poses of all bodies (n, B, 3), (n, B, 4), and the base's angles (n, 3)."""
        position, quaternion = self._solver.poses(blocks["qpos"])
        angles = rerun_shapes.roll_pitch_yaw(quaternion[:, self._root])
        return {**blocks, "xpos": position - self._origin, "xquat": quaternion, "orientation": angles}

    def _dry_run(self) -> None:
        """Read every channel once, so that a wrong width raises now and not during a step."""
        self.frames.append()
        self.frames.clear()

    def _draw(self, env: ManagerBasedRLEnv) -> None:
        weight = rerun_shapes.weight(self._model, self._root)
        ids = {name: int(self._model.body(name).id) for name in self._robot.body_names}
        self._contacts = [
            Contacts(name, tuple(ids[b] for b in sensor.body_names), _HEIGHTS_PER_WEIGHT * self._size / weight)
            for name, sensor in env.scene.sensors.items()
            if has_forces(sensor)
        ]
        command = velocity_command(env)
        self._velocity = None
        if command is not None:
            lift, scale = _LIFT * self._size, _HEIGHTS_PER_SPEED * self._size
            self._velocity = VelocityArrows(f"commands/{command}", self._root, lift, scale)
        planes = [g for g in range(self._model.ngeom) if is_plane(self._model, g)]
        point = self._model.geom_pos[planes[0]] - self._origin if planes else np.zeros(3)
        self._ground = Ground(self._root, _tile(self._size), _TILES, point) if planes else None

    def _shapes(self, body: int, entity: str) -> Iterator[tuple[str, list[Any]]]:
        drawn, colliders = body_geoms(self._model, body)
        for geom in drawn:
            if archetypes := shape(self._model, geom):
                yield f"{entity}/{_part(self._model, geom)}", archetypes
        place = self.paths.overlay("colliders", self._model.body(body).name or f"body_{body}")
        for geom in colliders:
            if archetypes := shape(self._model, geom):
                # The collider moves with the body, but has a path of its own, so that one click hides all colliders.
                yield f"{place}/{_part(self._model, geom)}", [*archetypes, rr.CoordinateFrame(f"tf#/{entity}")]

    def _series(self) -> Iterator[tuple[str, list[Any]]]:
        for channel in self.frames.channels:
            if len(channel.entities) == 1:
                yield channel.entities[0], [series(channel.names)]
            else:
                for i, (entity, name) in enumerate(zip(channel.entities, channel.names, strict=False)):
                    yield entity, [series([name], first=i)]
        for i, name in enumerate(rerun_shapes.ANGLES):
            yield self.paths.data("base", name), [series([name], first=i)]
        for name in self._events:
            yield self.paths.data("events", name), [rr.SeriesPoints(names=[name], colors=[_EVENT], marker_sizes=[4.0])]
        for contact in self._contacts:
            names = [self._model.body(b).name for b in contact.bodies]
            yield self.paths.data("contacts", contact.sensor), [series(names)]

    def _arrow_styles(self) -> Iterator[tuple[str, list[Any]]]:
        radius = 0.02 * self._size
        for contact in self._contacts:
            path = self.paths.overlay("contacts", contact.sensor)
            yield path, [rr.Arrows3D.from_fields(colors=[rerun_shapes.FORCE], radii=[radius])]
        if self._velocity is not None:
            for name, shade in (("command", rerun_shapes.COMMANDED), ("actual", rerun_shapes.ACTUAL)):
                path = self.paths.overlay("velocity", name)
                yield path, [rr.Arrows3D.from_fields(colors=[shade], radii=[radius])]


def series(names: Any, first: int = 0) -> Any:
    """Return names and colours of the lines of a plot; commands and targets have paler colours."""
    shades = []
    for i, name in enumerate(names):
        shade = np.array(_PALETTE[(first + i) % len(_PALETTE)])
        pale = name.endswith(("target", "command"))
        shades.append((0.45 * shade + 0.55 * 255).astype(np.uint8) if pale else shade)
    return rr.SeriesLines(names=list(names), colors=shades)


def _position_controlled(env: ManagerBasedRLEnv) -> dict[str, bool]:
    """Return for each joint whether an actuator controls its position; an undriven joint counts as controlled."""
    robot = env.scene.robot
    free = {
        joint
        for actuator in robot.actuators.values()
        for joint, stiffness in zip(actuator.joint_names, actuator.stiffness[0].tolist(), strict=True)
        if stiffness == 0.0
    }
    return {joint: joint not in free for joint in robot.joint_names}


def _part(model: Any, geom: int) -> str:
    return rr.escape_entity_path_part(geom_name(model, geom))


def _tile(size: float) -> float:
    """Return an edge of 1, 2 or 5 times a power of ten that is near two thirds of the robot's height, m."""
    wanted = size / 1.5
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(k for k in (1, 2, 5) if k * power <= wanted * 1.001))
