"""Connect the processes (ranks) that train one policy together and that torchrun has started.

Each rank simulates its own environments. Ranks exchange small values as JSON and states as checkpoint bytes over gloo,
and gradients on GPUs over NCCL; no message is unpickled. A checkpoint stores networks and optimizer once. Environments,
random streams, episode sums, and hidden states of the first rank are at its top level, and those of all other ranks
below its key ``ranks``.
"""

from __future__ import annotations

import io
import json
import os
import socket
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from wheelleg_exp.errors import EXIT_FAILED, ConfigError, SimulationFailure, WheellegError
from wheelleg_exp.machine import usable_cores
from wheelleg_exp.managers.streams import stream_seed
from wheelleg_exp.rl import checkpoint, digests
from wheelleg_exp.rl.options import Learning
from wheelleg_exp.rl.rollout_log import SCALAR
from wheelleg_exp.sim.options import EnvOptions
from wheelleg_exp.torchrun import number, world_size

_COMMUNICATION = Path(dist.__file__).parent


class FirstRankFailed(WheellegError):
    """The error that all processes (ranks) except the first raise if a training failed; the first reports the reason.

    ``saves_state`` is true if NaN or inf ended the training: the first rank then saves a last checkpoint.
    """

    exit_code = EXIT_FAILED

    def __init__(self, saves_state: bool) -> None:
        super().__init__("the training has failed, and the first process reports the reason")
        self.saves_state = saves_state


class Left(SimulationFailure):
    """Raised on a process (rank) of a training because another rank has stopped."""


@contextmanager
def communicating() -> Iterator[None]:
    """If torch.distributed raised an error in the body, raise ``Left``: another rank has ended."""
    try:
        yield
    except Exception as error:
        if not is_communication(error):
            raise
        raise left() from error


def is_communication(error: BaseException) -> bool:
    """Return whether an exception came from torch.distributed."""
    frames = traceback.extract_tb(error.__traceback__)
    return bool(frames) and Path(frames[-1].filename).is_relative_to(_COMMUNICATION)


def left() -> Left:
    """Return the error to raise if another process (rank) of the training has stopped."""
    message = "another process of the training has ended"
    expected = "all processes to continue; the first one to end reports why, or torchrun's table names the signal"
    return Left(message, key=f"rank {os.environ.get('RANK', '0')}", expected=expected)


# All processes (ranks) wait at most 30 minutes for one rank that converts a robot or compiles kernels.
_PATIENCE = timedelta(minutes=30)


@dataclass(frozen=True)
class Ranks:
    """One of the processes (ranks) that train one policy together. A process that trains alone is rank 0 of 1."""

    rank: int = 0  # number of this process
    size: int = 1  # number of processes
    local: int = 0  # number of this process on its machine
    locals: int = 1  # number of processes on this machine

    @property
    def first(self) -> bool:
        """Whether this process is the first rank, which writes the run directory."""
        return self.rank == 0

    @property
    def together(self) -> bool:
        """Whether there are several ranks."""
        return self.size > 1

    def seed(self, seed: int) -> int:
        """Return the seed of this rank's streams: the run's, or for later ranks that of the stream ``rank/<n>``."""
        return seed if self.first else stream_seed(seed, f"rank/{self.rank}")

    def env(self, options: EnvOptions) -> EnvOptions:
        """Return the environment's options of this process (rank), with its own GPU for ``cuda`` and its CPU cores."""
        if not self.together:
            return options
        sim = replace(options.sim, device=self._device("env.sim.device", options.sim.device))
        return replace(options, sim=replace(sim, nthread=sim.nthread or max(1, usable_cores() // self.locals)))

    def agent(self, options: Learning) -> Learning:
        """Return the agent's options of this process (rank), with its own GPU for ``cuda``."""
        return replace(options, device=self._device("agent.device", options.device)) if self.together else options

    def _device(self, key: str, name: str) -> str:
        kind, _, number = name.partition(":")
        if kind != "cuda":
            return name
        if number not in ("", "0"):
            raise ConfigError(f"all {self.size} processes would share '{name}'", key=key, expected="cuda: one for each")
        if self.local >= torch.cuda.device_count():
            message = f"there are {self.locals} processes on this machine and {torch.cuda.device_count()} GPUs"
            raise ConfigError(message, key=key, expected="as many GPUs as torchrun's --nproc-per-node")
        return f"cuda:{self.local}"

    def facts(self, seed: int, device: str) -> dict[str, object] | None:
        """Return the manifest's entry about the ranks: number, backend, and the seed, device, and host of each."""
        if not self.together:
            return None
        device = self._device("agent.device", device)
        mine = {"seed": self.seed(seed), "device": device, "host": socket.gethostname()}
        each = self.gather_all(mine)
        backend = "nccl" if device.startswith("cuda") else "gloo"
        return {"world_size": self.size, "backend": backend, **{f"{key}s": [one[key] for one in each] for key in mine}}

    def gather_all(self, value: object) -> list[Any]:
        """Send a JSON value to all processes (ranks), and return the values of all ranks in the order of the ranks."""
        return [json.loads(content) for content in self._gathered(json.dumps(value).encode(), everywhere=True) or ()]

    def any(self, flag: bool) -> bool:
        """Return whether ``flag`` is true on at least one process (rank)."""
        if not self.together:
            return flag
        number = torch.tensor([int(flag)])
        with communicating():
            dist.all_reduce(number, op=dist.ReduceOp.MAX)
        return bool(number.item())

    def from_first(self, value: object) -> Any:
        """Send a JSON value from the first process (rank) to all ranks, and return this value on every rank."""
        return self.gather_all(value if self.first else None)[0]

    def gather(self, tree: Mapping[str, object]) -> list[dict[str, Any]]:
        """Send this rank's state to the first rank. Return all ranks' states on the first rank, and [] elsewhere."""
        if not self.together:
            return [dict(tree)]
        found = self._gathered(checkpoint.serialize(tree), everywhere=False)
        return [torch.load(io.BytesIO(content), map_location="cpu", weights_only=True) for content in found]

    def _gathered(self, content: bytes, *, everywhere: bool) -> list[bytes]:
        if not self.together:
            return [content]
        with communicating():
            sizes = [torch.zeros(1, dtype=torch.long) for _ in range(self.size)]
            dist.all_gather(sizes, torch.tensor([len(content)]))
            longest = int(max(sizes))
            mine = torch.zeros(longest, dtype=torch.uint8)
            mine[: len(content)] = torch.frombuffer(bytearray(content), dtype=torch.uint8)
            room = [torch.zeros(longest, dtype=torch.uint8) for _ in sizes] if everywhere or self.first else None
            if everywhere:
                dist.all_gather(room, mine)
            else:
                dist.gather(mine, room)
        return [part[: int(size)].numpy().tobytes() for part, size in zip(room or (), sizes, strict=False)]

    @contextmanager
    def agreed(self) -> Iterator[None]:
        """If a ``with`` block fails on one rank, raise its error on the first rank, and FirstRankFailed elsewhere."""
        if not self.together:
            yield
            return
        mine: WheellegError | None = None
        try:
            yield
        except (Left, FirstRankFailed):
            raise
        except WheellegError as error:
            mine = error
        if self.any(mine is not None):
            own = {}
            if mine is not None:
                own = {name: getattr(mine, name) for name in ("message", "key", "where", "expected", "nearest")}
                own["failed"] = "yes" if mine.exit_code == EXIT_FAILED else None
            received = self.gather({"error": own, "evidence": dict(getattr(mine, "evidence", {}))})
            rank, found = next(((rank, found) for rank, found in enumerate(received) if found["error"]), (0, {}))
            saves_state = self.from_first(bool(found.get("evidence")))
            if not self.first:
                raise FirstRankFailed(saves_state) from mine
            if mine is not None:
                raise mine
            facts = dict(found["error"])
            message, failed = f"{facts.pop('message')} [in process {rank}]", facts.pop("failed")
            if failed:
                raise SimulationFailure(message, evidence=found["evidence"], **facts)
            raise ConfigError(message, **facts)

    def require_equal(self, values: Mapping[str, str]) -> None:
        """Raise ConfigError if the hashes of config files, given by name, differ between processes (ranks)."""
        if not self.together:
            return
        received = self.gather_all(dict(values))
        with self.agreed():
            for rank, other in enumerate(received):
                for name in (name for name in values if other[name] != received[0][name]):
                    message = f"process {rank} has another value than the first process"
                    raise ConfigError(message, key=name, expected="the same files everywhere")

    def merged(self, scalars: Mapping[str, float], times: Sequence[str] = ()) -> dict[str, float]:
        """Merge the scalars of all ranks: means over the ranks that have a key, sums of counts, or the longest time.

        The keys in ``times`` get the longest time. All ranks except the first return their own scalars.
        """
        if not self.together:
            return dict(scalars)
        received = self.gather_all(dict(scalars))
        if not self.first:
            return dict(scalars)
        found = {}
        for key in dict.fromkeys(key for one in received for key in one):
            values = [one[key] for one in received if key in one]
            is_count = key.startswith(SCALAR) or key == "Perf/total_fps"
            found[key] = max(values) if key in times else sum(values) / (1 if is_count else len(values))
        return found


ALONE = Ranks()


@contextmanager
def joined() -> Iterator[Ranks]:
    """Join the processes (ranks) that torchrun started; without torchrun, a training has one process."""
    size = world_size()
    if size <= 1:
        yield ALONE
        return
    missing = [name for name in ("RANK", "LOCAL_RANK", "MASTER_ADDR", "MASTER_PORT") if name not in os.environ]
    if missing:
        message = f"torchrun announces {size} processes, but {missing[0]} is not set"
        expected = "the variables that torchrun sets; or unset it to train with one process"
        raise ConfigError(message, key="WORLD_SIZE", expected=expected)
    ranks = Ranks(number("RANK", 0), size, number("LOCAL_RANK", 0), number("LOCAL_WORLD_SIZE", size))
    gpus = torch.cuda.is_available() and dist.is_nccl_available()
    backend = "cpu:gloo,cuda:nccl" if gpus else "gloo"
    with communicating():
        dist.init_process_group(backend, rank=ranks.rank, world_size=size, timeout=_PATIENCE)
    if gpus and ranks.local < torch.cuda.device_count():
        torch.cuda.set_device(ranks.local)
    yield ranks
    dist.destroy_process_group()  # After an error, `destroy_process_group` would wait for dead ranks.


OWN_KEYS_OF_A_RANK = ("unsaved", "env", "log", "rng")
RANKS_KEY = "ranks"


def state_of_all_ranks(ranks: Ranks, state: Mapping[str, object]) -> dict[str, object]:
    """Return ``state``; on the first rank, add the states of all other ranks under the key ``ranks``."""
    parts = ranks.gather({key: state[key] for key in OWN_KEYS_OF_A_RANK}) if ranks.together else []
    return {**state, RANKS_KEY: parts[1:]} if parts else dict(state)


def state_of_rank(state: Mapping[str, Any], rank: int) -> dict[str, Any]:
    """Extract the state of one process (rank) from the state of all ranks."""
    own = state[RANKS_KEY][rank - 1] if rank else {}
    return {**{key: value for key, value in state.items() if key != RANKS_KEY}, **own}


def digests_of_all(ranks: Ranks, state: Mapping[str, object]) -> tuple[dict[str, str], bool]:
    """Return the digests of all ranks' states, and whether their networks are equal; all ranks must call it."""
    mine = digests.of_state(state)
    if not ranks.together:
        return mine, True
    own = digests.of_state({key: state[key] for key in OWN_KEYS_OF_A_RANK if key in state})
    shared = {name: digest for name, digest in mine.items() if name not in own}
    received = ranks.gather_all({"own": own, "shared": shared})
    equal = all(one["shared"] == received[0]["shared"] for one in received)
    return digests.joined(received[0]["shared"] | received[0]["own"], [one["own"] for one in received[1:]]), equal
