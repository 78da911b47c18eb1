"""Check that memory does not grow during many trainings with recordings in one process.

    python benchmarks/memory.py [--minutes 5] [--every 10] [--limit MB] [--json] [overrides ...]

Small trainings are repeated until the time is over; with ``agent.max_iterations=100000``, the process runs one long
training. Every ``--every`` seconds, the script prints the memory, threads and open files of the process, the memory
allocated by the allocators of C and Python, and the number of Python objects. At the end, the script prints the growth
of memory over the second half, when all caches are full, and the types whose number of objects grew. The exit status is
1 if memory grows by more than ``--limit`` MB per hour.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import json
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from wheelleg_exp.machine import prepare_threads

prepare_threads()

import numpy as np  # noqa: E402  (thread variables come first)

from wheelleg_exp.config.composing.compose import compose  # noqa: E402
from wheelleg_exp.jobs.job_display import Display  # noqa: E402
from wheelleg_exp.jobs.train import prepare_training, run_training  # noqa: E402
from wheelleg_exp.rl.trainer import Iteration  # noqa: E402
from wheelleg_exp.stop_request import StopRequest  # noqa: E402

SMALL = [
    "env.num_envs=32",
    "agent.max_iterations=4",
    "agent.actor.hidden_dims=[32,16]",
    "agent.critic.hidden_dims=[32,16]",
    "recording.interval=2",
    "recording.steps=60",
]


@dataclass(frozen=True)
class Sample:
    """The memory, threads and files of the process at one time.

    Attributes:
        seconds: since the beginning.
        trainings, iterations: done so far.
        own_mb: memory of the process without pages of files, which come and go.
        allocated_mb: what C's allocator has given out, None where it does not say.
        python_blocks: blocks that Python's own allocator has given out.
        threads, files: of the process.
    """

    seconds: float
    trainings: int
    iterations: int
    own_mb: float
    allocated_mb: float | None
    python_blocks: int
    threads: int
    files: int


@dataclass
class Watch(Display):
    """A display of trainings that takes a memory sample at a fixed interval."""

    every: float
    until: float
    stop: StopRequest
    is_quiet: bool
    samples: list[Sample] = field(default_factory=list)
    trainings: int = 0
    iterations: int = 0
    _began: float = field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        """The time since the start of the measurement, s."""
        return time.monotonic() - self._began

    def iteration(self, iteration: Iteration, total: int) -> None:
        """Count an iteration, take a sample if one is due, and stop the training when the time is over."""
        del iteration, total
        self.iterations += 1
        if self.seconds >= self.every * (len(self.samples) + 1):
            self.take()
        if self.seconds >= self.until:
            self.stop.requested = True

    def take(self) -> None:
        """Take a sample."""
        found = Sample(
            round(self.seconds, 1),
            self.trainings,
            self.iterations,
            _own_memory(),
            _allocated(),
            sys.getallocatedblocks(),
            sum(1 for _ in Path("/proc/self/task").iterdir()),
            sum(1 for _ in Path("/proc/self/fd").iterdir()),
        )
        self.samples.append(found)
        if not self.is_quiet:
            print("  ".join("-" if value is None else f"{value:>12}" for value in asdict(found).values()), flush=True)


def _own_memory() -> float:
    """Return the memory that only this process uses, MB."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("RssAnon:"))
    return round(int(line.split()[1]) * 1024 / 1e6, 1)


class _Mallinfo(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd")]
    _fields_ += [(name, ctypes.c_size_t) for name in ("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")]


def _allocated() -> float | None:
    """Return the memory allocated by glibc, MB."""
    try:
        ask = ctypes.CDLL(None).mallinfo2
    except AttributeError:
        return None
    ask.restype = _Mallinfo
    found = ask()
    return round(float(found.uordblks + found.hblkhd) / 1e6, 1)


def objects() -> Counter[str]:
    """Return the number of Python objects of each type."""
    gc.collect()
    return Counter(f"{type(o).__module__}.{type(o).__qualname__}" for o in gc.get_objects())


def measure(overrides: list[str], minutes: float, every: float, *, is_quiet: bool) -> dict[str, Any]:
    """Train in a temporary folder until the time is over, and return the samples."""
    settled: Counter[str] | None = None
    with tempfile.TemporaryDirectory() as root, StopRequest() as stop:
        watch = Watch(every, 60.0 * minutes, stop, is_quiet)
        while watch.seconds < watch.until:
            composed = compose(["task=stand", *SMALL, *overrides, f"run.root={root}", f"seed={watch.trainings}"])
            try:
                run_training.run(prepare_training.prepare(composed, ["benchmark"], watch), watch, stop)
            except KeyboardInterrupt:
                break
            watch.trainings += 1
            if settled is None and watch.seconds > watch.until / 3:
                settled = objects()
    more = objects() - (settled if settled is not None else objects())
    return {
        "samples": [asdict(sample) for sample in watch.samples],
        "mb_per_hour": slope(watch.samples, lambda s: s.seconds) * 3600.0,
        "mb_per_100_iterations": slope(watch.samples, lambda s: s.iterations) * 100.0,
        "objects": dict(more.most_common(15)),
    }


def slope(samples: list[Sample], of: Any) -> float:
    """Return the growth of memory over the second half of the samples, MB."""
    later = samples[len(samples) // 2 :]
    if len(later) < 2:
        return 0.0
    return float(np.polyfit([of(s) for s in later], [s.own_mb for s in later], 1)[0])


def main() -> int:
    """Print the results, and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--every", type=float, default=10.0, metavar="S")
    parser.add_argument("--limit", type=float, metavar="MB")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("overrides", nargs="*")
    words = parser.parse_args()
    if not words.json:
        print("  ".join(f"{name:>12}" for name in Sample.__dataclass_fields__))
    found = measure(words.overrides, words.minutes, words.every, is_quiet=words.json)
    if words.json:
        print(json.dumps(found))
    else:
        print(f"{found['mb_per_hour']:+.1f} MB an hour, {found['mb_per_100_iterations']:+.2f} MB in 100 iterations")
        for name, count in found["objects"].items():
            print(f"{count:+8d}  {name}")
    return int(words.limit is not None and found["mb_per_hour"] > words.limit)


if __name__ == "__main__":
    sys.exit(main())
