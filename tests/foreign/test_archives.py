import io
import json
import os
import pickle
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from forks import forking
from jobs.small import TINY, Words, wheelleg

from foreign.trial import Trial, every_second, plant_project
from wheelleg_exp import packages as projects
from wheelleg_exp.cli.main import COMMANDS
from wheelleg_exp.files import write_json, write_text, write_yaml
from wheelleg_exp.jobs.result_record import read_manifests, result_manifest, result_page
from wheelleg_exp.packages import _trust_file
from wheelleg_exp.paths import find_asset
from wheelleg_exp.run.timestamps import utc_now, utc_text

pytestmark = pytest.mark.train

TERM = {"_target_": "evil.terms.f", "weight": 1.0}
WORD = "+env.rewards.evil={_target_: evil.terms.f, weight: 1.0}"
SHADOWED = ("yaml", "numpy", "rerun_cli", "wheelleg_exp", "sitecustomize", "hydra_plugins")
MOMENT = "2026-01-01_00-00-00"


class Runs:
    def __init__(self, marker: Path) -> None:
        self.marker = str(marker)

    def __reduce__(self) -> tuple[Any, ...]:
        return (open, (self.marker, "w"))


class Archive:
    """An unpacked archive with the project ``theirs``, whose code writes ``marker`` when the code runs."""

    def __init__(self, trial: Trial) -> None:
        self.trial, self.marker = trial, trial.canary
        self.root = trial.root / "archive"
        shutil.move(trial.root / "runs", self.root / "runs")
        self.run = self.root / trial.run.path.relative_to(trial.root)
        trial.run = type(trial.run)(self.run)
        self.project(self.root / "theirs")
        for name in SHADOWED:
            self.write(f"{name}/__init__.py", self.code)

    @property
    def code(self) -> str:
        return f"open({str(self.marker)!r}, 'w').close()\n"

    @property
    def configs(self) -> list[str]:
        return [str(self.root / "theirs" / "configs"), "theirs/configs", "../../../theirs/configs"]

    def write(self, name: str, content: str | bytes) -> Path:
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    def project(self, folder: Path) -> None:
        task = f"# @package _global_\ndefaults: [/task/stand, _self_]\nenv: {{rewards: {{evil: {json.dumps(TERM)}}}}}\n"
        write_text(plant_project(folder, self.code) / "task" / "evil.yaml", task)

    def plant_run(self, *, calls: bool) -> Path:
        trial, folder = self.trial, self.configs[0]
        if calls:
            trial.yaml("params/env.yaml", lambda env: env["rewards"].update(evil=TERM))
            trial.yaml("params/agent.yaml", lambda agent: agent["actor"].update(class_name="evil.terms:f"))
        sources = [{"path": name, "schema": "file", "provider": "config-dir"} for name in self.configs]
        sources.append({"path": "evil", "schema": "pkg", "provider": "hydra.searchpath"})
        choices = {"task": "evil", "reward@env.rewards": "evil"}
        hydra = {"runtime": {"choices": choices, "config_sources": sources}}
        write_yaml(self.run / ".hydra" / "hydra.yaml", {"hydra": hydra})
        trial.write(".hydra/overrides.yaml", json.dumps(["task=evil", f"hydra.searchpath=[file://{folder}]"]))
        git = json.loads((self.run / "source" / "git.json").read_text())
        other = {**git, "root": str(self.root / "theirs"), "folders": [".", "configs", "evil"]}
        trial.write("source/git.json", json.dumps({**git, "others": [other]}))
        self.project(self.run)
        variables = {"PYTHONPATH": str(self.root), "PYTHONSTARTUP": str(self.root / "yaml" / "__init__.py")}
        trial.manifest(
            config_dirs=[*self.configs, "configs", str(self.run / "configs")],
            command=["wheelleg", "train", "task=evil", "--config-dir", folder, f"--config-dir={folder}"],
            working_directory=str(self.root),
            environment_variables=variables,
            config_variables=variables,
        )
        return self.run

    def plant_pipeline(self, folder: Path | None = None, **changes: Any) -> Path:
        folder = folder or self.root / "runs" / "pipelines" / MOMENT
        run = os.path.relpath(self.run, folder)
        phase = {"task": "stand", "overrides": [], "max_iterations": 9, "gate": None, **changes.pop("phase", {})}
        entry = {"name": "a", "status": "waiting", "why": None, "digest": "0", "run": None, "init_from": run}
        entry |= {"trained": 0, "gates": [], "started": None, "ended": None, **changes.pop("entry", {})}
        data = {
            "format": 1, "id": folder.name, "name": "evil", "status": "interrupted", "why": None, "root": "../..",
            "command": ["wheelleg", "train", "--config-dir", self.configs[0]], "working_directory": str(self.root),
            "config_dirs": [], "overrides": ["env.num_envs=2"], "started": utc_text(utc_now()), "ended": None,
            "process": None, "resumes": [], "config": {"name": "evil", "phases": {"a": phase}}, "phases": [entry],
        }  # fmt: skip
        write_json(folder / "pipeline.json", {**data, **changes})
        return folder

    def plant_result(self, words: list[Any], again: list[Any], *, begun: bool = False) -> Path:
        folder, manifest = self.root / "docs" / "results", result_manifest(self.trial.healthy)
        made = {"overrides": words, "begins_with": None, "iteration": None}
        if begun:
            made = {"overrides": ["task=stand"], "begins_with": made, "iteration": 2}
        figures = {"seed": 1, "scenarios_sha256": "0", "starts_sha256": {}, "metrics": {}}
        run = {"id": manifest["id"], "train": made, "parameters": "0", "evaluation": figures}
        record = {
            "format": 2, "name": "evil", "words": again, "protocol": "stand", "scenarios_sha256": "0",
            "about": {"physics_dt_s": 0.005, "step_dt_s": 0.02}, "against": None, "runs": [run], "reference": None,
            "over_seeds": {}, "differences": {}, "verdict": "", "push_verdict": "",
        }  # fmt: skip
        write_json(folder / "evil" / f"{manifest['id']}.json", manifest)
        write_json(folder / "evil.json", record)
        write_text(folder / "evil.md", result_page(record, read_manifests(record, folder)))
        return folder

    def plant_sweep(self, launcher: dict[str, Any] | None = None, **changes: Any) -> Path:
        folder = self.root / "runs" / "sweeps" / MOMENT
        words = ["task=evil", f"--config-dir={self.configs[0]}", f"hydra.searchpath=[file://{self.configs[0]}]"]
        job = {"number": 1, "overrides": words, "swept": words, "status": "finished"}
        job |= {"run": os.path.relpath(self.run, folder), "started": None, "ended": None, "results": {}, "error": None}
        job |= changes.pop("job", {})
        data = {"format": 1, "id": MOMENT, "status": "running", "command": ["wheelleg", "train", *words]}
        data |= {"launcher": {"name": "submitit_slurm", "at_once": 1}, "jobs": [job], "process": None}
        write_json(folder / "sweep.json", data | {"working_directory": str(self.root)} | changes)
        hydra = {"launcher": {"_target_": "evil.terms.f", **(launcher or {})}, "sweep": {"dir": "."}, "job": {}}
        write_yaml(folder / "multirun.yaml", {"hydra": hydra})
        write_json(folder / "0" / "request.json", {"path": [str(self.root)], "line": "{}", "variables": {}})
        self.project(folder)
        return folder

    def plant_bundle(self) -> Path:
        folder = self.root / "bundle"
        spec = {"format": 1, "network": {"class_name": "evil.terms.f"}, "terms": [TERM], "command": self.configs}
        write_json(folder / "policy.json", spec)
        for name in ("runner.py", "simulate.py", "__init__.py"):
            write_text(folder / name, self.code)
        for name in ("policy.npz", "check.npz", "policy.pt", "policy.onnx"):
            self.write(f"bundle/{name}", self.call())
        self.project(folder)
        return folder

    def call(self) -> bytes:
        buffer = io.BytesIO()
        np.savez(buffer, x=np.array([Runs(self.marker)], dtype=object))
        return buffer.getvalue()


@pytest.fixture
def archive(trial: Trial, monkeypatch: pytest.MonkeyPatch) -> Iterator[Archive]:
    made, joined = Archive(trial), dict(projects._joined)
    monkeypatch.chdir(made.root)
    yield made
    projects._joined.clear()
    projects._joined.update(joined)
    for name in [name for name in sys.modules if name.partition(".")[0] == "evil"]:
        del sys.modules[name]


def trusted() -> str:
    with suppress(OSError):
        return _trust_file().read_text()
    return ""


def give(archive: Archive, *words: str | Path, status: tuple[int, ...] = (0, 1, 2)) -> Words:
    """Run a command on a foreign archive; the command must not run, join, or trust code from the archive."""
    before = trusted()
    said = wheelleg(*words)
    line = " ".join(map(str, words))
    assert not archive.marker.exists(), f"code ran: {line}"
    assert trusted() == before, line
    assert "evil" not in {*projects._joined, *sys.modules}, line
    assert said.status in status, (line, said.err)
    assert "--debug" not in said.err, (line, said.err)
    return said


QUICK = (*TINY, "env.num_envs=2", "recording.enabled=false", "agent.max_iterations=1", "agent.logger=null")
SHORT = ("protocol.stand={episodes:1,horizon_s:1.1,survival_s:[0.5]}", "protocol.resamples=50")
STOCK = str(find_asset("wheelleg/wheelleg.usda"))


def imports(record: str) -> bool:
    return record.endswith((".pt", ".npz", "/bundle")) or "/stand/" in record


# The command lines with a record r. The replay of a run is missing, because it runs the run's code and warns of this.
TAKING: dict[str, Callable[[str], list[tuple[str, ...]]]] = {
    "train": lambda r: [
        ("train", f"init_from={r}", *QUICK),
        *([("train", "agent=distillation", f"agent.teacher_checkpoint={r}")] if "model" in r or "/stand/" in r else []),
        *([("train", f"env.robot.asset={r}")] if Path(r).is_file() else []),
    ],
    "resume": lambda r: [("resume", r), ("resume", r, "agent.max_iterations=4", "agent.logger=null")],
    "play": lambda r: [("play", r, "env.num_envs=2")],
    "evaluate": lambda r: [("evaluate", r, *SHORT), ("evaluate", "--checkpoint", r, "latest", *SHORT)],
    "results": lambda r: [("results", "new", r, *SHORT, "--into", "new"), ("results", "evil", "--again", "--into", r)],
    "export": lambda r: [("export", r, "--output", "exported")],
    "report": lambda r: [("report", r, "--no-pictures")],
    "replay": lambda r: [("replay", r)] if "/stand/" not in r else [],
    "verify": lambda r: [("verify", r), ("verify", r, r)],
    "inspect": lambda r: [("inspect", r), ("inspect", r, "--play"), ("inspect", r, "--repair", "-o", "repaired.rrd")],
    "convert": lambda r: [("convert", r)],
    "check": lambda r: [("check", f"init_from={r}")] if "/stand/" in r else [],
    "diff": lambda r: [("diff", r, "stand")],
    "list": lambda r: [("list", "runs", "--root", r), ("list", "runs", "--sweep", r)],
    "new": lambda r: [("new", "project", "--robot", r)],
    # Each line that reaches the parameters starts a child process: files are given as a policy, other commands read
    # them as robots, and pipelines, results, sweeps, and recordings contain no parameters.
    "import": lambda r: [
        *([("import", r, "--robot", r, "--output", "imported")] if Path(r).is_dir() else []),
        *([("import", r, "--robot", STOCK, "--policy", r, "--output", "imported")] if imports(r) else []),
    ],
}
# These commands succeed on a healthy run.
USING = ("train", "resume", "play", "evaluate", "export", "report", "inspect")
OTHERS: dict[str, tuple[str, ...]] = {
    "zero-agent": ("zero-agent", *QUICK, "--steps", "1"),
    "random-agent": ("random-agent", *QUICK, "--steps", "1"),
    "doctor": ("doctor",),
    "compose": ("compose", "task=evil"),
    "explain": ("explain", "init_from", "init_from=runs/pipelines"),
    "identify": ("identify", "runs/pipelines", "--robot", "physical"),
    "completion": ("completion", "bash"),
}


def recording(archive: Archive) -> Path:
    content = (archive.run / "recording.rrd").read_bytes()
    return archive.write("recordings/recording.rrd", content[: len(content) * 3 // 4])


def dataset(archive: Archive) -> Path:
    archive.write("runs/stand/x/dataset/000000.npz", archive.call())
    return archive.write("dataset/000000.npz", archive.call())


RECORDS: dict[str, Callable[[Archive], Path]] = {
    "run": lambda archive: archive.plant_run(calls=False),
    "run that names code": lambda archive: archive.plant_run(calls=True),
    "checkpoint": lambda archive: archive.write("model_1.pt", pickle.dumps(Runs(archive.marker))),
    "pipeline": lambda archive: archive.plant_pipeline(config_dirs=archive.configs[:1], phase={"task": "evil"}),
    "result": lambda archive: archive.plant_result(["task=evil", f"--config-dir={archive.configs[0]}"], []),
    "sweep": lambda archive: archive.plant_sweep(),
    "bundle": lambda archive: archive.plant_bundle(),
    "recording": recording,
    "dataset": dataset,
}


@pytest.mark.parametrize("kind", RECORDS)
def test_no_command_runs_code_of_a_record_or_trusts_it(archive, kind):
    record = RECORDS[kind](archive)
    # Imports run in child processes. A fork has loaded modules such as yaml, so one record is given to whole processes.
    with nullcontext() if kind == "run" else forking():
        for command, lines in TAKING.items():
            given = [give(archive, *words).status for words in lines(str(record))]
            # A healthy run proves that the command line is valid.
            assert 0 in given or kind != "run" or command not in USING, command


def test_no_command_runs_code_of_records_in_its_working_folder(archive):
    assert {*TAKING, *OTHERS} == set(COMMANDS)
    for plant in RECORDS.values():
        plant(archive)
    for words in OTHERS.values():
        give(archive, *words)


GATE = {"protocol": "stand", "at_least": {"stand/survival": 1.0}}
PIPELINES: dict[str, Callable[[Archive], dict[str, Any]]] = {
    "a folder": lambda archive: {"config_dirs": archive.configs[:1], "phase": {"task": "evil"}},
    "a folder seen from the record": lambda archive: {"config_dirs": archive.configs[2:], "phase": {"task": "evil"}},
    "a missing folder": lambda _: {"config_dirs": ["gone"]},
    "a search path": lambda archive: {"overrides": [f"hydra.searchpath=[file://{archive.configs[0]}]", "task=evil"]},
    "an option": lambda archive: {"phase": {"overrides": [f"--config-dir={archive.configs[0]}"]}},
    "a variable": lambda _: {"overrides": ["run.name=${oc.env:TRIAL_VARIABLE}"]},
    "a target": lambda _: {"overrides": [WORD]},
    "a gate": lambda _: {"phase": {"gate": {**GATE, "overrides": ["hydra.searchpath=[pkg://yaml]"]}}},
    "a run": lambda archive: {"entry": {"run": f"../../stand/{archive.plant_run(calls=True).name}"}},
    "kinds": lambda _: {"overrides": 3, "entry": {"gates": ["x"]}},
}  # fmt: skip


@pytest.mark.parametrize("plant", PIPELINES.values(), ids=PIPELINES)
def test_a_pipeline_that_is_resumed_runs_no_code_and_trusts_nothing(archive, plant):
    folder = archive.plant_pipeline(**plant(archive))
    with forking():
        give(archive, "resume", os.path.relpath(folder), status=(2, 3))


@pytest.mark.parametrize(
    "plant",
    [
        {"overrides": ["run.root=../elsewhere"]},
        {"phase": {"overrides": ["run.root=/tmp/elsewhere"]}},
        {"entry": {"run": "../../../elsewhere/run"}},
    ],
)
def test_a_pipeline_that_is_resumed_stays_in_its_folder(archive, plant):
    folder = archive.plant_pipeline(**plant)
    assert "expected a path below" in give(archive, "resume", os.path.relpath(folder), status=(2,)).err
    assert not (folder.parents[2] / "elsewhere").exists()


NEW: dict[str, Any] = {"status": "waiting", "run": None}
SWEEPS: dict[str, tuple[dict[str, Any], str]] = {
    "an option": ({"job": {**NEW, "overrides": ["--config-dir=theirs"]}}, "is not allowed as a recorded override"),
    "a root": ({"job": {**NEW, "overrides": ["run.root=../elsewhere"]}}, "expected a path below"),
    "a run": ({"job": {"status": "failed", "run": "../../../elsewhere/run"}}, "expected a path below"),
    "a folder": ({"job": {**NEW, "overrides": []}, "working_directory": "/gone"}, "expected this command in /gone"),
    "kinds": ({"job": {"status": 3}}, "the key 'jobs[0].status' is missing or has a wrong value"),
    "commands": ({"launcher": {"setup": ["touch ran"]}}, "does not trust the setting 'setup'"),
    "a program": ({"launcher": {"python": "theirs"}}, "does not trust the setting 'python'"),
    "a line": ({"launcher": {"comment": "a\ntouch ran"}}, "does not trust the setting 'comment'"),
    "a cluster": ({"launcher": {"ray": {"init": {"address": "h:1"}}}}, "does not trust the setting 'address'"),
}  # fmt: skip


@pytest.mark.parametrize(("plant", "why"), SWEEPS.values(), ids=SWEEPS)
def test_a_sweep_that_is_resumed_trusts_nothing_and_stays_in_its_folder(archive, plant, why):
    folder = archive.plant_sweep(**{"working_directory": str(Path.cwd()), **plant})
    assert why in give(archive, "resume", "--sweep", os.path.relpath(folder), status=(2,)).err
    assert not (folder.parents[2] / "elsewhere").exists()


def test_a_pipeline_in_a_run_is_not_read(archive):
    archive.plant_pipeline(archive.plant_run(calls=True), config_dirs=archive.configs, phase={"task": "evil"})
    said = give(archive, "resume", os.path.relpath(archive.run), "agent.max_iterations=4", status=(2,))
    assert "is outside the allowed packages" in said.err


def test_the_folders_of_a_pipeline_are_named_and_may_be_given(archive):
    wrong = ["env.num_envs=0"]  # The command stops after it has checked the config.
    folder = archive.plant_pipeline(config_dirs=archive.configs[:1], overrides=wrong, phase={"task": "evil"})
    said = give(archive, "resume", folder, status=(2,))
    assert f"needs the config folder {archive.configs[0]}, which is not one of your trusted folders" in said.err
    assert "--config-dir with the place where that folder is now, if it is yours" in said.err
    wheelleg("resume", folder, "--config-dir", archive.configs[0])
    assert archive.marker.exists()
    assert archive.configs[0] in trusted()


RESULTS: dict[str, Callable[[Archive], tuple[list[Any], list[Any]]]] = {
    "an option": lambda archive: (["task=evil", f"--config-dir={archive.configs[0]}"], []),
    "a sweep": lambda _: (["-m", "hydra/launcher=joblib", "seed=1,2"], []),
    "a search path": lambda archive: ([f"hydra.searchpath=[file://{archive.configs[0]}]", "task=evil"], []),
    "a target": lambda _: ([WORD], []),
    "a variable": lambda _: (["run.name=${oc.env:TRIAL_VARIABLE}"], []),
    "of the evaluation": lambda archive: ([], [f"--config-dir={archive.configs[0]}"]),
}


@pytest.mark.parametrize("begun", [False, True], ids=["run", "run before"])
@pytest.mark.parametrize("plant", RESULTS.values(), ids=RESULTS)
def test_a_result_that_is_made_again_runs_no_code_and_trusts_nothing(archive, plant, begun):
    archive.plant_result(*plant(archive), begun=begun)
    give(archive, "results", "evil", "--again", status=(2,))


@pytest.mark.parametrize(("kind", "below"), every_second(["run", "pipeline", "sweep", "bundle"], [".", "below"]))
def test_a_command_in_a_record_does_not_use_the_records_project(archive, kind, below, monkeypatch):
    folder = RECORDS[kind](archive)
    archive.project(folder)
    (folder / below).mkdir(exist_ok=True)
    monkeypatch.chdir(folder / below)
    assert "is not an option" in give(archive, "check", "task=evil", status=(2,)).err
