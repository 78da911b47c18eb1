"""The base class of grounds: geoms in the scene, material, origins of the environments, heights; and the plane."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import torch

from wheelleg_exp.constraints import NonNegative, Share
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.batch_engine import BatchEngine
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.state import Kept
from wheelleg_exp.terms.term_errors import code_place, described, dotted_name

_FAR = 1e3  # m above the world's origin: where rays begin


class Probe:
    """A model of the ground alone, made when it is first asked.

    Args:
        add_to: adds the ground to a spec.
    """

    def __init__(self, add_to: Callable[[mujoco.MjSpec], None]) -> None:
        self._add_to = add_to
        self._model: mujoco.MjModel | None = None
        self._engine: Engine | None = None

    def model(self) -> mujoco.MjModel:
        """Return the model of the ground alone."""
        if self._model is None:
            spec = mujoco.MjSpec()
            self._add_to(spec)
            self._model = spec.compile()
        return self._model

    def height_at(self, xy: torch.Tensor, beside: float = 0.0) -> torch.Tensor:
        """Return the height of the ground at points (..., 2), m, (...); ``beside`` where there is none."""
        if self._engine is None:
            self._engine = BatchEngine(self.model(), 1, 1)
        far = torch.full_like(xy[..., :1], _FAR)
        origins = torch.cat((xy, far), dim=-1).reshape(1, -1, 3)
        down = torch.tensor([0.0, 0.0, -1.0], device=xy.device).expand_as(origins)
        distance = self._engine.ray(origins, down).reshape(xy.shape[:-1])
        return torch.where(distance < 0, beside, _FAR - distance).to(xy)


GROUND = "ground"
TERRAIN_KEY = "env.scene.terrain"
GROUND_GROUP = 0  # MuJoCo's geom group that holds the ground and nothing else


class TerrainBase(Kept):
    """The ground (``env.scene.terrain``); one YAML node, from this package or a user's own.

    Restitution has no counterpart in MuJoCo, and one of the two frictions is used (``env.robot.friction_source``).

    Args:
        static_friction: the ground's coefficient at rest.
        dynamic_friction: the ground's coefficient in motion.
        restitution: the ground's coefficient of restitution.

    Attributes:
        env_origins: where the environments begin, m, (N, 3).
        terrain_origins: where those on each tile begin, m, (rows, cols, 3); None on a ground without tiles.
        terrain_levels: the row of each environment's tile, the harder the higher, (N,) long; 0 without tiles.
        terrain_types: the column of each environment's tile, (N,) long; 0 without tiles.
        max_terrain_level: number of rows.
        size: edges of a tile along x and y, m; infinite without tiles.
        border_width: of the ground around the tiles, m.
        flat_patches: places that are flat enough, by name, m, (rows, cols, P, 3).
    """

    env_origins: torch.Tensor
    terrain_origins: torch.Tensor | None = None
    terrain_levels: torch.Tensor
    terrain_types: torch.Tensor
    max_terrain_level: int = 1
    max_init_terrain_level: int | None = None
    size: tuple[float, float] = (math.inf, math.inf)
    border_width: float = 0.0

    def __init__(self, static_friction: NonNegative, dynamic_friction: NonNegative, restitution: Share) -> None:
        self.static_friction = static_friction
        self.dynamic_friction = dynamic_friction
        self.restitution = restitution
        self.flat_patches: dict[str, torch.Tensor] = {}

    @property
    def cfg(self) -> SimpleNamespace:
        """What terms written for Isaac Lab read: ``terrain_type`` and the ``terrain_generator``'s tiles, or None."""
        if self.terrain_origins is None:
            return SimpleNamespace(terrain_type="plane", terrain_generator=None)
        rows, cols = self.terrain_origins.shape[:2]
        tiles = SimpleNamespace(size=self.size, num_rows=rows, num_cols=cols, border_width=self.border_width)
        return SimpleNamespace(terrain_type="generator", terrain_generator=tiles)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the ground's geoms, named ``ground`` or ``ground/...``, to the scene's spec."""
        raise NotImplementedError("a ground needs 'add_to(spec)'")

    def friction(self, source: str) -> float:
        """Return the ``static`` or the ``dynamic`` coefficient."""
        return self.static_friction if source == "static" else self.dynamic_friction

    def origins(self, num_envs: int, spacing: float, device: torch.device) -> torch.Tensor:
        """Return where the environments begin, m, (N, 3): a square grid, unless the ground has its own places."""
        return grid_origins(num_envs, spacing, device)

    def read_files(self, folder: Path) -> None:
        """Read the files that the ground is made of; called first.

        Args:
            folder: the robot's folder, in which they lie.
        """

    def place(self, num_envs: int, spacing: float, device: torch.device, stream: Callable[[], torch.Generator]) -> None:
        """Find where the environments begin; called once, before ``add_to``.

        On tiles an environment's column is ``floor(i / (N / cols))`` and its row is drawn from the rows up to
        ``max_init_terrain_level``, as in Isaac Lab.

        Args:
            num_envs: number of environments, N.
            spacing: between neighbours on a grid, m.
            device: where the tensors are.
            stream: returns the ground's random stream; a ground that draws nothing does not ask for it.
        """
        self._probe, self._stream = Probe(self.add_to), stream
        self.terrain_levels = torch.zeros(num_envs, dtype=torch.long, device=device)
        self.terrain_types = torch.zeros(num_envs, dtype=torch.long, device=device)
        if self.terrain_origins is None:
            self.env_origins = self.origins(num_envs, spacing, device)
            self._require_shape("origins", self.env_origins, (num_envs, 3))
            return
        rows, cols, _ = self.terrain_origins.shape
        self.max_terrain_level = rows
        highest = rows - 1 if self.max_init_terrain_level is None else min(self.max_init_terrain_level, rows - 1)
        self.terrain_levels = torch.randint(highest + 1, (num_envs,), generator=stream(), device=device)
        self.terrain_types = torch.arange(num_envs, device=device) * cols // num_envs
        self.env_origins = self.terrain_origins[self.terrain_levels, self.terrain_types]

    def _require_shape(self, method: str, value: torch.Tensor, shape: tuple[int, ...]) -> None:
        if getattr(value, "shape", None) != shape:
            message = f"'{dotted_name(self)}.{method}' returns {described(value)}"
            where = code_place(getattr(self, method))
            raise ConfigError(message, key=TERRAIN_KEY, where=where, expected=f"a tensor of shape {shape}")

    def lay(self, spec: mujoco.MjSpec) -> None:
        """Add the ground to the scene's spec: ``add_to``, held against what the scene needs of it.

        Raises:
            ConfigError: no geom is added, or one that is not named as the ground's; or heights have a wrong shape.
        """
        before = Counter(geom.name for geom in spec.geoms)
        self.add_to(spec)
        added = Counter(geom.name for geom in spec.geoms) - before
        wrong = [name for name in added if not is_ground(name)]
        if wrong or not added:
            found = f"a geom named '{wrong[0]}'" if wrong else "no geom"
            expected = f"geoms named '{GROUND}' or '{GROUND}/...', by which the scene knows the ground"
            message = f"'{dotted_name(self)}.add_to' adds {found}"
            raise ConfigError(message, key=TERRAIN_KEY, where=code_place(self.add_to), expected=expected)
        if self.has_formula:
            points = self.env_origins[:, None, :2]
            self._require_shape("height_at", self.height_at(points), tuple(points.shape[:-1]))

    def update_env_origins(self, env_ids: torch.Tensor, move_up: torch.Tensor, move_down: torch.Tensor) -> None:
        """Move environments to a harder or an easier tile of their column; nothing happens without tiles.

        Who has passed the last row is sent to a random one, and nobody falls below the first, as in Isaac Lab.

        Args:
            env_ids: the environments, (n,).
            move_up: who goes a row up, (n,) bool.
            move_down: who goes a row down, (n,) bool.
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
        """Return the height of the ground at points (..., 2) of the world, m, (...); 0 where there is none.

        A ground that knows no formula is asked by rays from above.
        """
        return self._probe.height_at(xy)

    def model_alone(self) -> mujoco.MjModel:
        """Return a model of the ground and nothing else."""
        return self._probe.model()

    @property
    def has_formula(self) -> bool:
        """Whether ``height_at`` is a formula, and costs less than rays."""
        return type(self).height_at is not TerrainBase.height_at

    def state_dict(self) -> dict[str, Any]:
        """Return what a curriculum has changed; nothing for a ground that stays as it is."""
        return {} if self.terrain_origins is None else {"terrain_levels": self.terrain_levels.clone()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        if self.terrain_origins is not None:
            self.terrain_levels.copy_(saved["terrain_levels"])
            self.env_origins.copy_(self.terrain_origins[self.terrain_levels, self.terrain_types])


def is_ground(name: str) -> bool:
    """Return whether a geom of the scene belongs to the ground."""
    return name == GROUND or name.startswith(f"{GROUND}/")


def grid_origins(num_envs: int, spacing: float, device: torch.device | None = None) -> torch.Tensor:
    """Return the origins (N, 3) of environments on a square grid around the world's origin, row by row.

    Layout as in Isaac Lab: ``rows = ceil(N / floor(sqrt(N)))``, x falls with the row, y grows with the column
    mirrored about the centre.
    """
    rows = math.ceil(num_envs / math.floor(math.sqrt(num_envs)))
    cols = math.ceil(num_envs / rows)
    i, j = torch.meshgrid(torch.arange(rows, device=device), torch.arange(cols, device=device), indexing="ij")
    origins = torch.zeros(num_envs, 3, device=device)
    origins[:, 0] = (-(i.flatten()[:num_envs] - (rows - 1) / 2)) * spacing
    origins[:, 1] = (j.flatten()[:num_envs] - (cols - 1) / 2) * spacing
    return origins


class Plane(TerrainBase):
    """An infinite plane at height 0. Its friction and restitution are those of ``TerrainBase``."""

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the plane to the scene's spec."""
        spec.worldbody.add_geom(
            name=GROUND,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=[0, 0, 0.05],
            friction=[self.dynamic_friction, 0.005, 0.0001],
            rgba=[0.35, 0.38, 0.42, 1],
        )

    def height_at(self, xy: torch.Tensor) -> torch.Tensor:
        """Return zeros (...) for points (..., 2)."""
        return torch.zeros_like(xy[..., 0])
