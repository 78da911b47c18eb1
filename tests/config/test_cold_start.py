"""Composing starts fast: without torch and MuJoCo, and in little more time than Hydra itself."""

from __future__ import annotations

import resource
import subprocess
import sys

import pytest

from wheelleg_exp.paths import configs_dir

TASKS = sorted(path.stem for path in (configs_dir() / "task").glob("*.yaml"))
HEAVY = {"torch", "mujoco", "rsl_rl", "pxr", "rerun", "tensordict"}

COMMANDS = [
    *(
        ["compose", f"task={task}", *options]
        for task in TASKS
        for options in (["--resolve", "--json"], ["--provenance"])
    ),
    ["list", "options"],
    ["diff", "stand", "stand"],
]
# One process carries out all of them: what any imports stays.
CODE = f"""
import contextlib, io, sys
from wheelleg_exp.cli.main import main

for words in {COMMANDS!r}:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        status = main(words)
    heavy = sorted({HEAVY!r} & sys.modules.keys())
    if status != 0 or not out.getvalue() or heavy:
        sys.exit(f"{{words}}: {{status}}, {{heavy}}")
"""


def test_commands_that_only_read_files_import_nothing_heavy():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("task", TASKS)
def test_composing_takes_little_more_than_starting_hydra(task):
    """In processor time, side by side: it was 2.5 to 4.2 times; loading torch alone took 13 times."""

    def spent(*words: str) -> float:
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        before = usage.ru_utime + usage.ru_stime
        subprocess.run([sys.executable, *words], capture_output=True, check=True)
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime - before

    starting, composing = ("-c", "import hydra, omegaconf"), ("-m", "wheelleg_exp.cli.main", "compose", f"task={task}")
    assert any(spent(*composing) < 5.0 * spent(*starting) for _ in range(3))  # more tries on a machine that is busy
