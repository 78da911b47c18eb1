"""Compare what the commands answer with golden.json, and use a run of old code: see golden.py."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from forks import forking

from wheelleg_exp.sim.sensors.contact_sensor import TIMES
from wheelleg_exp.state import same
from wheelleg_exp.state.old_layout import from_format_2

from .golden import (
    CORPUS_VARIABLE,
    REPOSITORY,
    SECTIONS,
    TASKS,
    command,
    cpu,
    differences,
    load,
    mjcf,
    short_training,
    training,
)
from .runs import of_this_cpu, require_old_code, unpack


def assert_as_recorded(section: str, found: dict[str, Any]) -> None:
    golden = {name: value for name, value in load()[section].items() if name in found}
    lines = differences(golden, json.loads(json.dumps(found)), section)
    assert not lines, "\n".join(lines)


def test_the_stock_robot_converts_to_the_recorded_mjcf():
    assert_as_recorded("mjcf", mjcf("stock"))


@pytest.mark.corpus
def test_the_corpus_converts_to_the_recorded_mjcf(request, monkeypatch):
    folder = request.config.getoption("--corpus") or os.environ.get(CORPUS_VARIABLE)
    if not folder:
        pytest.skip(f"no corpus of USD robots: set {CORPUS_VARIABLE} or pass --corpus DIR")
    monkeypatch.setenv(CORPUS_VARIABLE, str(Path(folder).resolve()))
    found = mjcf("corpus", every=4)
    assert len(found) == 11
    assert_as_recorded("mjcf", found)


@pytest.mark.parametrize("section", ["compose", "explain"])
def test_a_command_answers_what_was_recorded(section):
    assert_section_as_recorded(section, every=16)


@pytest.mark.slow
@pytest.mark.parametrize(("section", "every"), [("check", 16), ("doctor", 8)])
def test_a_slow_command_answers_what_was_recorded(section, every):
    assert_section_as_recorded(section, every)


@pytest.mark.full
@pytest.mark.parametrize(
    "section", [*("compose", "explain", "check", "doctor"), pytest.param("mjcf", marks=pytest.mark.corpus)]
)
def test_a_command_answers_every_recorded_entry(section):
    assert assert_section_as_recorded(section, every=1) == list(load()[section])


def assert_section_as_recorded(section: str, every: int) -> list[str]:
    """Compare each ``every``-th entry of the long lists of a section; return the names of the compared entries."""
    found = SECTIONS[section](every=every)
    assert len(found) >= 5
    assert set(found) <= set(load()[section])
    assert_as_recorded(section, found)
    return list(found)


@pytest.mark.train
@pytest.mark.slow
@pytest.mark.parametrize("task", [pytest.param(t, marks=pytest.mark.full if t == "velocity" else ()) for t in TASKS])
def test_a_training_computes_what_was_recorded(task):
    assert_as_recorded("short training", short_training(task))


@pytest.mark.train
@pytest.mark.slow
@pytest.mark.parametrize("task", [pytest.param(t, marks=() if t == "stand" else pytest.mark.full) for t in TASKS])
def test_a_training_repeats_to_the_bit_on_a_recorded_cpu(task):
    known = load()["training"].get(cpu(), {})
    # `golden.py record` adds the digests of a CPU: on the old commit, those of terrain with MuJoCo 4.0.1.
    if not any(name.startswith(task) for name in known):
        return
    found = training(task)[cpu()]
    recorded = {name: known[name] for name in found}
    lines = differences({cpu(): recorded}, {cpu(): found}, "training")
    assert not lines, "\n".join(lines)


@pytest.mark.parametrize(
    ("section", "path", "value"),
    [
        ("mjcf", ("stock", "robot.xml"), "0" * 64),
        ("compose", ("task=walk", "(order)"), "other"),
        ("explain", ("env.sim.dt", "answer", "value"), 0.1),
        ("check", ("env.num_envs=0", "status"), 0),
        ("doctor", ("sound", "answer", "facts", "mass"), 2.601),
        ("training", (None, "stand, seed 1, threads 1", "learner"), "0" * 32),
        ("training", (None, "stand, seed 1, threads 1", "state", "/scene/sim/state"), "0" * 12),
        ("short training", ("stand", 0, "Rewards_per_step/base_height"), -0.0023),
    ],
)
def test_a_changed_value_is_a_difference(section, path, value):
    golden, found = load()[section], load()[section]
    path = [next(iter(found)) if name is None else name for name in path]
    node = found
    for name in path[:-1]:
        node = node[name]
    node[path[-1]] = value
    assert differences(golden, golden, section) == []
    (line,) = differences(golden, found, section)
    assert str(path[-2]) in line


def test_a_missing_and_an_added_entry_are_differences():
    golden = load()["explain"]
    changed = {**golden, "new": {"status": 0}}
    del changed["env.sim.dt"]
    lines = differences(golden, changed, "explain")
    assert [line.partition(": was")[0] for line in lines] == ["explain: env.sim.dt", "explain: new"]


@pytest.fixture
def old_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WHEELLEG_CACHE", str(tmp_path / "cache"))
    return unpack(tmp_path / "runs")


@pytest.fixture
def answered() -> Callable[..., Any]:
    def run(*words: str | Path) -> Any:
        status, out, err = command(*words, "--json")
        assert status == 0, err
        return json.loads(out)

    return run


def test_the_old_run_is_listed(old_run, answered):
    (row,) = answered("list", "runs")
    assert row["id"] == old_run.name
    assert (row["task"], row["status"], row["name"], row["seeds"]) == ("stand", "finished", "old", [3])
    assert (row["iterations"], row["checkpoint"], row["max_iterations"]) == (4, 3, 4)
    assert row["results"]["Train/mean_reward"] == -3.070594117976725


def test_the_old_run_is_verified(old_run, answered):
    checks = {check["name"]: check for check in answered("verify", "latest")["checks"]}
    assert {"manifest", "files", "params", "asset", "iterations", "checkpoints", "recording", "exported"} <= set(checks)
    assert {name for name, check in checks.items() if check["state"] != "ok"} <= {"source"}
    assert not any(check["failures"] for check in checks.values())
    content = bytearray((old_run / "model_3.pt").read_bytes())
    content[len(content) // 2] ^= 1
    (old_run / "model_3.pt").write_bytes(content)
    status, out, err = command("verify", "latest")
    assert status == 1
    assert "model_3.pt" in out + err


def test_the_old_recording_is_read(old_run, answered):
    stats = answered("inspect", old_run.name, "--stats", "--term", "base.pitch")["stats"]["base.pitch"]
    assert (stats["count"], stats["nan"], stats["unit"]) == (48, 0, "rad")
    assert stats["mean"] == pytest.approx(-0.2860326001142734, rel=1e-12)
    assert stats["minimum_at"]["step"] == 41
    summary = answered("inspect", "latest")
    assert [sample["episodes"] for sample in summary["summary"]["samples"]] == [2, 0]


def test_the_old_policy_is_exported(old_run, answered, tmp_path):
    done = answered("export", "latest", "-o", tmp_path / "bundle")
    assert Path(done["checkpoint"]).name == "model_3.pt"
    assert max(done["largest_difference"].values()) < 1e-5
    assert done["lacks"] == []


def test_the_old_state_of_sensors_and_accelerations_is_converted(old_run):
    env = torch.load(old_run / "model_3.pt", weights_only=True)["env"]
    scene = from_format_2(env)["scene"]
    assert scene["robot"]["data"]["_vel_before"] is None
    assert set(scene["sensors"]["contact_forces"]["data"]["times"]) == set(TIMES)
    env["scene"]["robot"] |= {"body_vel_before": torch.ones(4, 7, 6), "acc_valid": torch.ones(4, 1, 1)}
    data = from_format_2(env)["scene"]["robot"]["data"]
    assert same(data["_vel_before"], torch.ones(4, 7, 6))
    assert same(data["_acc_valid"], torch.ones(4, 1, 1))


@pytest.mark.slow
def test_the_old_run_is_reported(old_run, answered):
    report = Path(answered("report", "latest", "--no-pictures")["report"])
    assert report == old_run / "report.html"
    assert old_run.name in report.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_old_policy_is_played(old_run, answered):
    figures = answered("play", "latest", "env.num_envs=4", "play.conditions=training")["figures"]
    assert (figures["episodes"], figures["survival"]) == (4, 0.0)
    if of_this_cpu(old_run):
        assert figures["mean_return"] == -4.322476863861084
        assert figures["ended_by"] == {"time_out": 0, "base_contact": 3, "leg_contact": 1, "non_finite_state": 0}
    (folder,) = (old_run / "play").iterdir()
    assert (folder / "recording.rrd").is_file()


@pytest.mark.train
@pytest.mark.slow
def test_the_old_run_is_resumed_as_if_it_had_never_stopped(old_run, answered):
    same_cpu = of_this_cpu(old_run)  # the resume records the hardware of this machine instead
    resumed = answered("resume", "latest", "agent.max_iterations=6")
    assert (resumed["status"], resumed["results"]["iterations"], resumed["resume"]["iteration"]) == ("finished", 6, 4)
    words = [word for word in json.loads((old_run / "manifest.json").read_text())["command"] if "=" in word]
    kept = [word for word in words if not word.startswith(("agent.max_iterations=", "run."))]
    ground = ("env.sim.cone=pyramidal", "env.sim.impratio=1.0", "env.commands.base_velocity.max_travel_error=0.1")
    through = answered("train", *kept, *ground, "agent.max_iterations=6", "run.root=other")
    parts = json.loads(command("verify", old_run, through["run"], "--json")[1])["parts"]
    if same_cpu:
        assert parts["scalars"]["state"] == "equal", parts["scalars"]
        assert parts["scalars"]["iterations"] == 6
        assert not {"parameters", "optimizer"} & set(parts["digests"]["first_difference"])
    # The order of sections and parameters has changed, a warm start of 0 is new, and so are the sizes of the robot
    # and its scales, which the config contains next to the numbers that they give: all without an effect.
    deciding = {entry["key"] for entry in parts["settings"]["differing"] if entry["decides"]}
    new = (
        "size",
        "mass",
        "natural_speed",
        "leg_reach",
        "physics_dt",
        "decimation",
        "action_scales",
        "joint_pairs",
        "silence",
    )
    robot = {f"env.robot.{key}" for key in new}
    scales = {f"env.observations.{group}.terms.travel_error.scale" for group in ("policy", "critic")}  # twice as a list
    assert deciding <= {"env (order)", "env.commands.base_velocity (order)", "agent.warm_start", *robot, *scales}


@pytest.mark.train
@pytest.mark.slow
def test_the_old_run_is_replayed(old_run, answered, tmp_path, monkeypatch):
    require_old_code(tmp_path, monkeypatch)
    with forking():
        status, out, err = command("replay", "latest", "--repository", REPOSITORY, "--json")
    assert status in (0, 1), err
    states = {name: part["state"] for name, part in json.loads(out)["comparison"]["parts"].items()}
    assert {states["files"], states["settings"], states["robot"]} == {"equal"}
    if of_this_cpu(old_run):
        assert status == 0
        assert set(states.values()) == {"equal"}
