"""Measure a training iteration with 1 and 2 threads of torch and of the physics, on an idle and a busy computer.

    python benchmarks/threads.py [--envs 512] [--iterations 3] [--rounds 2] [--busy 2]

Every case is a training in a separate process, because the environment variables must be set before torch is imported.
The cases are interleaved, so that other load on the computer affects all cases equally. The script prints the median
wall-clock time and CPU time of one iteration, s, without the first iteration of each training.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

SPIN = "while True: pass"


@dataclass(frozen=True)
class Case:
    """Threads of torch and of the physics (0: all), and how OpenMP's idle threads wait.

    ``stock`` is the default of wheelleg_exp: threads wait actively for a while and then sleep. An empty text is
    OpenMP's default.
    """

    torch: int
    physics: int
    wait: str = "stock"


CASES = [Case(1, 1), Case(1, 0), Case(2, 1), Case(2, 0), Case(2, 0, "PASSIVE"), Case(2, 0, ""), Case(2, 0, "ACTIVE")]


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """Keep a number of CPU cores busy inside the ``with`` block."""
    running = [subprocess.Popen([sys.executable, "-c", SPIN]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def measure(case: Case, envs: int, iterations: int) -> dict[str, float]:
    """Train and return the seconds of one iteration: collection, update, both, and CPU time of both."""
    environ = {k: v for k, v in os.environ.items() if k not in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")}
    command = [sys.executable, "-m", "wheelleg_exp.cli.main", "train", "task=stand", "recording.enabled=false"]
    command += [f"env.num_envs={envs}", f"agent.max_iterations={iterations + 1}", "agent.save_interval=1000000"]
    command += [f"agent.torch_threads={case.torch}", f"env.sim.nthread={case.physics}"]
    if case.wait != "stock":
        environ["OMP_WAIT_POLICY"] = case.wait  # An empty value only stops wheelleg_exp from setting one.
    with tempfile.TemporaryDirectory() as folder:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*command, f"run.root={folder}"], env=environ, check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        lines = next(Path(folder).glob("stand/*/iterations.jsonl")).read_text().splitlines()
    scalars = [json.loads(line)["scalars"] for line in lines][1:]
    collection = statistics.median(s["Perf/collection_time"] for s in scalars)
    update = statistics.median(s["Perf/learning_time"] for s in scalars)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"collection": collection, "update": update, "iteration": collection + update, "cpu in all": cpu}


def main() -> None:
    """Measure all cases and print a table of the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", type=int, default=512)
    parser.add_argument("--iterations", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--busy", type=int, default=2, help="spinning processes of the busy machine")
    args = parser.parse_args()
    found: dict[tuple[int, Case], list[dict[str, float]]] = defaultdict(list)
    for _ in range(args.rounds):
        for load in dict.fromkeys((0, args.busy)):
            for case in CASES:
                with busy(load):
                    run = measure(case, args.envs, args.iterations)
                found[load, case].append(run)
                print(f"load {load}, {case}: {run['iteration']:.2f} s an iteration", file=sys.stderr, flush=True)
    names = ["collection", "update", "iteration", "cpu in all"]
    print(f"{'load':>4} {'torch':>5} {'physics':>7} {'wait':>8}  " + "  ".join(f"{name:>10}" for name in names))
    for (load, case), runs in found.items():
        medians = (statistics.median(run[name] for run in runs) for name in names)
        wait = case.wait or "default"
        print(f"{load:>4} {case.torch:>5} {case.physics:>7} {wait:>8}  " + "  ".join(f"{m:>10.2f}" for m in medians))


if __name__ == "__main__":
    main()
