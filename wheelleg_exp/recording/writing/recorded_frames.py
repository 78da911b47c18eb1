"""Read the numbers of a recorded frame from the environment, and buffer frames until the recording is written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from operator import attrgetter

import mujoco
import numpy as np
import torch
from numpy.typing import ArrayLike

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.mdp.commands import UniformVelocityCommand
from wheelleg_exp.recording.layout import EnvPaths
from wheelleg_exp.rendering.render_scene import Array
from wheelleg_exp.sim.sensors import ContactSensor
from wheelleg_exp.state import host_copy

Read = Callable[[], ArrayLike]
VELOCITY_NAMES = ("v_x", "v_y", "w_z")
_FIRST_CAPACITY = 256
_GRAVITY = ("g_x", "g_y", "g_z")
_FREE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_FREE_VELOCITY = ("v_x", "v_y", "v_z", "w_x", "w_y", "w_z")


@dataclass(frozen=True)
class Channel:
    """A recorded quantity, such as the joint positions: its key, its numbers' names, and a function that reads it.

    ``entities`` stores all numbers in one Rerun entity, or each in its own. Without any, the quantity is only buffered.
    """

    key: str
    names: tuple[str, ...]
    read: Read
    entities: tuple[str, ...]


def environment_channels(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths, episodes: Episodes) -> list[Channel]:
    """Return the recorded quantities of one environment, without body poses, which follow from ``qpos``."""
    parts = (_base, _commands, _joints, _contacts, _actions, _observations, _rewards, _terminations)
    channels = [channel for part in parts for channel in part(env, env_id, paths)]
    return [*channels, _episode(env, env_id, paths, episodes)]


def velocity_command(env: ManagerBasedRLEnv) -> str | None:
    """Return the name of the task's first command for the base's planar velocity (v_x, v_y, w_z); None without one."""
    manager = env.command_manager
    names = (name for name in manager.active_terms if isinstance(manager.get_term(name), UniformVelocityCommand))
    return next(names, None)


def one(key: str, entity: str, names: Sequence[str], read: Read) -> Channel:
    """Return a ``Channel`` that stores all its numbers in one Rerun entity, at the path ``entity``."""
    return Channel(key, tuple(names), read, (entity,))


def row(read: Callable[[], torch.Tensor], env_id: int) -> Read:
    """Return a function that calls ``read`` and returns the row of environment ``env_id`` as a flat array."""
    return lambda: host_copy(read()[env_id]).ravel()


def _base(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    data, model = env.scene.robot.data, env.scene.model
    qpos, qvel = (env.scene.sim.view(name)[env_id] for name in ("qpos", "qvel"))

    def split(key: str, names: Sequence[str], read: Read) -> Channel:
        return Channel(key, tuple(names), read, tuple(paths.data("base", name) for name in names))

    return [
        split("height", ["height"], lambda: host_copy(data.root_pos_w[env_id, 2])),
        split("lin_vel", ["v_x", "v_y", "v_z"], row(lambda: data.root_lin_vel_b, env_id)),
        split("ang_vel", ["w_x", "w_y", "w_z"], row(lambda: data.root_ang_vel_b, env_id)),
        one("gravity", paths.data("base", "gravity"), _GRAVITY, row(lambda: data.projected_gravity_b, env_id)),
        one("qpos", paths.data("state", "qpos"), _coordinates(model, _FREE), lambda: host_copy(qpos)),
        one("qvel", paths.data("state", "qvel"), _coordinates(model, _FREE_VELOCITY), lambda: host_copy(qvel)),
    ]


def _coordinates(model: mujoco.MjModel, free: tuple[str, ...]) -> list[str]:
    """Return the name of each coordinate of qpos or qvel: the joint, with a suffix for several coordinates."""
    ball = ("w", "x", "y", "z") if len(free) == len(_FREE) else ("x", "y", "z")
    several = {int(mujoco.mjtJoint.mjJNT_FREE): free, int(mujoco.mjtJoint.mjJNT_BALL): ball}
    names: list[str] = []
    for j in range(model.njnt):
        joint, parts = model.joint(j).name or f"joint_{j}", several.get(int(model.jnt_type[j]))
        names += [joint] if parts is None else [f"{joint}.{part}" for part in parts]
    return names


def _commands(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    velocity, found = velocity_command(env), []
    for name in env.command_manager.active_terms:
        term = env.command_manager.get_term(name)
        read = row(partial(attrgetter("command"), term), env_id)
        if name == velocity:
            # Use one Rerun entity per component, so that one plot shows a commanded velocity with the measured one.
            names = tuple(f"{part} command" for part in VELOCITY_NAMES)
            entities = tuple(paths.data("commands", name, part) for part in VELOCITY_NAMES)
            found.append(Channel(f"commands/{name}", names, read, entities))
        else:
            names = tuple(f"{name}[{i}]" for i in range(term.command.shape[1]))
            found.append(one(f"commands/{name}", paths.data("commands", name), names, read))
    return found


def _joints(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    data, names = env.scene.robot.data, env.scene.robot.joint_names
    fields = {
        "position": "joint_pos",
        "position_target": "joint_pos_target",
        "velocity": "joint_vel",
        "velocity_target": "joint_vel_target",
        "effort": "applied_torque",
        "effort_computed": "computed_torque",
    }
    found = []
    for kind, field in fields.items():
        shown = tuple(f"{name} target" if kind.endswith("target") else name for name in names)
        entities = tuple(paths.data("joints", name, kind) for name in names)
        found.append(Channel(f"joints/{kind}", shown, row(partial(getattr, data, field), env_id), entities))
    return found


def _contacts(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    found = []
    for name, sensor in env.scene.sensors.items():
        if isinstance(sensor, ContactSensor):
            names = [f"{body}.{axis}" for body in sensor.body_names for axis in "xyz"]
            read = row(partial(attrgetter("data.net_forces_w"), sensor), env_id)
            found.append(one(f"contacts/{name}", paths.data("contacts", name, "forces"), names, read))
            peak = row(sensor.max_force_norm, env_id)
            found.append(one(f"peak/{name}", paths.data("contacts", name, "peak"), sensor.body_names, peak))
    return found


@dataclass(frozen=True)
class Stamp:
    """The time of a frame: control step, simulated time in ns, and the training iteration or -1."""

    step: int
    time_ns: int
    iteration: int


class Frames:
    """Buffers one environment's recorded numbers until a flush: one row per frame, one column per number."""

    def __init__(self, channels: Sequence[Channel]) -> None:
        self.channels = list(channels)
        ends = np.cumsum([0, *(len(channel.names) for channel in self.channels)]).tolist()
        self._slices = [slice(a, b) for a, b in pairwise(ends)]
        self._rows = np.empty((_FIRST_CAPACITY, ends[-1]))
        self.count = 0

    def append(self) -> None:
        """Read all recorded quantities of the environment, and add their numbers as a new frame to the buffer."""
        if self.count == len(self._rows):
            self._rows = np.concatenate((self._rows, np.empty_like(self._rows)))
        row = self._rows[self.count]
        for channel, columns in zip(self.channels, self._slices, strict=True):
            row[columns] = channel.read()
        self.count += 1

    def blocks(self) -> dict[str, Array]:
        """Return a dictionary that maps each recorded quantity's key to its buffered numbers, (frames, width)."""
        rows = self._rows[: self.count]
        return {c.key: rows[:, s] for c, s in zip(self.channels, self._slices, strict=True)}

    def clear(self) -> None:
        self.count = 0


class Episodes:
    """A counter of recorded episodes. A reset or a gap between recorded control steps increases the episode number."""

    def __init__(self) -> None:
        self.number = -1
        self._step, self._episode_step = -1, -1

    def advance(self, step: int, episode_step: int) -> None:
        """Count a recorded control step; after a reset or a gap between recorded steps, increase the episode number."""
        if step != self._step + 1 or episode_step != self._episode_step + 1:
            self.number += 1
        self._step, self._episode_step = step, episode_step

    def restore(self, number: int, step: int, episode_step: int) -> None:
        """Set the episode counters to the last values in the earlier recording of a resumed run."""
        self.number, self._step, self._episode_step = number, step, episode_step


class Sample:
    """Chooses which control steps of an environment are recorded. A sample is a recorded sequence of complete episodes.

    After ``begin``, recording starts with the next episode. A resumed run reads from the recording what was recorded.
    """

    def __init__(self) -> None:
        self.steps: list[int] = []
        self._enough = self._most = self._taken = 0
        self._is_in_episode = False

    def begin(self, enough: int, most: int, *, taken: int, is_in_episode: bool) -> None:
        """Record complete episodes from now on; if a run resumes, ``taken`` control steps are already recorded.

        After ``enough`` steps (0: record nothing), recording stops at the end of the current episode; after ``most``
        steps, at once. ``is_in_episode`` is true if the earlier steps of the current episode were recorded.
        """
        self._enough, self._most, self._taken = enough, most, taken
        self._is_in_episode = is_in_episode and enough > 0

    def takes(self, episode_step: int) -> bool:
        """Return whether to record a control step; ``episode_step`` is its number within the episode, from 1."""
        begins = episode_step == 1 and self._taken < self._enough
        self._is_in_episode = (self._is_in_episode or begins) and self._taken < self._most
        return self._is_in_episode

    def took(self, *, ends: bool) -> None:
        """Count a recorded control step; ``ends`` is true for the last control step of an episode."""
        self._taken += 1
        self._is_in_episode = not ends


def _actions(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    manager = env.action_manager
    terms = {name: manager.get_term(name) for name in manager.active_terms}
    raw = {name: term.action_dim for name, term in terms.items()}
    processed = {name: int(term.processed_actions.shape[1]) for name, term in terms.items()}

    def processed_actions() -> ArrayLike:
        parts = [host_copy(term.processed_actions[env_id]) for term in terms.values()]
        return np.concatenate(parts) if parts else []

    return [
        one("actions/raw", paths.data("actions", "raw"), _action_names(env, raw), row(lambda: manager.action, env_id)),
        one("actions/processed", paths.data("actions", "processed"), _action_names(env, processed), processed_actions),
    ]


def _action_names(env: ManagerBasedRLEnv, widths: dict[str, int]) -> list[str]:
    names: list[str] = []
    for name, width in widths.items():
        joints = getattr(env.action_manager.get_term(name), "joint_names", None) or ()
        names += [f"{name}[{joint}]" for joint in (joints if len(joints) == width else range(width))]
    return names


def _observations(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    manager, found = env.observation_manager, []
    for group, terms in manager.active_terms.items():
        for term, shape in zip(terms, manager.group_obs_term_dim[group], strict=True):
            if len(shape) <= 2:  # Observations that are images are not recorded as numbers.
                # The first axis of a two-dimensional observation is the history.
                histories = [f"@{h}" for h in range(shape[0])] if len(shape) == 2 else [""]
                names = [f"{term}[{i}]{history}" for history in histories for i in range(shape[-1])]
                read, key = _observation(env, env_id, group, term, len(names)), ("observations", group, term)
                found.append(one("/".join(key), paths.data(*key), names, read))
    return found


def _observation(env: ManagerBasedRLEnv, env_id: int, group: str, term: str, width: int) -> Read:
    manager, nothing = env.observation_manager, np.full(width, np.nan)

    def read() -> ArrayLike:
        value = manager.obs_buf.get(group)
        if value is None:
            return nothing
        mine = value[env_id : env_id + 1] if isinstance(value, torch.Tensor) else value
        return host_copy(manager.part(group, term, mine)[0 if mine is not value else env_id]).ravel()

    return read


def _rewards(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    # Record the weighted value of each reward term per second, and the total reward per second.
    manager, names = env.reward_manager, env.reward_manager.active_terms
    places = tuple(paths.data("rewards", name) for name in names)
    terms = Channel("rewards", tuple(names), lambda: host_copy(manager.step_reward[:, env_id]), places)
    total = paths.data("rewards", "total")
    return [terms, one("total", total, ["total"], lambda: host_copy(env.reward_buf[env_id]) / env.step_dt)]


def _terminations(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths) -> list[Channel]:
    manager, names = env.termination_manager, env.termination_manager.active_terms
    fired = [manager.get_term(name) for name in names]
    places = tuple(paths.data("terminations", name) for name in names)
    read = (lambda: host_copy(torch.stack(fired)[:, env_id])) if fired else list
    return [Channel("terminations", tuple(names), read, places)]


def _episode(env: ManagerBasedRLEnv, env_id: int, paths: EnvPaths, episodes: Episodes) -> Channel:
    manager = env.termination_manager

    def read() -> Sequence[float]:
        failed, over = bool(manager.terminated[env_id]), bool(manager.time_outs[env_id])
        return (episodes.number, int(host_copy(env.episode_length_buf[env_id])), failed, over)

    names = ("number", "step", "terminated", "truncated")
    return Channel("episode", names, read, tuple(paths.data("episode", name) for name in names))
