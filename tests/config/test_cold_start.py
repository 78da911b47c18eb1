"""Composing starts fast: without torch and MuJoCo, and in well under a second of a processor's time."""

from __future__ import annotations

import resource
import subprocess
import sys

import pytest

from wheelleg_exp.paths import configs_dir

TASKS = sorted(path.stem for path in (configs_dir() / "task").glob("*.yaml"))
HEAVY = ("torch", "mujoco", "rsl_rl", "pxr", "rerun", "tensordict")


def _loaded(*words: str) -> list[str]:
    code = (
        "import contextlib, io, sys\n"
        "from wheelleg_exp.cli.main import main\n"
        "with contextlib.redirect_stdout(io.StringIO()) as out:\n"
        f"    status = main({list(words)!r})\n"
        f"print(status, bool(out.getvalue()), *[name for name in {HEAVY} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("options", [["--resolve", "--json"], ["--provenance"]])
def test_composing_a_stock_task_imports_nothing_heavy(task, options):
    assert _loaded("compose", f"task={task}", *options) == ["0", "True"]


@pytest.mark.parametrize("words", [["list", "options"], ["diff", "stand", "stand"]])
def test_nor_do_the_other_commands_that_only_read_files(words):
    assert _loaded(*words) == ["0", "True"]


@pytest.mark.parametrize("task", TASKS)
def test_composing_takes_less_than_a_second_of_a_processor(task):
    def spent() -> float:
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    words = [sys.executable, "-m", "wheelleg_exp.cli.main", "compose", f"task={task}"]
    times = []
    for _ in range(2):
        before = spent()
        subprocess.run(words, capture_output=True, check=True)
        times.append(spent() - before)
    assert min(times) < 1.0
