"""Measure the throughput and learning of one, two and four processes, each with its own GPU, that train one policy.

    python benchmarks/multi_gpu.py [--processes 1 2 4] [--num-envs 4096] [--seeds 0] [--iterations 60] [--json FILE]
        [--device cuda] [overrides ...]

For N processes and each seed, the script runs two trainings. In the training ``wide``, each process has ``--num-envs``
environments. In the training ``split``, all processes together have ``--num-envs`` environments, and the policy must
learn like a policy of one process. The trainings run under ``python -m torch.distributed.run`` in a temporary folder.
The script prints the environment steps per second (median over the second half of the iterations), the iteration in
which the mean episode length first passes 90 % of the longest, and the mean return and length of the last tenth. For a
trial without a GPU, use ``--device cpu --num-envs 16 --iterations 4``.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

from wheelleg_exp.config.composing.compose import compose

_LONG = 0.9  # fraction of the longest episode
_COLUMNS = (
    "kind",
    "processes",
    "environments",
    "seed",
    "steps/s",
    "collect s",
    "update s",
    "learned at",
    "return",
    "length",
)


def train(processes: int, overrides: Sequence[str], root: Path) -> tuple[list[dict[str, Any]], float]:
    """Train once; return the scalars of each iteration, and the total time, s."""
    module = ["-m", "wheelleg_exp.cli.main", "train", *overrides, f"run.root={root}"]
    together = (
        ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)] if processes > 1 else []
    )
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *together, *module], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    if done.returncode:
        raise SystemExit(f"{processes} processes: {done.stdout[-4000:]}")
    (log,) = root.glob("*/*/iterations.jsonl")
    return [json.loads(line)["scalars"] for line in log.read_text().splitlines()], time.perf_counter() - start


def summary(scalars: Sequence[dict[str, Any]], longest: float) -> dict[str, Any]:
    """Return one table row with the results of one training."""
    later, last = scalars[len(scalars) // 2 :], scalars[-max(1, len(scalars) // 10) :]
    lengths = [float(line.get("Train/mean_episode_length", 0.0)) for line in scalars]
    return {
        "steps/s": median(float(line["Perf/total_fps"]) for line in later),
        "collect s": median(float(line["Perf/collection_time"]) for line in later),
        "update s": median(float(line["Perf/learning_time"]) for line in later),
        "learned at": next((index for index, length in enumerate(lengths) if length > _LONG * longest), None),
        "return": mean(float(line.get("Train/mean_reward", 0.0)) for line in last),
        "length": mean(float(line.get("Train/mean_episode_length", 0.0)) for line in last),
    }


def main() -> None:
    """Run all trainings, and print or write the table of results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--num-envs", type=int, default=4096, help="of one process, of the training that is wide")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--kinds", nargs="+", default=["wide", "split"], choices=["wide", "split"])
    parser.add_argument(
        "--device", default="cuda", help="of the networks; of the environments with env.sim.device=cuda:0"
    )
    parser.add_argument("--json", type=Path)
    parser.add_argument("overrides", nargs="*")
    args = parser.parse_args()
    fixed = [
        f"agent.device={args.device}",
        f"agent.max_iterations={args.iterations}",
        f"agent.save_interval={args.iterations}",
        "recording.enabled=false",
        *args.overrides,
    ]
    env = compose(fixed).config["env"]
    longest = env["episode_length_s"] / (env["sim"]["dt"] * env["decimation"])
    rows: list[dict[str, Any]] = []
    print(platform.node(), " ".join(args.overrides))
    print("  ".join(f"{name:>12}" for name in _COLUMNS), flush=True)
    for seed in args.seeds:
        for processes in args.processes:
            for kind in args.kinds if processes > 1 else ["wide"]:
                each = args.num_envs if kind == "wide" else args.num_envs // processes
                with tempfile.TemporaryDirectory(prefix="wheelleg-multi-gpu-") as folder:
                    words = [*fixed, f"env.num_envs={each}", f"seed={seed}"]
                    scalars, seconds = train(processes, words, Path(folder))
                facts = {"kind": kind, "processes": processes, "environments": each * processes, "seed": seed}
                rows.append({**facts, **summary(scalars, longest), "seconds": seconds})
                print("  ".join(f"{_text(rows[-1][name]):>12}" for name in _COLUMNS), flush=True)
                if args.json:
                    args.json.write_text(json.dumps({"overrides": fixed, "runs": rows}, indent=1))


def _text(value: Any) -> str:
    return (
        f"{value:,.3f}"
        if isinstance(value, float) and value < 1000
        else f"{value:,.0f}"
        if isinstance(value, float)
        else str(value)
    )


if __name__ == "__main__":
    main()
