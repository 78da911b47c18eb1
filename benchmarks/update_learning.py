"""Whether the update learns as well in bfloat16 as in float32: learning curves of both from the same seeds.

    python benchmarks/update_learning.py [--task stand] [--seeds 5] [--out FOLDER] [key=value ...]

Trains one run after the other; one that is there already is taken as it is, so that a stopped comparison goes on. Then
writes ``curves.csv`` (by iteration, for each scalar and kind the mean over seeds and the standard deviation) and prints
the last tenth of the iterations: means over seeds, deviations between them, and Welch's t of the difference, which
beyond about 2.3 with 5 seeds each is more than chance.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import statistics
import subprocess
import sys
from pathlib import Path

SCALARS = ("Train/mean_reward", "Train/mean_episode_length", "Loss/value", "Loss/learning_rate", "Policy/mean_std")
TIMES = ("Perf/collection_time", "Perf/learning_time")
KINDS = ("float32", "bfloat16")


def trained(folder: Path, task: str, kind: str, seed: int, overrides: list[str]) -> list[dict[str, float]]:
    """Train, unless it is done already, and return the scalars of each iteration."""
    name = f"{kind}_{seed}"
    done = [path for path in folder.glob(f"{task}/*_{name}/iterations.jsonl") if _is_finished(path.parent)]
    if not done:
        command = [sys.executable, "-m", "wheelleg_exp.cli.main", "train", f"task={task}", f"seed={seed}"]
        command += [f"agent.matmul={kind}", f"run.root={folder}", f"run.name={name}", "recording.enabled=false"]
        print(f"training {name}", file=sys.stderr, flush=True)
        ended = subprocess.run([*command, *overrides], capture_output=True, text=True, check=False)
        if ended.returncode:
            sys.exit(ended.stderr)
        done = list(folder.glob(f"{task}/*_{name}/iterations.jsonl"))
    return [json.loads(line)["scalars"] for line in done[-1].read_text().splitlines()]


def _is_finished(run: Path) -> bool:
    manifest = run / "manifest.json"
    return manifest.is_file() and json.loads(manifest.read_text()).get("status") == "finished"


def spread(values: list[float]) -> tuple[float, float]:
    """Return mean and standard deviation of the values that are numbers."""
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return math.nan, math.nan
    return statistics.fmean(finite), statistics.stdev(finite) if len(finite) > 1 else 0.0


def write_curves(path: Path, runs: dict[str, list[list[dict[str, float]]]]) -> None:
    """Write mean and deviation over seeds, one line an iteration."""
    length = min(len(run) for kind in runs.values() for run in kind)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        columns = [(scalar, kind) for scalar in SCALARS for kind in KINDS]
        writer.writerow(["iteration", *(f"{s} {k} {what}" for s, k in columns for what in ("mean", "std"))])
        for index in range(length):
            cells = (spread([run[index].get(s, math.nan) for run in runs[k]]) for s, k in columns)
            writer.writerow([index, *(f"{value:.6g}" for pair in cells for value in pair)])


def main() -> None:
    """Train both kinds with each seed and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="stand")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/update_learning"))
    parser.add_argument("overrides", nargs="*", help="key=value of the config")
    args = parser.parse_args()
    folder = args.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    runs: dict[str, list[list[dict[str, float]]]] = {kind: [] for kind in KINDS}
    for seed in range(args.seeds):
        for kind in KINDS:  # in turn, so that a load which comes and goes meets both
            runs[kind].append(trained(folder, args.task, kind, seed, args.overrides))
    write_curves(folder / "curves.csv", runs)
    print(f"{args.task}, {args.seeds} seeds, load {os.getloadavg()[0]:.1f}; curves in {folder / 'curves.csv'}")
    for scalar in (*SCALARS, *TIMES):
        ends = {}
        for kind in KINDS:
            last = [run[-max(1, len(run) // 10) :] for run in runs[kind]]
            ends[kind] = spread([spread([line.get(scalar, math.nan) for line in run])[0] for run in last])
        (a, da), (b, db) = (ends[kind] for kind in KINDS)
        error = math.hypot(da, db) / math.sqrt(args.seeds)
        told = f"t {(b - a) / error:+.2f}" if error > 0 else ""
        print(f"{scalar:28} float32 {a:9.4g} ± {da:8.2g}   bfloat16 {b:9.4g} ± {db:8.2g}   {told}")


if __name__ == "__main__":
    main()
