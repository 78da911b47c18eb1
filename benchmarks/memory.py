"""Whether memory stays flat: trainings with recordings, one after the other in one process.

    python benchmarks/memory.py [--minutes 5] [--every 10] [--limit MB] [--json] [overrides ...]

Small trainings are repeated until the time is over; ``agent.max_iterations=100000`` makes it one long training. Every
``--every`` seconds a line says how much memory, how many threads and open files the process has, how much of the memory
C's allocator and Python's hold, and how many objects of Python there are. At the end stand the slope over the second
half, when caches and pools are as large as they become, and the kinds of objects that became more. The exit status is 1
when the slope, over an hour, is more than ``--limit`` MB.
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
    """What the process has at a moment.

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
    """Takes a sample every so many seconds; a display for the trainings."""

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
        """The time since the beginning, s."""
        return time.monotonic() - self._began

    def iteration(self, iteration: Iteration, total: int) -> None:
        """Count an iteration, sample when it is time, and stop the training when the time is over."""
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
    """Return the memory that is of this process alone, MB."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("RssAnon:"))
    return round(int(line.split()[1]) * 1024 / 1e6, 1)


class _Mallinfo(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd")]
    _fields_ += [(name, ctypes.c_size_t) for name in ("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")]


def _allocated() -> float | None:
    """Return what glibc's allocator has given out, MB."""
    try:
        ask = ctypes.CDLL(None).mallinfo2
    except AttributeError:
        return None
    ask.restype = _Mallinfo
    found = ask()
    return round((found.uordblks + found.hblkhd) / 1e6, 1)


def objects() -> Counter[str]:
    """Return how many objects there are of each kind."""
    gc.collect()
    return Counter(f"{type(o).__module__}.{type(o).__qualname__}" for o in gc.get_objects())


def measure(overrides: list[str], minutes: float, every: float, *, is_quiet: bool) -> dict[str, Any]:
    """Train until the time is over, in a temporary folder, and return what was found."""
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
    """Print what was found, and return the exit status."""
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
