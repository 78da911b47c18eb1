"""Proofs that a training repeats bit for bit.

Each proof trains small runs in new processes and returns the unequal values.
"""

import json
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
import yaml

from repro.runs import ITERATIONS, Lab, Refused, differences, only_run
from wheelleg_exp.config.composing.compose import compose

# With AMX, only float32 products do not depend on the number of threads.
SAME = ["agent.matmul=float32"] if torch.cpu._is_amx_tile_supported() else []


def two_processes(lab: Lab) -> list[str]:
    return differences(lab.once(), lab.train(PYTHONHASHSEED="12345"))


def settings(lab: Lab) -> list[str]:
    other = ["agent.torch_threads=1", "env.sim.nthread=3", "recording.enabled=false", "agent.logger=null"]
    return differences(lab.once(*SAME), lab.train(*SAME, *other, PYTHONHASHSEED="12345"))


def torch_threads(lab: Lab) -> list[str]:
    return differences(lab.once(*SAME), lab.once(*SAME, "agent.torch_threads=1"))


def physics_threads(lab: Lab) -> list[str]:
    return differences(lab.once("env.sim.nthread=1"), lab.once("env.sim.nthread=3"))


def recording(lab: Lab) -> list[str]:
    return differences(lab.once(), lab.once("recording.enabled=false"))


def tensorboard(lab: Lab) -> list[str]:
    return differences(lab.once(), lab.once("agent.logger=null"))


def added_term(lab: Lab, target: str = "planted.terms.own_draw") -> list[str]:
    """Add a term that draws random numbers; the policy and the physics must not change."""
    term = ["+event@env.events=idle", f"env.events.idle._target_={target}"]
    with_term = Lab(lab.folder, [*lab.planted, *term], lab.environ)
    plain, added = lab.once(), with_term.train()
    return [
        f"model_{i}.pt: {key}"
        for i in range(ITERATIONS)
        for key in _unequal_tensors(plain / f"model_{i}.pt", added / f"model_{i}.pt")
    ]


def _unequal_tensors(a: Path, b: Path) -> Iterator[str]:
    one, other = (torch.load(path, weights_only=True) for path in (a, b))
    for part in ("actor_state_dict", "critic_state_dict"):
        for key, value in one[part].items():
            if not torch.equal(value, other[part][key]):
                yield f"{part}.{key}"
    if not torch.equal(one["env"]["scene"]["sim"]["state"], other["env"]["scene"]["sim"]["state"]):
        yield "physics"


def splits(lab: Lab, every: Sequence[Sequence[int]] = ([1, 2, 3],)) -> list[str]:
    straight, found = lab.once(), []
    for stops in every:
        run = lab.train(f"agent.max_iterations={stops[0]}")
        for stop in [*stops[1:], ITERATIONS]:
            lab.resume(run, f"agent.max_iterations={stop}")
        found += [f"stopped after {stops}: {what}" for what in differences(straight, run)]
    return found


def killed(lab: Lab, lines: Sequence[int] = (1, 3), seed: int = 0, longest_s: float = 0.2) -> list[str]:
    """Kill a run repeatedly with SIGKILL, resume it to the end, and compare it with an uninterrupted run.

    Each kill comes at most ``longest_s`` after the log has the next number of ``lines``.
    """
    straight = lab.once()
    root = lab.folder / f"runs_killed_{seed}"
    moments = random.Random(seed)
    kill(lab, lab.words(root), root, lines[0], moments.uniform(0.0, longest_s))
    run = only_run(root)
    for count in lines[1:]:
        kill(lab, lab.resume_words(run), root, count, moments.uniform(0.0, longest_s))
    lab.resume(run)
    resumes = json.loads((run / "manifest.json").read_text())["resumes"]
    told = [] if len(resumes) == len(lines) else [f"{len(resumes)} resumes"]
    return told + differences(straight, run)


def kill(lab: Lab, words: list[str | Path], root: Path, lines: int, delay_s: float) -> None:
    began = time.time()
    process = subprocess.Popen(
        lab.command(*words), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=lab.variables()
    )
    while process.poll() is None:
        found = [path for path in root.glob("*/*/iterations.jsonl") if path.stat().st_mtime >= began]
        if any(path.read_bytes().count(b"\n") >= lines for path in found):
            break
        time.sleep(0.002)
    time.sleep(delay_s)
    process.send_signal(signal.SIGKILL)
    if process.wait() != -signal.SIGKILL:
        raise Refused(f"the command ended with {process.returncode} before it could be killed")


def replay(lab: Lab) -> list[str]:
    run = copy_of(lab.once(), lab.folder / "replayed")
    answer = lab.wheelleg("replay", run, "--root", run.parents[1], "--json", statuses=(0, 1))
    if answer.status:
        return [answer.out[-2000:] or answer.err[-2000:]]
    return differences(run, only_run(run.parents[1] / "replays"))


def snapshot(lab: Lab) -> list[str]:
    return snapshot_differences(lab.once())


def snapshot_differences(run: Path) -> list[str]:
    composed = compose(yaml.safe_load((run / ".hydra/overrides.yaml").read_text())).config
    kept = yaml.safe_load((run / ".hydra/config.yaml").read_text())
    parts = {part: yaml.safe_load((run / "params" / f"{part}.yaml").read_text()) for part in ("env", "agent")}
    found = [f"params: {key}" for key in _unequal_leaves({p: composed[p] for p in parts}, parts)]
    resolved = {key: value for key, value in kept.items() if "${" not in str(value)}
    return found + [f"config: {key}" for key in _unequal_leaves({k: composed[k] for k in resolved}, resolved)]


def _unequal_leaves(a: object, b: object, path: str = "") -> list[str]:
    if isinstance(a, dict) and isinstance(b, dict) and list(a) == list(b):
        return [leaf for key in a for leaf in _unequal_leaves(a[key], b[key], f"{path}.{key}".lstrip("."))]
    return [] if a == b else [path]


def flipped_byte(lab: Lab) -> list[str]:
    """Return the files of a run in which ``verify`` does not find a changed bit."""
    run = copy_of(lab.once(), lab.folder / "flipped")
    assert lab.inside("verify", run).status == 0
    names = sorted(path.relative_to(run).as_posix() for path in run.rglob("*") if path.is_file())
    listed = [name for name in names if not name.startswith(".lock") and not name.startswith(".manifest")]
    return [name for name in listed if not notices(lab, run, name)]


def notices(lab: Lab, run: Path, name: str) -> bool:
    """Return whether ``verify`` finds and names a flipped bit in the middle of one file. The file is restored."""
    path = run / name
    whole = path.read_bytes()
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :] if whole else b"x")
    answer = lab.inside("verify", run)
    path.write_bytes(whole)
    return answer.status in (1, 2) and name in answer.out + answer.err


def copy_of(run: Path, root: Path) -> Path:
    target = root / run.parent.name / run.name
    shutil.copytree(run, target)
    return target
