"""Sweeps that tests share: one real one, and a stand-in for the program that trains a job."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from forks import forking

from jobs.small import SMALL, Words, cache_of, succeed
from wheelleg_exp.jobs.run_sweep import LocalLauncher, SweepRunner
from wheelleg_exp.jobs.training_job import JobRequest
from wheelleg_exp.run.run_index import SweepIndex
from wheelleg_exp.stop_request import StopRequest

SEEDS = (0, 1)

# The only override of a job chooses the action of the stand-in program.
STAND_IN = """
import json, os, signal, sys, time

signal.signal(signal.SIGTERM, signal.default_int_handler)
request = json.loads(sys.stdin.buffer.raw.readline())
(what,) = request["overrides"]

def tell(event, **facts):
    print(json.dumps({"event": event, **facts}), flush=True)

def wait_for_the_end():
    while os.read(0, 1):
        pass

tell("run", path=os.path.join(os.getcwd(), "runs", "stand", what))
if what.startswith("finish"):
    time.sleep(0.1)
    tell("iteration", done=1, total=1, scalars={"Train/mean_reward": float("nan")})
    tell("ended", status="finished", error=None)
elif what == "fail":
    tell("ended", status="failed", error={"type": "SimulationFailure", "message": "gone to NaN"})
    sys.exit(3)
elif what == "die":
    sys.stderr.write("the last words")
    sys.exit(7)
elif what == "leave":
    print('{"event": "iterat', end="", flush=True)
    os._exit(0)
elif what == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
elif what == "talk":
    sys.stderr.write("something\\n" * 20000)
    for _ in range(2000):
        tell("note", text="x" * 100)
    tell("ended", status="finished", error=None)
elif what == "wait":
    wait_for_the_end()
    tell("ended", status="interrupted", error=None)
    sys.exit(130)
elif what == "deaf":
    try:
        tell("iteration", done=1, total=9, scalars={})
        time.sleep(600)
    except KeyboardInterrupt:
        tell("ended", status="interrupted", error=None)
elif what == "stubborn":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    tell("iteration", done=1, total=9, scalars={})
    time.sleep(600)
"""


@dataclass
class Seen:
    """A sweep display that records its calls."""

    told: list[tuple[Any, ...]] = field(default_factory=list)
    on_start: Any = None
    on_iteration: Any = None

    def started(self, job):
        self.told.append(("started", job["number"]))
        if self.on_start is not None:
            self.on_start(job)

    def iteration(self, job, done, total, scalars):
        self.told.append(("iteration", job["number"], done, total))
        if self.on_iteration is not None:
            self.on_iteration(job)

    def ended(self, job):
        self.told.append(("ended", job["number"], job["status"]))

    def note(self, job, text, *, once=True):
        self.told.append(("note", job["number"], text))

    def most_at_once(self) -> int:
        running = most = 0
        for told in self.told:
            running += {"started": 1, "ended": -1}.get(told[0], 0)
            most = max(most, running)
        return most


def stand_in(whats: list[str], stop: StopRequest, at_once: int = 1, seen: Seen | None = None) -> SweepRunner:
    """Return a sweep below the working folder whose jobs only pretend to train."""
    jobs = [([what], [what]) for what in whats]
    index = SweepIndex.create("runs", command=["wheelleg"], launcher={"name": "basic", "at_once": at_once}, jobs=jobs)
    requests = [JobRequest("train", [what], [], ["wheelleg", "train", what], "") for what in whats]
    launcher = LocalLauncher((sys.executable, "-S", "-c", STAND_IN))
    return SweepRunner(index, requests, at_once, seen or Seen(), stop, launcher)


@dataclass(frozen=True)
class Swept:
    """A real sweep and the output of its command."""

    folder: Path
    index: SweepIndex
    said: Words

    @property
    def root(self) -> Path:
        return self.folder.parent.parent


_swept: dict[Path, Swept] = {}


def swept_once(factory: pytest.TempPathFactory) -> Swept:
    base = factory.getbasetemp()
    if base not in _swept:
        folder = factory.mktemp("swept")
        with pytest.MonkeyPatch.context() as patch, forking():
            patch.chdir(folder)
            patch.setenv("WHEELLEG_CACHE", str(cache_of(factory)))
            seeds = "seed=" + ",".join(map(str, SEEDS))
            launcher = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
            said = succeed("train", "-m", seeds, *SMALL, "run.name=small", *launcher)
        (index,) = (folder / "runs" / "sweeps").iterdir()
        _swept[base] = Swept(index, SweepIndex.load(index), said)
    return _swept[base]
