"""Give each term its own random stream, so that adding a term does not change the random numbers of other terms."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch

from wheelleg_exp.state import NamedStream


def stream_seed(seed: int, path: str) -> int:
    """Return the 63-bit seed of the stream ``path``: the first bytes of SHA-256 over ``seed`` and ``path``."""
    return int.from_bytes(hashlib.sha256(f"{seed}/{path}".encode()).digest()[:8], "little") & (2**63 - 1)


class Streams:
    """The random streams of one environment, made from the seed of the run."""

    def __init__(self, seed: int, device: torch.device | str = "cpu") -> None:
        self._seed = seed
        self._device = device
        self._generators: dict[str, NamedStream] = {}

    def get(self, path: str) -> torch.Generator:
        """Return the random generator of the stream with the name ``path``, such as the config key of a term."""
        if path not in self._generators:
            self._generators[path] = NamedStream(self._device)
            self._generators[path].manual_seed(stream_seed(self._seed, path))
        return self._generators[path]

    def all(self) -> list[torch.Generator]:
        """Return the random generators of all streams that have been used so far."""
        return list(self._generators.values())

    def reseed(self, seed: int) -> None:
        """Restart every stream from ``seed``."""
        self._seed = seed
        for path, generator in self._generators.items():
            generator.manual_seed(stream_seed(seed, path))

    def state_dict(self) -> dict[str, object]:
        """Return the seed and the state of each random generator, which a checkpoint saves."""
        generators = {path: generator.get_state() for path, generator in sorted(self._generators.items())}
        return {"seed": self._seed, "generators": generators}

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore the seed and the state of each random generator from a checkpoint."""
        self.reseed(saved["seed"])  # Streams that are missing in the checkpoint start from its seed.
        for path, state in saved["generators"].items():
            self.get(path).set_state(state)


@contextmanager
def lent(generator: torch.Generator | None) -> Iterator[None]:
    """Make torch's global generator draw from the random stream ``generator`` inside a ``with`` block."""
    if generator is None:
        yield
        return
    device = torch.cuda if generator.device.type == "cuda" else torch
    outer = device.get_rng_state()
    device.set_rng_state(generator.get_state())
    try:
        yield
    finally:
        generator.set_state(device.get_rng_state())
        device.set_rng_state(outer)
