"""The ground: the base class with its geoms, material, environment origins and heights, and the plane."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import torch

from wheelleg_exp.constraints import NonNegative, Share
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.batch_engine import BatchEngine
from wheelleg_exp.sim.options import CombineMode
from wheelleg_exp.state import Stateful
from wheelleg_exp.terms.term_errors import code_place, described, dotted_name

_FAR = 1e3  # Rays that measure the ground's height start at a height of 1,000 m.


class Probe:
    """Measures the ground's heights by vertical rays in a model that contains only the ground."""

    def __init__(self, add_to: Callable[[mujoco.MjSpec], None]) -> None:
        self._add_to = add_to

    @cached_property
    def model(self) -> mujoco.MjModel:
        """A model that contains only the ground."""
        spec = mujoco.MjSpec()
        self._add_to(spec)
        return spec.compile()

    @cached_property
    def _engine(self) -> BatchEngine:
        return BatchEngine(self.model, 1, 1)

    def height_at(self, xy: torch.Tensor, outside: float = 0.0) -> torch.Tensor:
        """Return the ground's height (...) at points (..., 2), m; points without ground get the value ``outside``."""
        origins = torch.cat((xy, torch.full_like(xy[..., :1], _FAR)), dim=-1).reshape(1, -1, 3)
        down = torch.tensor([0.0, 0.0, -1.0], device=xy.device).expand_as(origins)
        distance = self._engine.ray(origins, down).reshape(xy.shape[:-1])
        return torch.where(distance < 0, outside, _FAR - distance).to(xy)


GROUND = "ground"
TERRAIN_KEY = "env.scene.terrain"
GROUND_GROUP = 0  # Geom group 0 is reserved for the ground.


class TerrainBase(Stateful):
    """The ground (``env.scene.terrain``): one YAML node, from this package or user-defined.

    MuJoCo has no restitution, and one friction coefficient, which ``env.robot.friction_source`` selects from the two.

    Args:
        static_friction: coefficient at rest.
        dynamic_friction: coefficient in motion.
        restitution: coefficient of restitution.

    Attributes:
        env_origins: origins of the environments, m, (N, 3).
        terrain_origins: origins of the tiles, m, (rows, cols, 3); None on a ground without tiles.
        terrain_levels: row of each environment's tile, (N,); higher rows are harder; 0 without tiles. As in Isaac Lab,
            a plane does not have this attribute: terms test whether it exists.
        terrain_types: column of each environment's tile, (N,); 0 without tiles. A plane does not have it.
        max_terrain_level: number of rows.
        size: edges of a tile along x and y, m; infinite without tiles.
        border_width: width of the ground around the tiles, m.
        flat_patches: flat patches by name, m, (rows, cols, P, 3).
    """

    env_origins: torch.Tensor
    terrain_origins: torch.Tensor | None = None
    terrain_levels: torch.Tensor
    terrain_types: torch.Tensor
    max_terrain_level: int = 1
    max_init_terrain_level: int | None = None
    size: tuple[float, float] = (math.inf, math.inf)
    border_width: float = 0.0
    difficulty_range: tuple[float, float] = (0.0, 1.0)

    def __init__(self, static_friction: NonNegative, dynamic_friction: NonNegative, restitution: Share) -> None:
        self.static_friction = static_friction
        self.dynamic_friction = dynamic_friction
        self.restitution = restitution
        self.flat_patches: dict[str, torch.Tensor] = {}

    @property
    def cfg(self) -> SimpleNamespace:
        """The part of the config that terms written for Isaac Lab read: ``terrain_type`` and ``terrain_generator``."""
        if self.terrain_origins is None:
            return SimpleNamespace(terrain_type="plane", terrain_generator=None)
        rows, cols = self.terrain_origins.shape[:2]
        tiles = SimpleNamespace(size=self.size, num_rows=rows, num_cols=cols, border_width=self.border_width)
        tiles.difficulty_range = self.difficulty_range
        return SimpleNamespace(terrain_type="generator", terrain_generator=tiles)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the ground's geoms, named ``ground`` or ``ground/...``, to the scene's spec."""
        raise NotImplementedError("a ground needs 'add_to(spec)'")

    def friction(self, source: str) -> float:
        """Return the ground's ``static`` or ``dynamic`` friction coefficient."""
        return self.static_friction if source == "static" else self.dynamic_friction

    def origins(self, num_envs: int, spacing: float, device: torch.device) -> torch.Tensor:
        """Return the origins of the environments, m, (N, 3): a square grid, unless a subclass overrides this."""
        return grid_origins(num_envs, spacing, device)

    def read_files(self, folder: Path) -> None:
        """Read the ground's files from the robot's folder; the scene calls this method before all other methods."""

    def place(self, num_envs: int, spacing: float, device: torch.device, stream: Callable[[], torch.Generator]) -> None:
        """Compute the origins of all environments; the scene calls this method once, before the method ``add_to``.

        ``spacing`` is the grid distance, m. ``stream`` returns a random generator; call it only if you need one.
        """
        self.probe, self._stream = Probe(self.add_to), stream
        self.terrain_levels = torch.zeros(num_envs, dtype=torch.long, device=device)
        self.terrain_types = torch.zeros(num_envs, dtype=torch.long, device=device)
        if self.terrain_origins is None:
            self.env_origins = self.origins(num_envs, spacing, device)
            self._require_shape("origins", self.env_origins, (num_envs, 3))
            return
        # As in Isaac Lab, the environments are spread evenly over the terrain's columns, and get random rows.
        rows, cols, _ = self.terrain_origins.shape
        self.max_terrain_level = rows
        highest = rows - 1 if self.max_init_terrain_level is None else min(self.max_init_terrain_level, rows - 1)
        levels = torch.randint(highest + 1, (num_envs,), generator=stream(), device=device)
        self.terrain_levels = self.buffer("terrain_levels", levels)
        self.terrain_types = torch.arange(num_envs, device=device) * cols // num_envs
        self.env_origins = self.terrain_origins[self.terrain_levels, self.terrain_types]

    def _require_shape(self, method: str, value: torch.Tensor, shape: tuple[int, ...]) -> None:
        if getattr(value, "shape", None) != shape:
            message = f"'{dotted_name(self)}.{method}' returns {described(value)}"
            where = code_place(getattr(self, method))
            raise ConfigError(message, key=TERRAIN_KEY, where=where, expected=f"a tensor of shape {shape}")

    def lay(self, spec: mujoco.MjSpec) -> None:
        """Add the ground to the MuJoCo spec; raise ConfigError if ``add_to`` or ``height_at`` has a wrong result."""
        before = Counter(geom.name for geom in spec.geoms)
        self.add_to(spec)
        added = Counter(geom.name for geom in spec.geoms) - before
        wrong = [name for name in added if not is_ground(name)]
        if wrong or not added:
            found = f"a geom named '{wrong[0]}'" if wrong else "no geom"
            expected = f"geoms named '{GROUND}' or '{GROUND}/...', by which the scene recognises the ground"
            message = f"'{dotted_name(self)}.add_to' adds {found}"
            raise ConfigError(message, key=TERRAIN_KEY, where=code_place(self.add_to), expected=expected)
        if self.has_formula:
            points = self.env_origins[:, None, :2]
            self._require_shape("height_at", self.height_at(points), tuple(points.shape[:-1]))

    def update_env_origins(self, env_ids: torch.Tensor, move_up: torch.Tensor, move_down: torch.Tensor) -> None:
        """Move environments ``env_ids`` (n,) to harder or easier tiles in their columns, given two masks (n,) bool.

        As in Isaac Lab, environments move up from the hardest row to a random row. Nothing happens without tiles.
        """
        if self.terrain_origins is None:
            return
        rows = self.max_terrain_level
        levels = self.terrain_levels[env_ids] + move_up.long() - move_down.long()
        anywhere = torch.randint(rows, levels.shape, generator=self._stream(), device=levels.device)
        levels = torch.where(levels >= rows, anywhere, levels.clamp(min=0))
        self.terrain_levels[env_ids] = levels
        self.env_origins[env_ids] = self.terrain_origins[levels, self.terrain_types[env_ids]]

    def height_at(self, xy: torch.Tensor) -> torch.Tensor:
        """Return the ground's height (...) at world points (..., 2), m; 0 for points without ground.

        Vertical rays from above measure the height; a subclass may override this with a formula.
        """
        return self.probe.height_at(xy)

    @property
    def has_formula(self) -> bool:
        """Whether ``height_at`` evaluates a fast formula instead of casting rays."""
        return type(self).height_at is not TerrainBase.height_at

    def load_state_dict(self, saved: Mapping[str, object]) -> None:
        super().load_state_dict(saved)
        if self.terrain_origins is not None:
            self.env_origins.copy_(self.terrain_origins[self.terrain_levels, self.terrain_types])


def is_ground(name: str) -> bool:
    """Return whether a geom of the scene is part of the ground."""
    return name == GROUND or name.startswith(f"{GROUND}/")


def add_geom(spec: mujoco.MjSpec, name: str, friction: float, **what: object) -> None:
    """Add one of the ground's geoms to the scene's MuJoCo spec."""
    spec.worldbody.add_geom(name=name, friction=[friction, 0.005, 0.0001], rgba=[0.35, 0.38, 0.42, 1.0], **what)


def grid_origins(num_envs: int, spacing: float, device: torch.device | None = None) -> torch.Tensor:
    """Return the origins (N, 3) of environments on a square grid around the world's origin, row by row.

    As in Isaac Lab: ``ceil(N / floor(sqrt(N)))`` rows, the next row at a smaller x, the next column at a larger y.
    """
    rows = math.ceil(num_envs / math.floor(math.sqrt(num_envs)))
    cols = math.ceil(num_envs / rows)
    i, j = torch.meshgrid(torch.arange(rows, device=device), torch.arange(cols, device=device), indexing="ij")
    origins = torch.zeros(num_envs, 3, device=device)
    origins[:, 0] = (-(i.flatten()[:num_envs] - (rows - 1) / 2)) * spacing
    origins[:, 1] = (j.flatten()[:num_envs] - (cols - 1) / 2) * spacing
    return origins


def combined_friction(own: Any, ground: float, mode: CombineMode) -> Any:
    """Return the friction of a contact, as PhysX combines it, for the robot's friction ``own`` (torch or NumPy)."""
    if mode == "average":
        return (own + ground) / 2
    if mode == "multiply":
        return own * ground
    return own.clip(max=ground) if mode == "min" else own.clip(min=ground)


class Plane(TerrainBase):
    """An infinite plane at height 0 as the ground; ``TerrainBase`` defines the plane's friction and restitution."""

    def place(self, num_envs: int, spacing: float, device: torch.device, stream: Callable[[], torch.Generator]) -> None:
        super().place(num_envs, spacing, device, stream)
        if self.terrain_origins is None:
            del self.terrain_levels, self.terrain_types

    def add_to(self, spec: mujoco.MjSpec) -> None:
        add_geom(spec, GROUND, self.dynamic_friction, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05])

    def height_at(self, xy: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(xy[..., 0])
