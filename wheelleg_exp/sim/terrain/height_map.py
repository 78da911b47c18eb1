"""The height map: the heights of all tiles in one tensor, and interpolation at a point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch


@dataclass(frozen=True)
class Tile:
    """Heights of one tile; the first index is along x, the second along y.

    Attributes:
        heights: heights of the corners of cells (nx + 1, ny + 1), or of the cells (nx, ny), m.
        boxes: whether heights belong to cells, with vertical edges.
    """

    heights: npt.NDArray[np.float32]
    boxes: bool

    @property
    def cells(self) -> tuple[int, int]:
        """The number of cells along x and y."""
        nx, ny = self.heights.shape
        return (nx, ny) if self.boxes else (nx - 1, ny - 1)


class HeightMap:
    """Tiles in rows along x and columns along y, centred on the world's origin.

    Between corners the surface is that of MuJoCo's height fields: two triangles per cell, which meet on the diagonal
    from the cell's lowest to its highest x and y.

    Args:
        tiles: the tiles row by row.
        rows: number of rows.
        size: edges of a tile, m.
        device: device of the tensors.
    """

    def __init__(self, tiles: Sequence[Tile], rows: int, size: Sequence[float], device: torch.device) -> None:
        flat = np.concatenate([tile.heights.ravel() for tile in tiles])
        starts = np.cumsum([0, *(tile.heights.size for tile in tiles[:-1])])
        self._heights = torch.as_tensor(flat, device=device)
        self._starts = torch.as_tensor(starts, device=device)
        self._cells = torch.tensor([tile.cells for tile in tiles], device=device)
        self._slanted = torch.tensor([not tile.boxes for tile in tiles], device=device).long()
        self._counts = torch.tensor([rows, len(tiles) // rows], device=device)
        self._size = torch.tensor(list(size), device=device)

    def height_at(self, xy: torch.Tensor) -> torch.Tensor:
        """Return the heights (...) at points (..., 2), m; 0 outside of the tiles."""
        place = xy / self._size.to(xy) + self._counts / 2
        tile = place.floor()
        inside = ((place >= 0) & (place <= self._counts)).all(dim=-1)
        tile = tile.clamp(min=0).minimum(self._counts - 1)
        number = tile[..., 0].long() * self._counts[1] + tile[..., 1].long()
        cells = self._cells[number]
        within = (place - tile) * cells
        cell = within.floor().clamp(min=0).minimum(cells - 1)
        u, v = (within - cell).clamp(0, 1).unbind(dim=-1)
        slanted = self._slanted[number]
        along_x = cells[..., 1] + slanted  # stride between neighbours along x
        first = self._starts[number] + cell[..., 0].long() * along_x + cell[..., 1].long()
        a, b = self._heights[first], self._heights[first + slanted * along_x]
        c, d = self._heights[first + slanted], self._heights[first + slanted * (along_x + 1)]
        height = a + torch.where(u >= v, (b - a) * u + (d - b) * v, (c - a) * v + (d - c) * u)
        return torch.where(inside, height, 0.0).to(xy.dtype)
