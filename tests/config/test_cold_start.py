"""Count the bytecodes and the imports of a fresh Python process that composes a config."""

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

HEAVY = {"torch", "mujoco", "rsl_rl", "pxr", "rerun", "tensordict"}

COMMANDS = [["compose", "task=terrain", *words] for words in (["--resolve", "--json"], ["--provenance"])]
COMMANDS += [["list", "options"], ["diff", "stand", "stand"]]
# One process runs all commands, because modules stay imported.
CODE = f"""
import contextlib, io, sys
from wheelleg_exp.cli.main import main
import wheelleg_exp.config.checking.find_mistakes, wheelleg_exp.config.explaining.catalog

for words in {COMMANDS!r}:
    with contextlib.redirect_stdout(io.StringIO()) as out:
        status = main(words)
    heavy = sorted({HEAVY!r} & sys.modules.keys())
    if status != 0 or not out.getvalue() or heavy:
        sys.exit(f"{{words}}: {{status}}, {{heavy}}")
"""


def test_commands_that_only_read_files_and_the_checks_import_nothing_heavy():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


EFFORT = """
import contextlib, io, sys
from effort import bytecodes

def start():
    import hydra, omegaconf

def compose():
    from wheelleg_exp.cli.main import main
    with contextlib.redirect_stdout(io.StringIO()):
        assert main(sys.argv[2:]) == 0

print(bytecodes({"start": start, "compose": compose}[sys.argv[1]]))
"""


def effort_of(*words: str) -> int:
    surroundings = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", EFFORT, *words]
    said = subprocess.run(command, env=surroundings, capture_output=True, text=True, check=True)
    return int(said.stdout)


def test_composing_takes_little_more_than_starting_hydra():
    assert effort_of("compose", "compose", "task=terrain") < 7.0 * effort_of("start")
