"""A run directory stores the drives' networks, so the original files are not needed."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path

import pytest
from patience import PATIENCE_S

from jobs.small import TINY, only_run, refused, succeed, wheelleg

pytestmark = [pytest.mark.train, pytest.mark.usefixtures("forks")]

ROBOT = """# @package env.robot
defaults: [article, _self_]
profile: learned
actuators:
  legs: null
  net:
    _target_: wheelleg_exp.sim.actuators.ActuatorNetMLP
    joint_names_expr: [".*0[12]$"]
    network_file: nets/leg.pt
    effort_limit: 2.0
    velocity_limit: 30.0
    saturation_effort: 3.0
    pos_scale: 1.0
    vel_scale: 0.1
    torque_scale: 1.0
    input_order: pos_vel
    input_idx: [0, 1, 2]
    armature: 0.05
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "configs" / "robot").mkdir(parents=True)
    (tmp_path / "configs" / "robot" / "learned.yaml").write_text(ROBOT)
    make_network(tmp_path / "assets" / "nets" / "leg.pt")
    return tmp_path


def make_network(file: Path) -> None:
    """Write a network in a process of its own: names of classes that TorchScript has seen would reach the policy."""
    file.parent.mkdir(parents=True)
    words = "import torch, warnings; warnings.simplefilter('ignore'); n = torch.nn; "
    words += "m = n.Sequential(n.Linear(6, 16), n.Softsign(), n.Linear(16, 1)); "
    code = words + f"torch.manual_seed(0); torch.jit.save(torch.jit.script(m), {str(file)!r})"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE_S)


def alone(*words):
    """Run a command in a process of its own: TorchScript numbers the modules that it loads in each process."""
    command = [sys.executable, "-m", "wheelleg_exp.cli.main", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)


@pytest.mark.full
def test_a_run_is_resumed_and_replayed_with_its_stored_network(project):
    network = project / "assets" / "nets" / "leg.pt"
    words = ("--config-dir", project / "configs", "robot=learned", *TINY, f"run.root={project / 'runs'}")
    succeed("train", *words, "agent.max_iterations=1")
    run = only_run(project / "runs")
    kept = run / "asset" / "networks" / "nets" / "leg.pt"
    assert kept.read_bytes() == network.read_bytes()
    sources = json.loads((run / "asset" / "asset.json").read_text())["sources"]
    assert sources["networks/nets/leg.pt"] == hashlib.sha256(kept.read_bytes()).hexdigest()

    network.unlink()
    assert alone("resume", run, "agent.max_iterations=2").returncode == 0
    network.write_bytes(b"another")
    said = alone("replay", run)
    assert said.returncode == 0, said.stdout + said.stderr
    assert "identical" in said.stdout

    kept.write_bytes(b"another")
    assert wheelleg("verify", run).status == 1


@pytest.mark.parametrize(
    ("file", "words"),
    [("nets/lge.pt", "did you mean 'nets/leg.pt'?"), ("../nets/leg.pt", "a file's path below a folder")],
)
def test_a_network_that_is_not_there_is_found_by_the_check(project, file, words):
    override = f"env.robot.actuators.net.network_file={file}"
    said = refused("check", "--config-dir", project / "configs", "robot=learned", override)
    assert [word for word in ("env.robot.actuators.net.network_file", words) if word not in said] == []


def test_the_numbers_of_a_learned_drive_are_not_identified(project):
    words = ("robot=learned", "++env.robot.silence.armature_ratio=that of the stock robot")
    said = wheelleg("check", "--physics", "--config-dir", project / "configs", *words)
    assert "nan" not in said.out
    assert said.status == 0, said.out
