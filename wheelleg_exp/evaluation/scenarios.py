"""Fixed scenarios: the commands of each episode over time, and the digest of such a table."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from itertools import product

import torch

from wheelleg_exp.evaluation import protocol_options
from wheelleg_exp.managers.manager_base import build

Vec3 = tuple[float, float, float]
ZERO: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Scenarios:
    """A table with one episode per row; all episodes of a group, called cell, get the same velocity commands.

    ``times`` (K,) are the start times of the K successive commands, s; the first is 0. ``cells`` (C, K, 3) are the
    commands of each cell: v_x and v_y in m/s, w_z in rad/s. ``names`` (C,) are names such as ``vx=1 wz=0``.
    ``episodes`` is the number per cell. ``settings`` describes pushes, tiles, or a changed world as text. ``heights``
    (C,) are the commanded heights of the base, m, if the test has such commands.
    """

    test: str
    horizon_s: float
    times: tuple[float, ...]
    cells: tuple[tuple[Vec3, ...], ...]
    names: tuple[str, ...]
    episodes: int
    settings: str = ""
    heights: tuple[float, ...] = ()

    @property
    def size(self) -> int:
        """Number of episodes, N."""
        return len(self.cells) * self.episodes

    def cell_of(self) -> torch.Tensor:
        """Return the index of each episode's cell (group with equal commands), (N,). Episodes are sorted by cell."""
        return torch.arange(len(self.cells)).repeat_interleave(self.episodes)

    def height_of(self) -> torch.Tensor:
        """Return each episode's commanded height, m, (N,)."""
        return torch.tensor(self.heights)[self.cell_of()]

    def commands(self) -> torch.Tensor:
        """Return the K velocity commands of each episode, (N, K, 3)."""
        return torch.tensor(self.cells)[self.cell_of()]

    def digest(self, seed: int) -> str:
        """Return the sha256 of the scenario table and the seed of the start states."""
        table = [self.test, self.horizon_s, self.times, self.cells, self.names, self.episodes, self.settings, seed]
        return hashlib.sha256(json.dumps(table).encode()).hexdigest()


def standing(options: protocol_options.Stand) -> Scenarios:
    """Return a table of standing episodes, which have a zero command."""
    return Scenarios("stand", float(options.horizon_s), (0.0,), ((ZERO,),), ("stand",), options.episodes)


def walking(options: protocol_options.Walk) -> Scenarios:
    """Return a table of episodes over the grid of velocity commands, sorted by forward speed."""
    pairs = [(float(x), float(z)) for x, z in product(options.lin_vel_x, options.ang_vel_z)]
    cells = tuple(((x, 0.0, z),) for x, z in pairs)
    names = tuple(f"vx={x:g} wz={z:g}" for x, z in pairs)
    return Scenarios("walk", float(options.horizon_s), (0.0,), cells, names, options.episodes)


def stepping(options: protocol_options.Steps) -> Scenarios:
    """Return a table of episodes with the command sequence 0, c, -c, 0, for each forward speed and each yaw rate c."""
    forward = [(float(x), 0.0, 0.0) for x in options.lin_vel_x]
    turning = [(0.0, 0.0, float(z)) for z in options.ang_vel_z]
    cells = tuple((ZERO, c, (-c[0], 0.0, -c[2]), ZERO) for c in (*forward, *turning))
    names = (*(f"vx={c[0]:g}" for c in forward), *(f"wz={c[2]:g}" for c in turning))
    begin, drive = float(options.stand_s), float(options.drive_s)
    times = (0.0, begin, begin + drive, begin + 2 * drive)
    return Scenarios("steps", begin + 3 * drive, times, cells, names, options.episodes)


def at_heights(options: protocol_options.Height) -> Scenarios:
    """Return a table of episodes over the grid of commanded heights and forward speeds."""
    pairs = [(float(h), float(x)) for h, x in product(options.heights, options.lin_vel_x)]
    cells, names = tuple(((x, 0.0, 0.0),) for _, x in pairs), tuple(f"h={h:g} vx={x:g}" for h, x in pairs)
    settings, heights = json.dumps(asdict(options)), tuple(h for h, _ in pairs)
    return Scenarios("height", float(options.horizon_s), (0.0,), cells, names, options.episodes, settings, heights)


def getting_up(options: protocol_options.GetUp) -> Scenarios:
    """Return a table of episodes that start in resting poses and have a zero command."""
    horizon, settings = float(options.at_s + options.after_s), json.dumps(asdict(options))
    return Scenarios("get_up", horizon, (0.0,), ((ZERO,),), ("lying",), options.episodes, settings)


def jumping(options: protocol_options.Jump) -> Scenarios:
    """Return a table of episodes with one jump, one group (cell) for each pair of a forward speed and a yaw rate."""
    pairs = [(float(x), float(z)) for x, z in product(options.lin_vel_x, options.ang_vel_z)]
    cells = tuple(((x, 0.0, z),) for x, z in pairs)
    names = tuple(f"vx={x:g} wz={z:g}" if z else f"vx={x:g}" for x, z in pairs)
    horizon, settings = float(options.at_s + options.after_s), json.dumps(asdict(options))
    return Scenarios("jump", horizon, (0.0,), cells, names, options.episodes, settings)


def pushing(options: protocol_options.Push) -> Scenarios:
    """Return a table of standing episodes with pushes, one group (cell) for each push direction and duration."""
    turns = [f"{360.0 * turn / options.directions:g}°" for turn in range(options.directions)]
    names = tuple(f"{turn} over {pulse:g} s" for pulse in options.pulses_s for turn in turns)
    horizon, settings = float(options.at_s + options.after_s), json.dumps(asdict(options))
    return Scenarios("push", horizon, (0.0,), ((ZERO,),) * len(names), names, options.episodes, settings)


def on_terrain(options: protocol_options.Terrain) -> Scenarios:
    """Return a table of episodes that drive straight, one group (cell) for each kind and level of terrain tile."""
    path = "protocol.terrain.scene.terrain.sub_terrains"
    kinds = {name: node for name, node in options.scene["terrain"]["sub_terrains"].items() if node is not None}
    parts = {name: build(node, f"{path}.{name}") for name, node in kinds.items()}
    levels = range(options.levels)
    labels = {kind: [part.label((level + 1) / options.levels) for level in levels] for kind, part in parts.items()}
    # Levels of equal height, as of a range without width, have numbers.
    named = {kind: own if len(set(own)) == len(own) else list(map(str, levels)) for kind, own in labels.items()}
    names = tuple(f"{kind}/{label}" for kind, own in named.items() for label in own)
    command: Vec3 = (float(options.lin_vel_x), 0.0, 0.0)
    settings = json.dumps([asdict(options), options.scene["terrain"]], sort_keys=True)
    cells = ((command,),) * len(names)
    return Scenarios("terrain", float(options.horizon_s), (0.0,), cells, names, options.episodes, settings)


def over_strips(options: protocol_options.Strip) -> Scenarios:
    """Return a table of episodes that drive straight over a strip of rough ground, one group (cell) for each strip."""
    names = tuple(f"{1000.0 * amplitude:g}mm" for amplitude in options.amplitudes)
    command: Vec3 = (float(options.lin_vel_x), 0.0, 0.0)
    settings, cells = json.dumps(asdict(options), sort_keys=True), ((command,),) * len(names)
    return Scenarios("strip", float(options.horizon_s), (0.0,), cells, names, options.episodes, settings)


def in_changed_world(options: protocol_options.Robust) -> Scenarios:
    """Return the episodes of one changed world: driving straight at each speed."""
    cells = tuple(((float(speed), 0.0, 0.0),) for speed in options.lin_vel_x)
    names = tuple(f"vx={speed:g}" for speed in options.lin_vel_x)
    # Tables without payloads and platforms have the digests that they had before these changes existed.
    given = {name: value for name, value in asdict(options).items() if value or name not in ("payload", "platform")}
    settings = json.dumps(given)
    return Scenarios("robust", float(options.horizon_s), (0.0,), cells, names, options.episodes, settings)
