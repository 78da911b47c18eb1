"""Small trainings by the command line, and the comparison of two runs."""

import hashlib
import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jobs.small import Words
from patience import PATIENCE_S

from wheelleg_exp.cli.main import main
from wheelleg_exp.recording.reading.recording_digest import entity_digests

PROJECT = Path(__file__).parent / "planted_project"
ITERATIONS = 4
SMALL = ["task=stand", "env.num_envs=32", "env.episode_length_s=0.5", f"agent.max_iterations={ITERATIONS}"]
SMALL += ["agent.save_interval=1", "agent.warm_start=1", "recording.interval=2", "recording.steps=30"]


class Refused(Exception):
    """A command-line call failed or ended before the test could kill it."""


@dataclass
class Lab:
    """A folder for trainings that all have the same ``planted`` overrides, in addition to the overrides ``base``.

    ``environ`` contains environment variables of every command, in addition to the present ones.
    """

    folder: Path
    planted: Sequence[str] = ()
    environ: Mapping[str, str] = field(default_factory=dict)
    base: Sequence[str] = tuple(SMALL)
    _runs: dict[tuple[str, ...], Path] = field(default_factory=dict)

    def command(self, *words: str | Path) -> list[str]:
        return [sys.executable, "-m", "wheelleg_exp.cli.main", *map(str, words)]

    def variables(self, **more: str) -> dict[str, str]:
        return {**os.environ, **self.environ, **more}

    def wheelleg(self, *words: str | Path, statuses: Sequence[int] = (0,), **variables: str) -> Words:
        done = subprocess.run(
            self.command(*words), capture_output=True, text=True, timeout=PATIENCE_S, env=self.variables(**variables)
        )
        if done.returncode not in statuses:
            raise Refused(f"{' '.join(map(str, words))}: exit {done.returncode}\n{done.stderr[-2000:]}")
        return Words(done.returncode, done.stdout, done.stderr)

    def inside(self, *words: str | Path) -> Words:
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err):
            status = main([str(word) for word in words])
        return Words(status, out.getvalue(), err.getvalue())

    def words(self, root: Path, *overrides: str) -> list[str | Path]:
        return ["train", *self.base, *self.planted, *overrides, f"run.root={root}", *self.project]

    def train(self, *overrides: str, **variables: str) -> Path:
        root = self.folder / f"runs_{len(list(self.folder.glob('runs_*')))}"
        self.wheelleg(*self.words(root, *overrides), **variables)
        return only_run(root)

    def once(self, *overrides: str) -> Path:
        """Return the run of some overrides, which is trained at the first call. Nobody changes this run."""
        if overrides not in self._runs:
            self._runs[overrides] = self.train(*overrides)
        return self._runs[overrides]

    def take(self, run: Path) -> None:
        self._runs[()] = run

    def resume(self, run: Path, *overrides: str) -> None:
        self.wheelleg(*self.resume_words(run, *overrides))

    def resume_words(self, run: Path, *overrides: str) -> list[str | Path]:
        return ["resume", run, *overrides, *self.project]

    @property
    def project(self) -> list[str | Path]:
        return ["--config-dir", PROJECT / "configs"] if self.planted else []


def only_run(root: Path) -> Path:
    (run,) = (path for path in root.glob("*/*") if path.is_dir() and not path.name.startswith("."))
    return run


def differences(a: Path, b: Path, *, exported: bool = True) -> list[str]:
    """Return the unequal parts of two runs: checkpoints, exported policies, iterations, recordings.

    Bytes are compared by sha256, and recordings by their content, without the program's own ``verify``.
    """
    patterns = ["model_*.pt", *(["exported/*.onnx", "exported/*.json"] if exported else [])]
    found = [name for pattern in patterns for name in _unequal_files(a, b, pattern)]
    found += _unequal_iterations(_lines(a), _lines(b))
    if (a / "recording.rrd").is_file() and (b / "recording.rrd").is_file():
        one, other = (entity_digests(run / "recording.rrd") for run in (a, b))
        compared = {e for e in one.keys() | other.keys() if not e.startswith("training/Perf/")}
        found += [f"recording: {e}" for e in sorted(compared) if one.get(e) != other.get(e)]
    return found


def _unequal_files(a: Path, b: Path, pattern: str) -> list[str]:
    names = sorted({path.relative_to(run).as_posix() for run in (a, b) for path in run.glob(pattern)})
    return [name for name in names if _sha256(a / name) != _sha256(b / name)]


def _sha256(path: Path) -> str | None:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def _lines(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "iterations.jsonl").read_text().splitlines()]


def _unequal_iterations(a: list[dict[str, Any]], b: list[dict[str, Any]]) -> Iterator[str]:
    numbers = [[line["iteration"] for line in lines] for lines in (a, b)]
    if numbers[0] != numbers[1]:
        yield f"iterations: {numbers[0]} and {numbers[1]}"
        return
    for one, other in zip(a, b, strict=True):
        for part in ("digests", "scalars"):
            for key in sorted(one[part].keys() | other[part].keys()):
                if not key.startswith("Perf/") and one[part].get(key) != other[part].get(key):
                    yield f"iteration {one['iteration']}: {part}.{key}"
