"""The cache of generated grounds; the key is a hash of the layout and of the code that generates grounds."""

from __future__ import annotations

import functools
import hashlib
import inspect
import io
import json
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.files import write_bytes
from wheelleg_exp.paths import cache_dir
from wheelleg_exp.sim.terrain.height_map import Tile
from wheelleg_exp.sim.terrain.relief import Layout, Relief, make_relief

_PATCHES = "patches/"


def cached_relief(layout: Layout) -> Relief:
    """Return a ground from the cache, or generate it and store it.

    Raises:
        ConfigError: the ground cannot be generated.
    """
    entry = cache_dir() / "terrains" / f"{relief_key(layout)}.npz"
    with suppress(OSError, ValueError, KeyError, zipfile.BadZipFile):
        return _read(entry.read_bytes())
    relief = make_relief(layout)
    with suppress(WheellegError):  # without a cache entry the ground is generated again next time
        write_bytes(entry, _packed(relief))
    return relief


def relief_key(layout: Layout) -> str:
    """Return the sha256 of a layout and of the code that generates a ground."""
    own = [_digest(Path(inspect.getfile(part))) for part in (make_relief, Tile)]
    parts = {"layout": _plain(layout), "code": own, "numpy": np.__version__}
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def _plain(value: Any) -> Any:
    """Return a value as JSON; an object becomes its values, its class, and the hashes of its classes' source files."""
    if isinstance(value, Mapping):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if not hasattr(value, "__dict__"):
        return value
    kinds = [kind for kind in type(value).__mro__ if kind is not object]
    code = [_digest(Path(inspect.getfile(kind))) for kind in kinds]
    return {"class": type(value).__qualname__, "code": code, "values": _plain(vars(value))}


@functools.cache
def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _packed(relief: Relief) -> bytes:
    buffer = io.BytesIO()
    patches: dict[str, Any] = {_PATCHES + name: places for name, places in relief.patches.items()}
    np.savez(
        buffer,
        heights=np.concatenate([tile.heights.ravel() for tile in relief.tiles]),
        shapes=np.array([tile.heights.shape for tile in relief.tiles]),
        boxes=np.array([tile.boxes for tile in relief.tiles]),
        kinds=relief.kinds,
        difficulties=relief.difficulties,
        origins=relief.origins,
        **patches,
    )
    return buffer.getvalue()


def _read(packed: bytes) -> Relief:
    with np.load(io.BytesIO(packed), allow_pickle=False) as held:
        shapes = held["shapes"]
        parts = np.split(held["heights"], np.cumsum(shapes.prod(axis=1))[:-1])
        tiles = [
            Tile(part.reshape(shape), bool(boxes))
            for part, shape, boxes in zip(parts, shapes, held["boxes"], strict=True)
        ]
        patches = {name.removeprefix(_PATCHES): held[name] for name in held.files if name.startswith(_PATCHES)}
        return Relief(tiles, held["kinds"], held["difficulties"], held["origins"], patches)
