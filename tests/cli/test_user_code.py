import io
import json
import signal
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from jobs.small import TINY, wheelleg

from wheelleg_exp import packages as projects
from wheelleg_exp.cli.main import main

pytestmark = pytest.mark.slow

TOML = '[project]\nname = "pet"\nversion = "0"\n[project.entry-points."wheelleg_exp.packages"]\npet = "pet"\n'
TERM = "pet:\n  _target_: pet.terms.reward\n  weight: 1.0\n"
HEAD = "import torch\nfrom wheelleg_exp.managers import TermBase\n\n\n"
FUNCTION = "def reward(env):\n    {}\n    return torch.ones(env.num_envs)\n"
CLASS = (
    "class reward(TermBase):\n"
    "    def __init__(self, env):\n        self.number('calls', 0)\n        {}\n\n"
    "    def __call__(self, env):\n        self.calls += 1\n        {}\n        return torch.ones(env.num_envs)\n"
)
ENDINGS = {
    "import sys; sys.exit(0)": "SystemExit: 0",
    "raise KeyboardInterrupt": "KeyboardInterrupt",
    "raise GeneratorExit('now')": "GeneratorExit: now",
    "raise type('Odd', (BaseException,), {})('odd')": "Odd: odd",
    "raise MemoryError": "MemoryError",
    "f = lambda: f(); f()": "RecursionError: maximum recursion depth exceeded",
}


@pytest.fixture
def pet(own_folders, tmp_path):
    """Write a project with one term, whose module contains a given text, into the current folder."""
    files = {"pyproject.toml": TOML, "configs/reward/pet.yaml": TERM, "pet/__init__.py": ""}

    def write(text):
        for name, content in {**files, "pet/terms.py": HEAD + text}.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(content)
        return ["+reward@env.rewards=pet"]

    yield write
    projects.forget(tmp_path)


def refused(status, *words):
    said = wheelleg(*words)
    assert (said.status, said.out) == (status, ""), (said.out, said.err)
    (message,) = [line for line in said.err.splitlines() if line.startswith("wheelleg: error: ")]
    return message


@pytest.mark.parametrize("line", list(ENDINGS)[2:])
def test_a_module_that_would_end_the_program_when_it_is_imported_is_named(pet, line):
    words = pet(f"{line}\n" + FUNCTION.format("pass"))
    message = refused(2, "train", *words)
    assert "env.rewards.pet._target_: cannot import 'pet.terms': " in message
    assert ENDINGS[line].split(": ")[0] in message
    assert "runs" not in [path.name for path in Path.cwd().iterdir()]


@pytest.mark.parametrize("command", ["check", "compose", "explain", "zero-agent", "list"])
def test_no_command_is_ended_by_such_a_module(pet, command):
    words = pet("import sys\nsys.exit(0)\n" + FUNCTION.format("pass"))
    if command == "list":
        assert wheelleg("list", "terms").status == 0
    elif command in ("compose", "explain"):
        said = wheelleg(command, *(["env.rewards.pet"] if command == "explain" else []), *words)
        assert said.status == 0, said.err
        assert "pet.terms.reward" in said.out
    else:
        assert "cannot import 'pet.terms': SystemExit: 0 would end the program" in refused(2, command, *words)


def test_a_term_that_would_end_the_program_when_it_is_built_is_named(pet):
    message = refused(2, "train", *TINY, *pet(CLASS.format("import sys; sys.exit(0)", "pass")))
    assert [part for part in ("SystemExit: 0", "env.rewards.pet", "pet/terms.py:") if part not in message] == []


@pytest.mark.train
@pytest.mark.parametrize("line", list(ENDINGS)[:2])
def test_a_term_that_would_end_the_program_while_it_trains_is_named_and_the_run_has_failed(pet, line, tmp_path):
    words = pet(CLASS.format("pass", f"if self.calls > 9: exec({line!r})"))
    message = refused(3, "train", *TINY, "agent.max_iterations=1", "recording.enabled=false", *words)
    expected = (ENDINGS[line], "env.rewards.pet: 'pet.terms.reward' raises ", "pet/terms.py:")
    assert [part for part in expected if part not in message] == []
    (run,) = (tmp_path / "runs" / "stand").iterdir()
    manifest = json.loads((run / "manifest.json").read_text())
    assert (manifest["status"], manifest["error"]["type"]) == ("failed", "SimulationFailure")


def test_a_user_defined_network_that_would_end_the_program_is_named(pet):
    pet("import sys\nsys.exit(0)\n")
    message = refused(2, "check", "agent.actor.class_name=pet.terms:Net")
    assert "agent.actor.class_name: cannot import 'pet.terms.Net': SystemExit: 0 would end the program" in message


def test_a_module_that_replaces_standard_output_does_not_hide_messages(pet):
    words = pet("import io, sys\nsys.stdout = sys.stderr = io.StringIO()\n" + FUNCTION.format("pass"))
    said = wheelleg("check", *words)
    assert (said.status, said.err) == (0, "")
    assert "no mistakes" in said.out


def test_a_module_that_closes_standard_output_is_refused(pet):
    words = pet("import sys\nsys.stdout.close()\n" + FUNCTION.format("pass"))
    err = io.StringIO()
    with redirect_stdout(io.StringIO()), redirect_stderr(err):
        assert main(["check", *words]) == 2
    assert "cannot import 'pet.terms': the import of 'pet.terms' closes the standard stream stdout" in err.getvalue()


@pytest.mark.train
def test_a_module_that_ignores_ctrl_c_does_not_prevent_an_interrupt(pet, tmp_path):
    words = pet(
        "import os, signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        + CLASS.format("pass", "os.kill(os.getpid(), signal.SIGINT) if self.calls == 9 else 0")
    )
    before = signal.getsignal(signal.SIGINT)
    said = wheelleg("train", *TINY, "agent.max_iterations=3", "recording.enabled=false", *words)
    assert said.status == 130, said.err
    assert signal.getsignal(signal.SIGINT) is before
    (run,) = (tmp_path / "runs" / "stand").iterdir()
    assert [path.name for path in run.glob("model_*.pt")] == ["model_0.pt"]


def test_an_exit_inside_a_command_is_a_failure(monkeypatch):
    from wheelleg_exp.cli import list as command

    monkeypatch.setattr(command, "run", lambda args: sys.exit(0))
    assert wheelleg("list").status == 3
