"""Grounds from a user's file: an image or an array of heights, or a mesh."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from wheelleg_exp.constraints import Interval, Length, NonNegative, NotEmpty, PathBelow, Positive, Share
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.files import open_file
from wheelleg_exp.machine import require_memory
from wheelleg_exp.paths import GROUND as FOLDER
from wheelleg_exp.sim.terrain.relief import HeightMap, Tile, add_tile
from wheelleg_exp.sim.terrain.sub_terrains import FlatPatches
from wheelleg_exp.sim.terrain.terrain_base import GROUND, TERRAIN_KEY, Probe, TerrainBase

Array = npt.NDArray[np.float64]
Start = Annotated[Sequence[Annotated[Sequence[float], Length(2)]], NotEmpty()]
_KEY = f"{TERRAIN_KEY}.file"
_LARGEST = 1 << 25  # numbers in a file


class _FromFile(TerrainBase):
    """A ground from a file.

    Args:
        start: origins of the environments, in turn, (x, y), m.
        flat_patches: the flat patches to find, by name.
    """

    _kinds: tuple[str, ...]

    def __init__(
        self,
        file: str,
        start: Sequence[Sequence[float]],
        flat_patches: Mapping[str, FlatPatches] | None,
        static_friction: float,
        dynamic_friction: float,
        restitution: float,
    ) -> None:
        super().__init__(static_friction, dynamic_friction, restitution)
        self.file = file
        self._start = [(float(x), float(y)) for x, y in start]
        self._wanted = dict(flat_patches or {})

    def read_files(self, folder: Path) -> None:
        file = folder / FOLDER / self.file
        kind, known = file.suffix.lower(), self._kinds
        if kind not in known:
            expected, nearest = "a file that ends in " + " or ".join(known), nearest_name(kind, known)
            message = f"'{self.file}' is not a file of a ground"
            raise ConfigError(message, key=_KEY, expected=expected, nearest=nearest)
        with open_file(file):  # Refuse a pipe or a device.
            heights, self._centre, self._edges = self._read(file)
        self._tile = Tile(heights.astype(np.float32), boxes=False)

    def _read(self, file: Path) -> tuple[Array, tuple[float, float], tuple[float, float]]:
        """Return the heights, the centre, and the edges of the ground, m."""
        raise NotImplementedError

    def place(self, num_envs: int, spacing: float, device: torch.device, stream: Callable[[], torch.Generator]) -> None:
        self._map = HeightMap([self._tile], 1, self._edges, device)
        self._middle = torch.tensor(self._centre, device=device)
        super().place(num_envs, spacing, device, stream)
        if self._wanted:
            rng = np.random.default_rng(stream().initial_seed())
            alone = HeightMap([self._tile], 1, self._edges, torch.device("cpu"))
            for name, wanted in self._wanted.items():
                key = f"{TERRAIN_KEY}.flat_patches.{name}"
                found = wanted.find(alone.heights_at, np.zeros(3), self._edges, rng, key)
                places = torch.as_tensor(found + np.array([*self._centre, 0.0]), dtype=torch.float32, device=device)
                self.flat_patches[name] = places.expand(1, 1, -1, -1)

    def origins(self, num_envs: int, spacing: float, device: torch.device) -> torch.Tensor:
        """Return the environments' origins (N, 3), m; environment i starts at ``start[i % len(start)]``."""
        del spacing
        start = torch.tensor(self._start, device=device)
        xy = start[torch.arange(num_envs, device=device) % len(start)]
        return torch.cat((xy, self.height_at(xy).unsqueeze(1)), dim=1)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        add_tile(spec, GROUND, self.dynamic_friction, self._tile, self._centre, self._edges)

    def height_at(self, xy: torch.Tensor) -> torch.Tensor:
        return self._map.height_at(xy - self._middle.to(xy))


class HeightField(_FromFile):
    """A height field from a file, centred on the world's origin: heights at the corners of cells, linear between them.

    Args:
        file: a ``.npy`` file, whose first index is along x and whose second is along y, or a ``.png`` file, read as a
            map (right is x, up is y); relative to an asset folder.
        size: edges along x and y, m.
        height_range: heights of the values 0 and 1 (black and white in an image), m; null reads the values as metres.
    """

    _kinds = (".npy", ".png")

    def __init__(
        self,
        file: PathBelow,
        size: Annotated[Sequence[Positive], Length(2)],
        height_range: Interval | None,
        static_friction: NonNegative,
        dynamic_friction: NonNegative,
        restitution: Share,
        start: Start = ((0.0, 0.0),),
        flat_patches: Mapping[str, FlatPatches] | None = None,
    ) -> None:
        super().__init__(file, start, flat_patches, static_friction, dynamic_friction, restitution)
        self._size = (float(size[0]), float(size[1]))
        self._range = height_range

    def _read(self, file: Path) -> tuple[Array, tuple[float, float], tuple[float, float]]:
        if file.suffix.lower() == ".npy":
            try:
                values = np.load(file, mmap_mode="r", allow_pickle=False)
            except (ValueError, OSError, EOFError) as error:
                message = f"the file '{self.file}' is not a NumPy array"
                raise ConfigError(message, key=_KEY, expected="a .npy file") from error
        else:
            values = self._png(file)
        good = values.ndim == 2 and min(values.shape) >= 2 and values.size <= _LARGEST and values.dtype.kind in "fiub"
        if not good or not np.isfinite(heights := np.array(values, dtype=float)).all():
            message = f"'{self.file}' contains {' x '.join(map(str, values.shape))} values of type {values.dtype}"
            raise ConfigError(message, key=_KEY, expected="two or more rows and columns of finite numbers")
        if self._range is not None:
            low, high = self._range
            heights = low + (high - low) * heights
        return heights, (0.0, 0.0), self._size

    def _png(self, file: Path) -> np.ndarray:
        from matplotlib.image import imread
        from PIL.PngImagePlugin import PngImageFile

        try:
            with PngImageFile(file) as opened:  # does not decode the pixels
                if math.prod(opened.size) > _LARGEST:
                    raise ValueError
            picture = imread(file)
        except Exception as error:  # Matplotlib raises errors of many types for a damaged image file.
            message = f"the file '{self.file}' is not a readable image of at most {_LARGEST:,} pixels"
            raise ConfigError(message, key=_KEY, expected="a .png file") from error
        return (picture if picture.ndim == 2 else picture[..., :3].mean(axis=-1))[::-1].T


class Mesh(_FromFile):
    """Terrain from a mesh in world coordinates; rays from above convert the mesh to a height field.

    A hole gets the height of the mesh's lowest point. Surfaces below an overhang are not part of the ground.

    Args:
        file: a ``.obj`` or ``.stl`` file in the world's axes, relative to an asset folder.
        horizontal_scale: edge of a cell, m.
        scale: length of one unit of the file, m.
    """

    _kinds = (".obj", ".stl")

    def __init__(
        self,
        file: PathBelow,
        horizontal_scale: Positive,
        static_friction: NonNegative,
        dynamic_friction: NonNegative,
        restitution: Share,
        scale: Positive = 1.0,
        start: Start = ((0.0, 0.0),),
        flat_patches: Mapping[str, FlatPatches] | None = None,
    ) -> None:
        super().__init__(file, start, flat_patches, static_friction, dynamic_friction, restitution)
        self._cell, self._scale = horizontal_scale, scale

    def _read(self, file: Path) -> tuple[Array, tuple[float, float], tuple[float, float]]:
        shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL

        def add_to(spec: mujoco.MjSpec) -> None:
            spec.add_mesh(name="mesh", file=str(file), scale=[self._scale] * 3, inertia=shell)
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")

        spec = mujoco.MjSpec()
        add_to(spec)
        try:
            model = spec.compile()
        except ValueError as error:
            reason = " ".join(str(error).split())
            message = f"the file '{self.file}' is not a readable mesh: {reason}"
            raise ConfigError(message, key=_KEY, expected="a mesh") from error
        turned = np.zeros(9)
        mujoco.mju_quat2Mat(turned, model.geom_quat[0])
        corners = model.mesh_vert @ turned.reshape(3, 3).T + model.geom_pos[0]
        low, high = corners.min(axis=0), corners.max(axis=0)
        edges = high[:2] - low[:2]
        counts = [max(1, round(edge / self._cell)) for edge in edges]
        cells = counts[0] * counts[1]
        require_memory(200 * cells, f"{TERRAIN_KEY}.horizontal_scale", f"{cells:,} cells of the ground")
        x, y = (np.linspace(low[i], high[i], counts[i] + 1) for i in range(2))
        points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        # Cast two rays close to each grid point, because one vertical ray can slip between two triangles of the mesh.
        probe, inset = Probe(add_to), 1e-6 * edges
        inner = low[:2] + inset / 3, high[:2] - inset / 3
        near = [(points + side * inset * (0.6, 0.4)).clip(*inner) for side in (-1, 1)]
        found = np.max([probe.height_at(torch.from_numpy(p), outside=float(low[2])).numpy() for p in near], axis=0)
        middle = (low + high) / 2
        return found, (float(middle[0]), float(middle[1])), (float(edges[0]), float(edges[1]))
