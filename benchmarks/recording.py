"""Measure how much time, memory and disk space the recording of a training costs.

    python benchmarks/recording.py [--num-envs 512] [--iterations 200] [--small] [--json] [overrides ...]

Two trainings with one seed alternate every few iterations in one process, so that other load affects both equally. Only
one of the trainings is recorded. Each training has a separate state of torch's random generator, and the script checks
that both trainings end with equal weights. ``--small`` takes a minute and uses small networks and few environments, so
the recording's share of the time is far larger than in a real training; compare the milliseconds instead.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from wheelleg_exp.machine import prepare_threads
from wheelleg_exp.rl.options import read_agent

prepare_threads()

import numpy as np  # noqa: E402  (thread variables come first)
import torch  # noqa: E402

from wheelleg_exp.build import build_env  # noqa: E402
from wheelleg_exp.config.composing.compose import compose  # noqa: E402
from wheelleg_exp.config.schema import RecordingOptions  # noqa: E402
from wheelleg_exp.jobs.train.training_recording import TrainingRecording  # noqa: E402
from wheelleg_exp.rl.trainer import Iteration, Trainer  # noqa: E402
from wheelleg_exp.rl.vec_env import RslRlVecEnv  # noqa: E402
from wheelleg_exp.run.run_directory import RunDirectory  # noqa: E402

BLOCK = 5  # The number of iterations in a block.
SMALL = ["agent.actor.hidden_dims=[64,64]", "agent.critic.hidden_dims=[64,64]", "recording.interval=20"]
SMALL += ["recording.steps=120"]
_PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass
class Side:
    """One of the two trainings.

    Attributes:
        trainer: the training.
        iterations: its iterations.
        random: the state of torch's generator where it stopped.
        seconds: elapsed time and processor time of each block.
    """

    trainer: Trainer
    iterations: Iterator[Iteration]
    random: torch.Tensor
    seconds: list[tuple[float, float]] = field(default_factory=list)


class Inside:
    """The CPU time spent in the recording code, which other load on the computer hardly affects."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self, do: Callable[..., None], *arguments: Any) -> None:
        """Call a function and add its CPU time to the sum."""
        start = time.process_time()
        do(*arguments)
        self.seconds += time.process_time() - start


def side(config: dict[str, Any], roots: Any) -> Side:
    """Build one of the two trainings."""
    trainer = Trainer(RslRlVecEnv(build_env(config, roots)), read_agent(config["agent"]), config["seed"])
    return Side(trainer, trainer.learn(until=10**9), torch.get_rng_state())


def block(of: Side, recording: TrainingRecording | None, count: int, inside: Inside) -> None:
    """Train for a few iterations and store the time, including the time of the recording."""
    torch.set_rng_state(of.random)
    elapsed, busy = time.perf_counter(), time.process_time()
    for _ in range(count):
        iteration = next(of.iterations)
        if recording is not None:
            inside(recording.write, iteration.scalars, iteration.index)
            if iteration.index % 50 == 0:
                inside(recording.flush)  # as at a checkpoint
    of.seconds.append((time.perf_counter() - elapsed, time.process_time() - busy))
    of.random = torch.get_rng_state()


def resident() -> float:
    """Return the memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE / 1e6


def same(one: Trainer, two: Trainer) -> bool:
    """Return whether the two trainings have equal weights, bit for bit."""
    pairs = zip(one.algorithm.actor.parameters(), two.algorithm.actor.parameters(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


def measure(config: dict[str, Any], roots: Any, iterations: int) -> dict[str, Any]:
    """Run both trainings in a temporary folder, and return the results."""
    on, off = side(config, roots), side(config, roots)
    memory, inside, env = [], Inside(), on.trainer.env.env
    with tempfile.TemporaryDirectory() as root:
        directory = RunDirectory.create(root, config["task"]["name"], 0)
        options = RecordingOptions(**config["recording"])
        with TrainingRecording(directory, env, options, {}) as recording:
            capture = env.observers.pop()
            env.observers.append(lambda: inside(capture))
            for number in range(iterations // BLOCK):
                turns = [(on, recording), (off, None)]
                for of, recorded in turns if number % 2 else reversed(turns):
                    block(of, recorded, BLOCK, inside)
                memory.append(resident())
            env.observers[:] = [capture]
        size = directory.recording.stat().st_size / 1e6
    found = {**_figures(on, off, iterations), **_memory(memory), "file_mb": size}
    spent, whole = inside.seconds, sum(busy for _, busy in off.seconds)
    found |= {"inside_ms": spent / iterations * 1e3, "inside_share": spent / whole}
    return {**found, "same": same(on.trainer, off.trainer)}


def _figures(on: Side, off: Side, iterations: int) -> dict[str, float]:
    with_recording, without = (np.array(s.seconds) for s in (on, off))
    extra = (with_recording - without).sum(axis=0) / iterations * 1e3
    ratio = with_recording.sum(axis=0) / without.sum(axis=0)
    # Ignore blocks without motion, which are cheaper; the remaining spread is noise of the computer.
    return {
        "iteration_ms": float(without[:, 0].sum() / iterations * 1e3),
        "extra_ms": float(extra[0]),
        "extra_processor_ms": float(extra[1]),
        "ratio": float(ratio[0]),
        "processor_ratio": float(ratio[1]),
        "noise_ms": float((with_recording - without)[:, 0].std() / np.sqrt(len(without)) / BLOCK * 1e3),
    }


def _memory(megabytes: list[float]) -> dict[str, float]:
    """Return the growth of memory over the second half of the samples, when all caches are full."""
    later = megabytes[len(megabytes) // 2 :]
    slope = np.polyfit(np.arange(len(later)) * BLOCK, later, 1)[0] if len(later) > 1 else 0.0
    return {"memory_mb": megabytes[-1], "memory_mb_per_100_iterations": float(slope * 100)}


def main() -> None:
    """Print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num-envs", type=int)
    parser.add_argument("--iterations", type=int)
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("overrides", nargs="*")
    words = parser.parse_args()
    iterations = words.iterations or (40 if words.small else 200)
    envs = words.num_envs or (32 if words.small else 512)
    overrides = [f"env.num_envs={envs}", *(SMALL if words.small else []), *words.overrides]
    composed = compose(["task=stand", *overrides])
    torch.set_num_threads(int(composed.config["agent"]["torch_threads"]))
    found = measure(composed.config, composed.asset_roots, iterations)
    if words.json:
        print(json.dumps(found))
        return
    print(f"{envs} environments, {iterations} iterations each of {found['iteration_ms']:.0f} ms")
    print(
        f"recording adds  {found['extra_ms']:.1f} ms ± {found['noise_ms']:.1f} an iteration: {found['ratio'] - 1:.2%}"
    )
    print(f"processor time  {found['extra_processor_ms']:.1f} ms an iteration: {found['processor_ratio'] - 1:.2%}")
    print(f"of that inside  {found['inside_ms']:.1f} ms an iteration: {found['inside_share']:.2%}")
    slope = found["memory_mb_per_100_iterations"]
    print(f"memory          {found['memory_mb']:.0f} MB, {slope:+.1f} MB in 100 iterations (of both trainings)")
    print(f"file            {found['file_mb']:.1f} MB")
    print(f"same weights    {'yes, to the bit' if found['same'] else 'NO'}")


if __name__ == "__main__":
    main()
