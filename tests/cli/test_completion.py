from __future__ import annotations

import os
import pty
import select
import shlex
import signal
import subprocess
import sys
import termios
import time

import pytest
from patience import PATIENCE_S

from wheelleg_exp.cli import completion
from wheelleg_exp.cli.main import COMMANDS, main
from wheelleg_exp.paths import configs_dir

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("shared_cache")]


OFFERED = {
    "wheelleg com": ["compose", "completion"],
    "wheelleg --v": ["--version"],
    "wheelleg compose --p": ["--primary", "--package", "--provenance"],
    "wheelleg compose --primary ": ["evaluate", "pipeline", "play", "train"],
    "wheelleg compose --package env.sim.s": ["env.sim.solver"],
    "wheelleg train tas": ["task=", "task."],
    "wheelleg train robot=p": ["robot=physical", "robot=physical_motor"],
    "wheelleg train pipeline=": [f"pipeline={name}" for name in ("first_drive", "get_up", "jump", "stand_to_terrain")],
    "wheelleg train reward@env.rewards=[al": ["reward@env.rewards=[alive"],
    "wheelleg train reward@env.rewards=[alive,a": [
        "reward@env.rewards=[alive,action_acceleration",
        "reward@env.rewards=[alive,action_rate", "reward@env.rewards=[alive,ang_vel_xy",
    ],
    "wheelleg train env.rewards.al": ["env.rewards.alive."],
    "wheelleg train env.rewards.alive.": ["env.rewards.alive._target_=", "env.rewards.alive.weight="],
    "wheelleg train env.robot.base=f": ["env.robot.base=floating", "env.robot.base=fixed"],
    "wheelleg train recording.enabled=": ["recording.enabled=true", "recording.enabled=false"],
    "wheelleg train env.rewards.alive=": ["env.rewards.alive=null"],
    "wheelleg train ~env.events.pu": ["~env.events.push_robot", "~env.events.push_robot."],
    "wheelleg train 'env.decim": ["env.decimation="],
    "wheelleg train termination@env.terminations=[time_out] env.terminations.": ["env.terminations.time_out."],
    "wheelleg explain env.sim.d": ["env.sim.device", "env.sim.dt", "env.sim.deterministic"],
    "wheelleg list r": ["runs"],
    "wheelleg explain pipeline.phases.st": ["pipeline.phases.stand", "pipeline.phases.stand."],
    "wheelleg list options ro": ["robot"],
    "wheelleg play lat": ["latest"],
    "wheelleg diff sta": ["stand"],
    "wheelleg nothing ": [],
    "wheelleg train robot=nothing": [],
}  # fmt: skip


@pytest.mark.parametrize("line", OFFERED)
def test_a_line_is_completed(line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert completion.answer(line) == OFFERED[line]


def test_every_command_and_every_option_of_a_group_is_offered():
    assert completion.answer("wheelleg ") == list(COMMANDS)
    rewards = sorted(path.stem for path in (configs_dir() / "reward").glob("*.yaml"))
    offered = completion.answer("wheelleg train reward@env.rewards=[")
    assert offered == [f"reward@env.rewards=[{name}" for name in rewards]


@pytest.mark.parametrize("command", COMMANDS)
def test_options_of_every_command_are_offered(command):
    assert "--help" in completion.answer(f"wheelleg {command} --")


def test_only_resume_offers_pipelines(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("2026-11-20_b", "2026-11-19_a"):
        (folder := tmp_path / "runs" / "pipelines" / name).mkdir(parents=True)
        (folder / "pipeline.json").write_text("{}")
    assert completion.answer("wheelleg resume 2026") == ["2026-11-19_a", "2026-11-20_b"]
    assert completion.answer("wheelleg play 2026") == []


def test_a_changed_file_is_seen(tmp_path):
    assert completion.answer(f"wheelleg train --config-dir {tmp_path} robot=mi") == []
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "mine.yaml").write_text("# @package env.robot\n")
    assert completion.answer(f"wheelleg train --config-dir {tmp_path} robot=mi") == ["robot=mine"]


def test_files_are_offered_where_a_file_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "some").mkdir()
    (tmp_path / "some" / "robot.usda").write_text("")
    assert completion.answer("wheelleg convert so") == ["some/"]
    assert completion.answer("wheelleg convert some/r") == ["some/robot.usda"]


def test_a_broken_config_completes_nothing_and_prints_no_error(tmp_path, capsys):
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "bad.yaml").write_text("a: [\n")
    assert completion.answer(f"wheelleg train --config-dir {tmp_path} task=bad env.decim") == ["env.decimation="]
    assert capsys.readouterr().err == ""


def test_an_interactive_bash_completes_on_tab(tmp_path):
    program, given = tmp_path / "wheelleg", tmp_path / "given"
    real = f'exec {shlex.quote(sys.executable)} -m wheelleg_exp "$@"'
    program.write_text(f'#!/bin/sh\nif [ "$1" = completion ]; then {real}; fi\nprintf "%s|" "$@" > {given}\n')
    program.chmod(0o755)
    pid, terminal = pty.fork()
    if pid == 0:
        os.environ.update(PATH=f"{tmp_path}:{os.environ['PATH']}", PS1="ready> ", TERM="dumb")
        os.execvp("bash", ["bash", "--norc", "--noprofile", "-i"])
    termios.tcsetwinsize(terminal, (40, 250))
    try:
        _type(terminal, 'eval "$(wheelleg completion bash)"; echo loa""ded\n', "loaded")
        _type(terminal, "wheelleg train robot=exp\t", "robot=explicit ")
        _type(terminal, "reward@env.rewards=[alive,te\t", "[alive,terminating ")
        _type(terminal, "env.deci\t", "env.decimation=")
        _type(terminal, "4; echo do''ne\n", "done")
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(terminal)
    assert given.read_text() == "train|robot=explicit|reward@env.rewards=[alive,terminating|env.decimation=4|"


def _type(terminal: int, text: str, until: str) -> None:
    os.write(terminal, text.encode())
    seen, end = "", time.monotonic() + PATIENCE_S
    while until not in seen:
        assert time.monotonic() < end, f"waited for {until!r}, saw {seen!r}"
        if select.select([terminal], [], [], 1.0)[0]:
            seen += os.read(terminal, 4096).decode(errors="replace")


def test_an_answer_imports_neither_torch_nor_mujoco_and_a_cached_answer_not_even_hydra(tmp_path, monkeypatch):
    monkeypatch.setenv("WHEELLEG_CACHE", str(tmp_path / "cache"))
    code = (
        "import os, sys; from wheelleg_exp.cli.main import main; status = main(['completion', 'query']);"
        "print(status, [m for m in ('torch', 'mujoco', 'rsl_rl', 'hydra') if m in sys.modules])"
    )
    environment = {**os.environ, "WHEELLEG_COMPLETE_LINE": "wheelleg train env.rewards.alive.wei"}
    for loaded in (["hydra"], []):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
        assert done.stdout.splitlines() == ["env.rewards.alive.weight=", f"0 {loaded}"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_shell_has_a_script_and_another_shell_is_refused(shell, capsys):
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert "wheelleg" in script
    assert "completion query" in script
    assert main(["completion", "tcsh"]) == 2
    assert "bash" in capsys.readouterr().err
