"""Compare learning in bfloat16 and in float32 by the learning curves of trainings with equal seeds.

    python benchmarks/update_learning.py [--task stand] [--seeds 5] [--out FOLDER] [key=value ...]

The script trains one run after the other. An existing finished run is reused, so a stopped comparison can be continued.
Then the script writes ``curves.csv``: for each iteration, scalar and number format, the mean and the standard deviation
over the seeds. For the last tenth of the iterations, the script prints means, standard deviations, and Welch's t of the
difference. With 5 seeds each, an absolute t above about 2.3 is more than chance.
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
    """Train a run unless a finished run exists, and return the scalars of each iteration."""
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
    """Return the mean and standard deviation of the finite values."""
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return math.nan, math.nan
    return statistics.fmean(finite), statistics.stdev(finite) if len(finite) > 1 else 0.0


def write_curves(path: Path, runs: dict[str, list[list[dict[str, float]]]]) -> None:
    """Write the mean and standard deviation over the seeds, one line for each iteration."""
    length = min(len(run) for kind in runs.values() for run in kind)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        columns = [(scalar, kind) for scalar in SCALARS for kind in KINDS]
        writer.writerow(["iteration", *(f"{s} {k} {what}" for s, k in columns for what in ("mean", "std"))])
        for index in range(length):
            cells = (spread([run[index].get(s, math.nan) for run in runs[k]]) for s, k in columns)
            writer.writerow([index, *(f"{value:.6g}" for pair in cells for value in pair)])


def main() -> None:
    """Train with both number formats and each seed, and compare the results."""
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
        for kind in KINDS:  # Alternate, so that other load affects both formats equally.
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
