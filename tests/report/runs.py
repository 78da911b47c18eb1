import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.files import write_json, write_text, write_yaml
from wheelleg_exp.packages import trust
from wheelleg_exp.run.file_inventory import inventory
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.timestamps import parse_utc

STARTED = parse_utc("2026-03-01T10:00:00.000000Z")
ENDED = parse_utc("2026-03-01T10:02:30.000000Z")
FIGURES = {
    **{"checkpoint": "model_2.pt", "seed": 1, "overrides": [], "episodes": 8, "unfinished": 0, "survival": 0.75},
    **{"settle_s": 1.0, "settled_episodes": 7, "settled_steps": 1500, "height_rmse_m": 0.0021, "height_mean_m": 0.072},
    **{"pitch_rms_deg": 1.1, "pitch_mean_deg": 0.9, "mean_return": 24.6},
    "ended_by": {"time_out": 6, "base_contact": 2},
}
# Weighted rewards per second; the sum of their absolute values over the last iterations is 6.
REWARDS = {"alive": [1.0, 3.0, 5.0], "base_height": [-3.0, -2.0, -1.0]}


def iteration(index: int) -> dict[str, Any]:
    scalars = {f"Episode_Reward/{name}": values[min(index, 2)] for name, values in REWARDS.items()}
    scalars |= {"Train/mean_reward": float(index), "Train/mean_episode_length": 20.0 * (index + 1)}
    scalars |= {"Episode_Termination/time_out": 0.4 * index, "Episode_Termination/base_contact": 1 - 0.4 * index}
    scalars |= {"Loss/value": 1.0 / (index + 1), "Policy/mean_std": 1.0}
    return {"iteration": index, "digests": {"parameters": f"{index:016x}"}, "scalars": scalars}


def make_run(
    root: Path,
    overrides: list[str] | None = None,
    *,
    iterations: int = 3,
    status: str = "finished",
    error: BaseException | None = None,
    name: str | None = None,
    config_dirs: tuple[Path, ...] = (),
    results: Mapping[str, Any] | None = None,
) -> RunDirectory:
    trust(config_dirs)  # A training with these folders registers them.
    composed = compose(["task=stand", *(overrides or [])], config_dirs=config_dirs)
    run = RunDirectory.create(root, "stand", 0, name, STARTED)
    for part in ("env", "agent"):
        write_yaml(run.params / f"{part}.yaml", composed.config[part])
    for file, text in composed.hydra_files().items():
        write_text(run.hydra / file, text)
    write_json(run.source / "git.json", {"format": 1, "status": "ok", "commit": "c" * 40, "dirty": False, "others": []})
    write_json(run.asset / "report.json", {"source": "robot.usda", "totals": {"bodies": 3, "mass": 0.5}})
    write_text(run.environment, "numpy==2\n")
    command = ["wheelleg", "train", "task=stand", *(overrides or [])]
    manifest = Manifest.begin(run.path, task="stand", seed=0, command=command, threads={"torch": 1}, now=STARTED)
    lines = "".join(json.dumps(iteration(i)) + "\n" for i in range(iterations))
    write_text(run.iterations, lines)
    manifest.record(source={"status": "ok", "commit": "c" * 40}, files=inventory(run.path))
    if status != "running":
        told = {"iterations": iterations, "seconds": 150.0, **(results or {})}
        manifest.finish(status, told, error, now=ENDED)  # type: ignore[arg-type]
    return run


def add_play(run: RunDirectory, **changes: Any) -> None:
    run.manifest().add("play", [], {**FIGURES, **changes}, command=["wheelleg", "play"])


def change_manifest(run: RunDirectory, **changes: Any) -> None:
    path = run.path / "manifest.json"
    write_json(path, {**json.loads(path.read_text()), **changes})
