from __future__ import annotations

import os
import signal
import subprocess
import sys
import types
from collections.abc import Callable
from typing import Any

import pytest

from wheelleg_exp import __version__
from wheelleg_exp.cli import main as script
from wheelleg_exp.cli.arguments import add_overrides
from wheelleg_exp.cli.main import Command, main
from wheelleg_exp.errors import ConfigError, SimulationFailure
from wheelleg_exp.machine import VARIABLES, prepare_threads
from wheelleg_exp.stop_request import StopRequest


@pytest.fixture
def probe(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Callable[..., None]]:
    def install(run: Any, configure: Callable[..., None] = add_overrides) -> None:
        def raise_error(args):
            raise run

        module = types.ModuleType("wheelleg_exp.cli.probe")
        module.run, module.configure = raise_error if isinstance(run, BaseException) else run, configure
        monkeypatch.setitem(sys.modules, "wheelleg_exp.cli.probe", module)
        monkeypatch.setitem(script.COMMANDS, "probe", Command("probe", "look at the arguments"))

    return install


@pytest.fixture(autouse=True)
def _environment_restored(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in VARIABLES:
        monkeypatch.setenv(name, os.environ.get(name, "kept"))


def test_options_can_be_before_between_and_after_overrides(probe):
    seen = []
    probe(lambda args: seen.append(args) or len(seen))
    words = ["probe", "--config-dir", "a", "task=stand", "--config-dir", "b", "~env.events.push", "agent.x=-3"]
    assert main(words) == 1
    assert main(["probe"]) == 2  # ``main`` returns the status of the command, and two calls share no lists.
    assert [args.overrides for args in seen] == [["task=stand", "~env.events.push", "agent.x=-3"], []]
    assert [[str(d) for d in args.config_dirs] for args in seen] == [["a", "b"], []]


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (ConfigError("wrong", key="a.b"), 2, "error: a.b: wrong"),
        (SimulationFailure("gone"), 3, "error: gone"),
        (OSError("full"), 3, "error: "),
        (BrokenPipeError("the viewer is gone"), 3, "the viewer is gone"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_an_error_is_one_message_and_its_status(probe, capsys, error, status, message):
    probe(error)
    assert main(["probe"]) == status
    captured = capsys.readouterr()
    assert captured.err.startswith("wheelleg: ")
    assert message in captured.err
    assert (len(captured.err.splitlines()), captured.out) == (1, "")


@pytest.mark.parametrize("words", [["--debug", "probe"], ["probe", "--debug"]])
def test_debug_shows_the_traceback(probe, capsys, words):
    probe(ConfigError("wrong"))
    assert main(words) == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_end_is_an_interrupt_and_the_old_handler_comes_back(probe, number):
    before = signal.getsignal(number)
    cleaned = []

    def run(args):
        try:
            os.kill(os.getpid(), number)
            signal.pause()
        finally:
            cleaned.append(True)
        return 0

    probe(run)
    assert main(["probe"]) == 130
    assert cleaned == [True]
    assert signal.getsignal(number) is before


@pytest.fixture(params=[signal.SIGHUP, signal.SIGINT], ids=["nohup", "background"])
def ignored(request):
    before = signal.signal(request.param, signal.SIG_IGN)
    yield request.param
    signal.signal(request.param, before)


def test_a_signal_that_the_shell_ignores_stays_ignored(probe, ignored):
    def run(args):
        with StopRequest() as stop:
            os.kill(os.getpid(), ignored)
            stop.check()
            os.kill(os.getpid(), signal.SIGTERM)
            assert stop.requested
        os.kill(os.getpid(), ignored)
        return 0

    probe(run)
    assert main(["probe"]) == 0
    assert signal.getsignal(ignored) is signal.SIG_IGN


def test_two_hang_ups_still_allow_a_job_to_finish_its_step(probe):
    def run(args):
        with StopRequest() as stop:
            for _ in range(2):
                os.kill(os.getpid(), signal.SIGHUP)
            assert stop.requested
        return 0

    probe(run)
    assert main(["probe"]) == 0


@pytest.mark.parametrize(("stream", "pair"), [("stdout", os.pipe), ("stderr", os.pipe), ("stderr", os.openpty)])
def test_a_reader_or_terminal_that_goes_away_does_not_change_the_status(probe, monkeypatch, stream, pair):
    reader, writer = pair()
    os.close(reader)

    def run(args):
        for text in ("something", "more"):
            print(text, file=getattr(sys, stream), flush=True)
        return 1

    probe(run)
    with os.fdopen(writer, "w") as closed:
        monkeypatch.setattr(sys, stream, closed)
        assert main(["probe"]) == 1


def test_signs_that_a_stream_cannot_show_become_question_marks(probe, monkeypatch, tmp_path):
    probe(lambda args: sys.stdout.write("lean 1.2 °/s, torque 3 N·m\n") and 0)
    with (tmp_path / "out").open("w", encoding="ascii") as out:
        monkeypatch.setattr(sys, "stdout", out)
        assert main(["probe"]) == 0
    assert (tmp_path / "out").read_text() == "lean 1.2 ?/s, torque 3 N?m\n"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["trian"], "did you mean 'train'?"),
        ([], "expected one of train, resume, play"),
        (["probe", "--confg-dir", "x"], "--confg-dir: unknown option"),
        (["probe", "--config-dirs=x"], "did you mean '--config-dir'?"),
        (["probe", "--config-dir"], "expected one argument"),
    ],
)
def test_a_wrong_command_line_is_refused_with_the_nearest_name(probe, capsys, words, told):
    probe(lambda args: 0)
    assert main(words) == 2
    assert told in capsys.readouterr().err


def test_version_and_help(capsys, probe):
    probe(lambda args: 0)
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"wheelleg {__version__}\n"
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert [name for name, command in script.COMMANDS.items() if name not in text or not command.help] == []
    assert main(["probe", "--help"]) == 0
    assert "--config-dir" in capsys.readouterr().out


def test_a_reader_that_goes_away_is_not_an_error():
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    reader, writer = os.pipe()
    os.close(reader)
    try:
        command = [sys.executable, "-m", "wheelleg_exp", "--help"]
        done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, env=environment)
    finally:
        os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


def test_only_the_chosen_command_is_imported_and_it_stays_light():
    code = (
        "import sys; from wheelleg_exp.cli.main import main; main(['list', '--help']);"
        "loaded = {m for m in sys.modules if m.startswith('wheelleg_exp.cli.')};"
        "print(sorted(loaded), 'torch' in sys.modules, 'mujoco' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = [f"wheelleg_exp.cli.{name}" for name in ("arguments", "list", "main")]
    loaded += [f"wheelleg_exp.cli.printing{name}" for name in ("", ".terminal")]
    assert done.stdout.splitlines()[-1] == f"{loaded} False False"


def test_thread_variables_are_set_unless_they_are_set_already(monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    monkeypatch.delenv("GOMP_SPINCOUNT", raising=False)
    monkeypatch.setenv("MKL_CBWR", "SSE4_2")
    monkeypatch.setitem(sys.modules, "torch", None)
    assert not prepare_threads()
    assert (os.environ["MKL_CBWR"], os.environ["OMP_WAIT_POLICY"]) == ("SSE4_2", "PASSIVE")
    assert os.environ["GOMP_SPINCOUNT"].isdigit()
    assert prepare_threads()
    # If the user sets OpenMP's wait policy, the program does not set the spin time.
    monkeypatch.delenv("GOMP_SPINCOUNT")
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    assert prepare_threads()
    assert (os.environ["OMP_WAIT_POLICY"], os.environ.get("GOMP_SPINCOUNT")) == ("ACTIVE", None)


@pytest.mark.parametrize(("module", "freed"), [("nanobind", "freed\n"), ("another", "")])
def test_objects_that_nanobind_would_report_as_leaks_are_freed_at_exit(module, freed):
    code = f"""
import os, sys
from wheelleg_exp.cli.main import main

class Leaky(metaclass=type("nb_meta", (type,), {{"__module__": {module!r}}})):
    def __del__(self):
        os.write(1, b"freed\\n")

one = Leaky()
one.cycle = sys.modules["cycle"] = [one]  # Only a garbage collection frees the object.
sys.argv = ["wheelleg", "--version"]
sys.exit(main())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == f"wheelleg {__version__}\n{freed}"
