"""One recorded environment: its properties, its shapes, its frames, and the size of its frames in the file."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime

import numpy as np
import rerun as rr
import torch

from wheelleg_exp import __version__
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.recording.blueprint import EnvLayout
from wheelleg_exp.recording.layout import FORMAT_VERSION, GROUND, EnvPaths, join
from wheelleg_exp.recording.writing import recorded_frames, rerun_shapes
from wheelleg_exp.recording.writing.recorded_frames import Episodes, Frames, Sample, Stamp, velocity_command
from wheelleg_exp.recording.writing.rerun_shapes import (
    ANGLES,
    Columns,
    Contacts,
    Ground,
    VelocityArrows,
    geom_name,
    shape,
    xyzw,
)
from wheelleg_exp.rendering.render_scene import Array
from wheelleg_exp.rendering.scene_models import Kinematics, body_geoms, is_plane
from wheelleg_exp.sim.sensors import ContactSensor
from wheelleg_exp.state import host_copy

StaticEntities = Iterator[tuple[str, list[rr.AsComponents]]]
ROBOT = "robot"


def own_facts(
    env: ManagerBasedRLEnv, env_ids: list[int], purpose: str, given: Mapping[str, object]
) -> dict[str, object]:
    """Return the property ``wheelleg``: facts such as the seed; entries of ``given`` replace entries of equal name."""
    found = {
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


def robot_facts(env: ManagerBasedRLEnv, layout: EnvLayout) -> dict[str, object]:
    """Return the property ``robot``: the robot's bodies and joints, its weight (N) and its height (m)."""
    robot, model = env.scene.robot, env.scene.model
    root = int(model.body(robot.body_names[0]).id)
    facts = {
        "root": robot.body_names[0],
        "bodies": list(robot.body_names),
        "joints": list(robot.joint_names),
        "weight": rerun_shapes.weight(model, root),
        "height": layout.size,
        "contact_sensors": list(layout.sensors),
    }
    return facts if layout.command is None else {**facts, "velocity_command": layout.command}


def term_statics(env: ManagerBasedRLEnv, paths: EnvPaths) -> StaticEntities:
    """Yield the names of all managers' terms, the reward weights, and the widths of observation and action terms."""
    observations, actions = env.observation_manager, env.action_manager
    for group, terms in observations.active_terms.items():
        widths = [math.prod(shape) for shape in observations.group_obs_term_dim[group]]
        yield paths.data("observations", group), [rr.AnyValues(terms=terms, widths=widths)]
    rewards = env.reward_manager.active_terms
    # Record the reward weights of the config, because curricula change the weights during a training.
    weights = [float(env.cfg["rewards"][name]["weight"]) for name in rewards]
    ends = env.termination_manager.active_terms
    over = [int(bool(env.termination_manager.get_term_cfg(name).fields.get("time_out", False))) for name in ends]
    listed: dict[str, tuple[list[str], Mapping[str, object]]] = {
        "rewards": (rewards, {"weights": weights}),
        "terminations": (ends, {"time_out": over}),
        "actions": (actions.active_terms, {"widths": actions.action_term_dim}),
        "events": (env.event_manager.active_terms.get("interval", []), {}),
    }
    for name, (terms, values) in listed.items():
        if terms:
            yield paths.data(name), [rr.AnyValues(True, terms=list(terms), **values)]


def joint_statics(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> StaticEntities:
    """Yield the limits and the actuator parameters of each joint, and the origin of the environment."""
    robot, data = env.scene.robot, env.scene.robot.data
    yield paths.data("joints"), [rr.AnyValues(names=list(robot.joint_names))]
    drives: dict[str, tuple[float, float]] = {}
    for actuator in robot.actuators.values():
        gains = torch.stack((actuator.stiffness[env_id], actuator.damping[env_id]), dim=1).tolist()
        drives.update(zip(actuator.joint_names, map(tuple, gains), strict=True))
    for i, joint in enumerate(robot.joint_names):
        values = {"effort_limit": float(data.joint_effort_limits[env_id, i])}
        values["velocity_limit"] = float(data.soft_joint_vel_limits[env_id, i])
        values["position_low"], values["position_high"] = data.joint_pos_limits[env_id, i].tolist()
        values["default_position"] = float(data.default_joint_pos[env_id, i])
        values["stiffness"], values["damping"] = drives.get(joint, (math.nan, math.nan))
        yield paths.data("joints", joint), [rr.AnyValues(True, **values)]
    yield paths.data("state"), [rr.AnyValues(origin=env.scene.env_origins[env_id].tolist())]


MEGABYTE = 1_000_000
# By measurement, an rrd file needs 2100 bytes per data chunk, 24 per row for its times, 28 per pose, and 8 per number.
_CHUNK, _TIMES, _TRANSFORM, _NUMBER = 1600 + 500, 24, 28, 8

# Arrow lengths are proportional to the robot's height, so that arrows are visible for robots of any size.
_HEIGHTS_PER_WEIGHT = 0.6
_HEIGHTS_PER_SPEED = 2.0
_LIFT = 0.45

_LIGHT, _DARK = (92, 98, 108, 255), (74, 79, 88, 255)
_TILES = 40
_EVENT = (235, 235, 235)
_HEX_COLOURS = "569CFF FF9F40 5CCD78 F06262 B284FF D6B25E FF88C8 60D2D6 AAB0BA BED648 966E5A 788CFF"
_PALETTE = [tuple(bytes.fromhex(colour)) for colour in _HEX_COLOURS.split()]


class RecordedEnvironment:
    """One recorded environment. ``place`` (0, 1, …) is the robot's place in the row of robots in the 3D view.

    Poses are relative to the environment's initial origin. ``stamps`` has the control step and time of buffered frames.
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
        self.frames = Frames(recorded_frames.environment_channels(env, env_id, paths, self.episodes))
        self._events = env.event_manager.active_terms.get("interval", [])
        self._reading = [*term_statics(env, paths), *joint_statics(env, env_id, paths)]
        # Read all recorded quantities once, so that a wrong number of values raises an error before the rollout.
        self.frames.append()
        self.frames.clear()
        self._draw(env)
        self._place = place
        robot, stiffness = env.scene.robot, dict[str, float]()
        for actuator in robot.actuators.values():
            stiffness.update(zip(actuator.joint_names, actuator.stiffness[0].tolist(), strict=True))
        self.layout = EnvLayout(
            label=f"env {env_id}",
            paths=paths,
            root=self._bodies[self._root],
            size=self._size,
            command=velocity_command(env),
            sensors=tuple(contact.sensor for contact in self._contacts),
            joints={joint: stiffness.get(joint) != 0.0 for joint in robot.joint_names},
            rewards=tuple(env.reward_manager.active_terms),
            observations={group: tuple(terms) for group, terms in env.observation_manager.active_terms.items()},
        )

    def frame_bytes(self, rows_together: int) -> float:
        """Return the maximum size, bytes, of a recorded frame in a file with ``rows_together`` frames per chunk."""
        recorded = {entity for channel in self.frames.channels for entity in channel.entities}
        # A frame also has entities outside ``channels``: 3 angles, contacts, 2 velocity arrows, and body poses.
        entities = len(recorded) + 3 + 2 * len(self._contacts) + 2 + len(self._bodies)
        sensed = sum(len(contact.bodies) for contact in self._contacts)
        numbers = sum(len(channel.names) for channel in self.frames.channels) + 4 * sensed + 6
        content = _NUMBER * numbers + _TRANSFORM * len(self._bodies) + _TIMES * entities
        return content + _CHUNK * entities / rows_together

    def capture(self, stamp: Stamp, episode_step: int, *, ends: bool) -> None:
        """Buffer the environment's state after a control step. ``ends`` is true for an episode's last step."""
        self.episodes.advance(stamp.step, episode_step)
        self.sample.steps.append(stamp.step)
        self.sample.took(ends=ends)
        self.frames.append()
        self.stamps.append(stamp)

    def clear(self) -> None:
        self.frames.clear()
        self.stamps.clear()

    def statics(self) -> StaticEntities:
        """Yield the static data: positions, shapes, names of numbers, and colours of arrows."""
        if self._place:
            for path in (self.paths.body(""), self.paths.overlay()):
                yield path, [rr.Transform3D(translation=self._offset)]
        for body, entity in self._bodies.items():
            yield from self._shapes(body, entity)
        yield from self._reading
        yield from self._series()
        radius = 0.02 * self._size
        styles = {("contacts", contact.sensor): rerun_shapes.FORCE for contact in self._contacts}
        if self._velocity is not None:
            styles |= {("velocity", "command"): rerun_shapes.COMMANDED, ("velocity", "actual"): rerun_shapes.ACTUAL}
        for parts, shade in styles.items():
            yield self.paths.overlay(*parts), [rr.Arrows3D.from_fields(colors=[shade], radii=[radius])]

    def surroundings(self) -> StaticEntities:
        """Yield the shapes of the ground and of MuJoCo's world body, relative to the environment's origin."""
        if self._ground is not None:
            yield GROUND, [self._ground.mesh(_LIGHT, _DARK)]
        drawn, _ = body_geoms(self._model, 0)
        if drawn:
            yield f"{GROUND}/terrain", [rr.Transform3D(translation=-self._origin)]
        for geom in drawn:
            yield f"{GROUND}/terrain/{geom_name(self._model, geom)}", shape(self._model, geom)

    def columns(self) -> Iterator[Columns]:
        """Yield the buffered frames as columns of Rerun entities."""
        blocks = self.frames.blocks()
        position, quaternion = self._solver.poses(blocks["qpos"])
        position, angles = position - self._origin, rerun_shapes.roll_pitch_yaw(quaternion[:, self._root])
        blocks = {**blocks, "xpos": position, "orientation": angles}
        for channel in self.frames.channels:
            rows = blocks[channel.key]
            if len(channel.entities) == 1:
                yield channel.entities[0], rerun_shapes.vector_columns(rows)
            else:
                for entity, column in zip(channel.entities, rows.T, strict=False):
                    yield entity, rr.Scalars.columns(scalars=np.ascontiguousarray(column))
        for name, column in zip(ANGLES, angles.T, strict=True):
            yield self.paths.data("base", name), rr.Scalars.columns(scalars=np.ascontiguousarray(column))
        for body, entity in self._bodies.items():
            turn = xyzw(quaternion[:, body])
            yield entity, rr.Transform3D.columns(translation=position[:, body], quaternion=turn)
        for contact in self._contacts:
            yield from contact.columns(self.paths, blocks)
        if self._velocity is not None:
            yield from self._velocity.columns(self.paths, blocks)
        if self._ground is not None and self._place == 0:
            yield from self._ground.columns(blocks)

    def _draw(self, env: ManagerBasedRLEnv) -> None:
        weight = rerun_shapes.weight(self._model, self._root)
        ids = {name: int(self._model.body(name).id) for name in self._robot.body_names}
        self._contacts = [
            Contacts(name, tuple(ids[b] for b in sensor.body_names), _HEIGHTS_PER_WEIGHT * self._size / weight)
            for name, sensor in env.scene.sensors.items()
            if isinstance(sensor, ContactSensor)
        ]
        command = velocity_command(env)
        self._velocity = None
        if command is not None:
            lift, scale = _LIFT * self._size, _HEIGHTS_PER_SPEED * self._size
            self._velocity = VelocityArrows(f"commands/{command}", self._root, lift, scale)
        planes = [g for g in range(self._model.ngeom) if is_plane(self._model, g)]
        point = self._model.geom_pos[planes[0]] - self._origin if planes else np.zeros(3)
        self._ground = Ground(self._root, _tile(self._size), _TILES, point) if planes else None

    def _shapes(self, body: int, entity: str) -> StaticEntities:
        drawn, colliders = body_geoms(self._model, body)
        for geom in drawn:
            if archetypes := shape(self._model, geom):
                yield f"{entity}/{join(geom_name(self._model, geom))}", archetypes
        place = self.paths.overlay("colliders", self._model.body(body).name or f"body_{body}")
        for geom in colliders:
            if archetypes := shape(self._model, geom):
                # A collision shape moves with its MuJoCo body.
                # All collision shapes are below one entity path, so that one click in the viewer hides all shapes.
                shown = [*archetypes, rr.CoordinateFrame(f"tf#/{entity}")]
                yield f"{place}/{join(geom_name(self._model, geom))}", shown

    def _series(self) -> StaticEntities:
        for channel in self.frames.channels:
            if len(channel.entities) == 1:
                yield channel.entities[0], [series(channel.names)]
            else:
                for i, (entity, name) in enumerate(zip(channel.entities, channel.names, strict=False)):
                    yield entity, [series([name], first=i)]
        for i, name in enumerate(ANGLES):
            yield self.paths.data("base", name), [series([name], first=i)]
        for name in self._events:
            yield self.paths.data("events", name), [rr.SeriesPoints(names=[name], colors=[_EVENT], marker_sizes=[4.0])]
        for contact in self._contacts:
            names = [self._model.body(b).name for b in contact.bodies]
            yield self.paths.data("contacts", contact.sensor), [series(names)]


def series(names: Sequence[str], first: int = 0) -> rr.SeriesLines:
    """Return names and colours of the lines in a plot; commands and targets are paler than measured values."""
    shades = [np.array(_PALETTE[(first + i) % len(_PALETTE)]) for i in range(len(names))]
    for i, name in enumerate(names):
        if name.endswith(("target", "command")):
            shades[i] = (0.45 * shades[i] + 0.55 * 255).astype(np.uint8)
    return rr.SeriesLines(names=list(names), colors=shades)


def _tile(size: float) -> float:
    wanted = size / 1.5
    power = 10.0 ** np.floor(np.log10(wanted))
    return float(power * max(k for k in (1, 2, 5) if k * power <= wanted * 1.001))
