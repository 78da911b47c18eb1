"""Pipelines: what makes a phase go on, what stops it, and that one which was stopped goes on to the same bytes."""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any, ClassVar

import pytest
import yaml

from jobs.small import TINY, refused, succeed, wheelleg
from wheelleg_exp.child_process import EventPipe
from wheelleg_exp.cli import train
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.composing.compose_sweep import digest_of
from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.pipeline import run_pipeline as runner
from wheelleg_exp.jobs.pipeline.pipeline_phases import Gate, judge
from wheelleg_exp.jobs.pipeline.run_pipeline import compose_phases, read_pipeline, resume_pipeline
from wheelleg_exp.jobs.train import source_roots as circumstances
from wheelleg_exp.jobs.training_job import JobRequest, serve
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.trainer import Iteration
from wheelleg_exp.run.run_index import PipelineIndex
from wheelleg_exp.stop_request import StopRequest

pytestmark = pytest.mark.train

WORDS = [*TINY, "env.num_envs=8", "agent.logger=null", "recording.enabled=false"]
GATE = {"protocol": "stand", "at_least": {"stand/survival": 0.5}}


class Quiet(Display):
    """A display that stores its notes, and the finished and total iterations of each progress report."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.progress: list[tuple[int, int]] = []

    def iteration(self, iteration: Iteration, total: int) -> None:
        self.progress.append((iteration.index + 1, total))

    def note(self, text: str) -> None:
        self.notes.append(text)


class Heard(EventPipe):
    """Collects the events of a pipeline step that runs in this process, and can request a stop."""

    def __init__(self, stop: StopRequest, stop_after: int | None) -> None:
        self.told: list[dict[str, Any]] = []
        self._stop, self._after = stop, stop_after

    def send(self, event: str, **facts: Any) -> None:
        self.told.append(json.loads(json.dumps({"event": event, **facts}, default=float)))
        if event == "iteration":
            Here.trained += 1
            self._stop.requested |= Here.trained == self._after


class Here:
    """Runs pipeline steps in this process; the test sets the results of evaluations."""

    values: ClassVar[list[float]] = []
    judged: ClassVar[list[str]] = []
    stop_after: int | None = None
    trained = 0
    copies: Path | None = None  # where copies of all runs go, one before each evaluation

    @staticmethod
    def run(request: JobRequest, stop: StopRequest):
        return nullcontext(Here.events(request, stop))

    @staticmethod
    def events(request: JobRequest, stop: StopRequest):
        if request.kind == "evaluate":
            if Here.copies:
                shutil.copytree(request.root, Here.copies / str(len(Here.judged)))
            Here.judged.append(request.checkpoint)
            metrics = {"stand/survival": Here.values.pop(0)}
            yield {"event": "evaluated", "folder": "evaluation/x", "metrics": metrics, "scenarios_sha256": "0"}
            return
        heard = Heard(stop, Here.stop_after)
        try:
            serve(heard, request.line(), stop)
        finally:
            yield from heard.told


@pytest.fixture(autouse=True)
def here(monkeypatch):
    monkeypatch.setattr(circumstances, "_source_differences", lambda *_: [])
    monkeypatch.setattr(runner, "run_request", Here.run)
    Here.values, Here.judged, Here.stop_after, Here.trained = [], [], None, 0


def tree(**gate: Any) -> dict[str, Any]:
    first = {"task": "stand", "max_iterations": 2, "overrides": [], "gate": dict(GATE)}
    second = {"task": "stand", "max_iterations": 3, "overrides": ["env.rewards.alive.weight=1"]}
    return {"name": "two", "phases": {"first": first, "second": {**second, "gate": {**GATE, **gate}}}}


def begin(root: Path, **gate: Any) -> PipelineIndex:
    declared, words = read_pipeline(tree(**gate)), [*WORDS, f"run.root={root}"]
    digests = {name: digest_of(phase) for name, phase in compose_phases(declared.phases, words).items()}
    facts = {"config": declared.tree, "overrides": words, "config_dirs": [], "command": ["wheelleg"]}
    return PipelineIndex.create(root, **facts, digests=digests)


def run(index: PipelineIndex, values: list[float], stop_after: int | None = None, display: Quiet | None = None) -> str:
    Here.values, Here.stop_after, Here.trained = list(values), stop_after, 0
    with StopRequest() as stop:
        return runner.PipelineRunner(index, read_pipeline(index.data["config"]), display or Quiet(), stop).run()


def resumed(index: PipelineIndex, values: list[float], *overrides: str, **options: Any) -> tuple[PipelineIndex, str]:
    again = PipelineIndex.load(index.folder)
    resume_pipeline(again, overrides, ["wheelleg", "resume"])
    return again, run(again, values, **options)


def sums(index: PipelineIndex) -> list[str]:
    found = []
    for phase in index.phases:
        path = index.run_of(phase) / f"model_{phase['trained'] - 1}.pt"
        found.append(hashlib.sha256(path.read_bytes()).hexdigest())
    return found


@pytest.fixture(scope="module")
def watched(tmp_path_factory) -> tuple[PipelineIndex, Path]:
    """Return an uninterrupted pipeline of two phases, and a folder with copies of its files before each evaluation."""
    Here.copies = tmp_path_factory.mktemp("copies")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "run_request", Here.run)
        patch.setattr(circumstances, "_source_differences", lambda *_: [])
        index = begin(tmp_path_factory.mktemp("whole"), every=1, passes=2)
        assert run(index, [1.0, 1.0, 0.2, 1.0]) == "finished"
    copies, Here.copies = Here.copies, None
    return PipelineIndex.load(index.folder), copies


@pytest.fixture
def whole(watched) -> PipelineIndex:
    """Return the uninterrupted pipeline as its record describes it."""
    return PipelineIndex.load(watched[0].folder)


@pytest.fixture
def killed(watched, tmp_path) -> Callable[[int], PipelineIndex]:
    """Return a function that returns the same pipeline, killed before its n-th evaluation."""

    def before(evaluation: int) -> PipelineIndex:
        root = shutil.copytree(watched[1] / str(evaluation), tmp_path / "killed")
        index = PipelineIndex.load(next((root / "pipelines").iterdir()))
        index.data["process"]["pid"] = 2**22 + 1
        words = index.data["overrides"]
        index.data["overrides"] = [f"run.root={root}" if word.startswith("run.root=") else word for word in words]
        index.write()
        return index

    return before


def test_each_phase_is_an_ordinary_run_that_starts_with_the_previous_policy(whole: PipelineIndex):
    first, second = whole.phases
    assert [phase["status"] for phase in whole.phases] == ["passed", "passed"]
    assert (first["trained"], second["trained"]) == (2, 3)
    manifest = json.loads((whole.run_of(second) / "manifest.json").read_text())
    assert manifest["status"] == "finished"
    begun = manifest["init_from"]
    last = whole.run_of(first) / "model_1.pt"
    assert (begun["run"], begun["sha256"]) == (whole.run_of(first).name, hashlib.sha256(last.read_bytes()).hexdigest())
    kept = checkpoint.load(whole.run_of(second) / "asset" / begun["kept"])
    assert kept["actor_state_dict"].keys() == checkpoint.load(last)["actor_state_dict"].keys()


def test_the_record_states_why_a_phase_ended(whole: PipelineIndex):
    first, second = whole.phases
    assert first["why"] == "the gate was passed once, after training"
    assert second["why"] == "the gate was passed once, after training"
    assert [(gate["iteration"], gate["passed"]) for gate in second["gates"]] == [(1, True), (2, False), (3, True)]
    assert second["gates"][1]["why"] == ["stand/survival is 0.2, but must be at least 0.5"]


def test_a_phase_ends_early_after_the_configured_passes_in_a_row(killed):
    display = Quiet()
    index, status = resumed(killed(1), [1.0, 1.0], display=display)
    assert (status, index.phases[1]["trained"]) == ("finished", 2)
    assert display.progress == [(2, 3)]  # of the iterations of the phase, not of those before the next evaluation
    assert index.phases[1]["why"] == "the gate was passed 2 times in a row, after 2 iterations"


def test_a_gate_that_is_not_passed_at_the_maximum_stops_the_pipeline(killed):
    display = Quiet()
    index, status = resumed(killed(0), [0.2], display=display)
    assert status == "stopped"
    assert [note for note in display.notes if ": gate" in note] == ["first: gate after 2 iterations not passed"]
    first, second = index.phases
    assert (first["status"], second["status"], second["run"]) == ("failed", "waiting", None)
    assert "phase 'first': the gate is not passed after 2 iterations: stand/survival is 0.2" in index.data["why"]
    with pytest.raises(ConfigError, match="nothing changed"):
        resumed(index, [])
    record = index.path.read_bytes()
    with pytest.raises(ConfigError, match=r"is 1, and phase 'first' has done 2 iterations.*expected at least 2"):
        resumed(index, [], "pipeline.phases.first.max_iterations=1")
    assert index.path.read_bytes() == record
    again, status = resumed(index, [1.0, 1.0, 1.0], "pipeline.phases.first.max_iterations=3")
    assert (status, again.phases[0]["trained"]) == ("finished", 3)
    assert again.data["resumes"][1]["before"]["status"] == "stopped"


def test_a_pipeline_stopped_in_a_phase_resumes_to_the_same_bytes(whole: PipelineIndex, killed):
    index, status = resumed(killed(1), [1.0], stop_after=1)
    assert (status, index.phases[1]["trained"]) == ("interrupted", 1)
    again, status = resumed(index, [0.2, 1.0])
    assert (status, sums(again)) == ("finished", sums(whole))
    assert [phase["gates"] for phase in again.phases] == [phase["gates"] for phase in whole.phases]


def test_what_a_stopped_step_has_done_counts(whole: PipelineIndex, killed):
    index = killed(1)
    index.data["config"]["phases"]["second"]["gate"]["every"] = None
    index.write()
    index, status = resumed(index, [], stop_after=1)
    assert status == "interrupted"
    before = index.path.read_bytes()
    with pytest.raises(ConfigError, match=r"is 1, and phase 'second' has done 2 iterations.*expected at least 2"):
        resume_pipeline(PipelineIndex.load(index.folder), ["pipeline.phases.second.max_iterations=1"], [])
    assert index.path.read_bytes() == before
    Here.judged = []
    again, status = resumed(index, [0.0, 1.0], "pipeline.phases.second.gate.every=1")
    assert (status, Here.judged, sums(again)) == ("finished", ["model_1.pt", "model_2.pt"], sums(whole))


def test_killed_before_it_could_record_what_was_done_it_does_nothing_twice(whole: PipelineIndex, killed):
    index = killed(1)
    index.phases[1]["trained"] = 0
    index.write()
    Here.judged = []
    again, status = resumed(index, [1.0, 0.0, 1.0])
    assert (status, Here.judged, sums(again)) == ("finished", ["model_0.pt", "model_1.pt", "model_2.pt"], sums(whole))
    assert Here.trained == 2


def test_one_that_is_finished_or_under_way_is_not_gone_on_with(whole: PipelineIndex):
    with pytest.raises(RunDirectoryError, match="is finished"):
        resume_pipeline(PipelineIndex.load(whole.folder), [], [])
    index = PipelineIndex.load(whole.folder)
    index.data["status"] = "running"
    with pytest.raises(RunDirectoryError, match="still running"):
        resume_pipeline(index, [], [])


FIXED = {"seed=3": "keeps the settings with which it started", "pipeline.phases.second.task=walk": "has started"}
FIXED["pipeline.phases.first.max_iterations=9"] = "has already passed its evaluation"
FIXED["pipeline.name=other"] = "a resume can change only settings in pipeline.phases"


@pytest.mark.parametrize(("override", "message"), FIXED.items())
def test_settings_that_cannot_change_in_a_resume_are_refused(whole: PipelineIndex, override, message):
    index = PipelineIndex.load(whole.folder)
    index.data["status"] = "interrupted"
    index.phases[1]["status"] = "training"
    with pytest.raises(ConfigError, match=message):
        resume_pipeline(index, [override], [])


def refusal(phases, words: list[str]) -> str:
    with pytest.raises(ConfigError) as told:
        compose_phases(phases, words)
    return str(told.value)


def test_the_last_policy_is_evaluated_next_to_the_reference_filmed_exported_and_described(tmp_path, monkeypatch):
    said: list[tuple[str, ...]] = []
    monkeypatch.setattr(train, "_command", lambda *words: said.append(words) or [words[0]][words[0] != "export" :])
    for name in ("2026-01-01", "2026-01-02"):
        (tmp_path / "play" / name).mkdir(parents=True)
        (tmp_path / "play" / name / "recording.rrd").touch()
        (tmp_path / "play" / name / "figures.json").write_text('{"survival": 0.0}')
    film, settings = tmp_path / "film.mp4", runner.PipelineSettings({"figures": ["*/survival"]}, {}, "first_drive")
    fell = f"the robot falls in the film: {train.shown(film)}"
    assert train._present(tmp_path, film, settings, ["mine"]) == [fell, "export"]
    assert [words[0] for words in said] == ["evaluate", "play", "inspect", "export", "report"]
    words = ("protocol=first_drive", "--reference", "--config-dir", "mine", "--metric", "*/survival")
    assert said[0][1:] == (str(tmp_path), *words)
    assert said[2][1:] == (str(tmp_path / "play" / name / "recording.rrd"), "--video", str(tmp_path / "film.mp4"))


def test_the_phases_of_a_first_drive_fit_together_and_its_protocols_have_its_metrics():
    pipeline, phases = train.composed_phases(["pipeline=first_drive"], [])
    assert (pipeline.results, list(phases)) == ("first_drive", ["walk", "realism"])
    with pytest.raises(ConfigError, match="no_such"):
        train.composed_phases(["pipeline=first_drive", "pipeline.results=no_such"], [])
    figures = ["pipeline.results=gate_walk", "pipeline.figures=['*/survival',walk/zero_drif]"]
    with pytest.raises(ConfigError, match=r"pipeline\.figures: no metric of .* 'walk/zero_drif'.*'walk/zero_drift'\?"):
        train.composed_phases(["pipeline=first_drive", *figures], [])


def test_a_pipeline_in_a_project_with_robots_trains_another_robot_only_on_request(tmp_path):
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "mine.yaml").write_text("# @package env.robot\ndefaults: [article]\nprofile: bench")
    pipeline, phases = train.composed_phases(["pipeline=first_drive"], [])
    args = argparse.Namespace(overrides=["seed=1"], config_dirs=[tmp_path])
    with pytest.raises(ConfigError, match=r"phase 'walk' trains the robot 'article'.*expected robot=mine or robot=art"):
        train._require_own_robot(pipeline, phases, args)
    for changed in ({"overrides": ["robot=article"]}, {"config_dirs": []}):
        train._require_own_robot(pipeline, phases, argparse.Namespace(**{**vars(args), **changed}))
    mine = compose(["task=walk", "robot=mine"], config_dirs=[tmp_path])  # selected, whatever its profile's name is
    train._require_own_robot(pipeline, dict.fromkeys(phases, mine), args)


def test_the_phases_of_the_stock_pipeline_fit_together_with_realism():
    declared = yaml.safe_load((configs_dir() / "pipeline/stand_to_terrain.yaml").read_text())
    phases = compose_phases(read_pipeline(declared).phases, ["robot=physical", "realism=full"])
    assert list(phases) == ["stand", "walk", "velocity", "terrain"]


def test_mistakes_of_all_phases_are_reported_at_once_and_a_mistake_of_all_phases_once():
    phases = read_pipeline(tree()).phases
    assert "set this themselves" in refusal(phases, ["task=walk"])
    phases["second"].overrides.append("observation@env.observations.policy.terms=[base_height,base_ang_vel]")
    said = refusal(phases, WORDS)  # The phases do not fit together.
    assert re.search(r"phase 'second': env\..*: is new, and phase 'first' does not have it", said)
    phases = read_pipeline(tree()).phases
    phases["second"].overrides.append("env.rewards.alive.weigth=1")
    for phase in phases.values():
        phase.overrides.append("env.num_envs=0")
    said = refusal(phases, ["env.rewards.alve.weight=1"])
    assert said.count("env.rewards.alve.weight: there is no such key (override env.") == 1
    assert "phase 'second': env.rewards.alive.weigth: " in said
    assert said.count("env.num_envs: ") == 2, "each phase's own"
    assert [word for word in ("phase 'first'", "phase 'second'") if word not in said] == []


def test_settings_of_a_phase_take_precedence_over_overrides(declared_two):
    words, phases = ["task=walk", "agent.max_iterations=9", "init_from=latest", "run.name=other"], "++pipeline.phases."
    given = f"{phases}second.overrides={words}", f"{phases}second.gate.overrides=['protocol=walk']"
    said = refused("check", *declared_two, *given)
    for word in words:
        assert f"pipeline.phases.second.overrides: '{word}': the phase sets this itself" in said
    assert "pipeline.phases.second.gate.overrides: 'protocol=walk': the gate sets this itself" in said
    seeds = f"{phases}first.gate.overrides=['protocol.seed=abc']", f"{phases}second.gate.overrides=['seed=abc']"
    said = refused("check", *declared_two, "pipeline.phases.first.overrides=['init_from=nothing']", *seeds)
    assert "pipeline.phases.first.overrides: phase 'first': init_from: " in said
    for name in ("first", "second"):
        assert f"pipeline.phases.{name}.gate.overrides: phase '{name}': seed: " in said
    with pytest.raises(ConfigError, match=r"'a\.b' is not a phase name"):
        read_pipeline({**tree(), "phases": {"a.b": tree()["phases"]["first"]}})


def test_all_mistakes_of_a_pipeline_file_are_reported_with_their_lines(declared_two):
    file = Path(declared_two[-1]) / "pipeline" / "two.yaml"
    text = file.read_text().replace("max_iterations: 2", "max_iterations: many")
    file.write_text(text.replace("overrides: []", "overides: []"))
    said = refused("check", *declared_two)
    assert [word for word in ("2 mistakes", "pipeline.phases.first.max_iterations") if word not in said] == []
    assert "did you mean 'overrides'?" in said
    assert said.count("two.yaml:") == 2


@pytest.mark.parametrize("value", [None, float("nan"), 0.4])
def test_what_is_no_number_passes_no_gate(value):
    assert not judge(Gate("stand", {"a": 0.5}, {}), {"a": value}).passed
    assert judge(Gate("stand", {"a": 0.5}, {"b": 0.1}), {"a": 0.5, "b": 0.1}).passed
    found = judge(Gate("stand", {"a": 0.5}), {"a": 0.4, "stand/wheels_down_share": 0.92, "walk/wheels_down_share": 1.0})
    assert "off the ground in 8% of the steps" in found.why[1]
    assert "halve physics_dt and double decimation in the robot's YAML file" in found.why[1]
    with pytest.raises(ConfigError, match="no metric 'c'"):
        judge(Gate("stand", {"c": 0.5}, {}), {"a": value})


def test_a_pipeline_that_is_not_there_is_named(capsys):
    assert "did you mean 'stand_to_terrain'" in refused("train", "pipeline=stand_to_terain")
    refused("train", "-m", "pipeline=stand_to_terrain")


def test_gates_on_unmeasured_metrics_are_rejected_before_the_first_phase(tmp_path):
    node = tree(at_least={"stand/survivl": 0.5}, at_most={"walk/skill_vx": 1.0})
    (tmp_path / "pipeline").mkdir()
    (tmp_path / "pipeline" / "two.yaml").write_text("# @package pipeline\n" + yaml.safe_dump(node, sort_keys=False))
    words = ["pipeline=two", *WORDS, f"run.root={tmp_path}"]
    word = "+pipeline.phases.first.gate.overrides=['protocol.stand=null']"
    said = refused("train", *words, "--config-dir", tmp_path, word)
    assert "pipeline.phases.second.gate.at_least.stand/survivl: protocol 'stand' has no such metric" in said
    assert "did you mean 'stand/survival'" in said
    assert "pipeline.phases.second.gate.at_most.walk/skill_vx" in said
    assert "two.yaml:" in said
    assert "gate.overrides: phase 'first': protocol: the protocol has no test" in said
    assert not (tmp_path / "pipelines").exists()


@pytest.mark.parametrize("command", ["evaluate", "verify"])
def test_a_pipeline_in_place_of_a_run_is_reported_with_its_runs(whole: PipelineIndex, command):
    root = whole.root
    for named in (whole.folder, whole.folder.name, whole.path):
        said = refused(command, named, "--root", root)
        assert f"'{whole.folder.name}' is a pipeline, and each of its phases is a run" in said
        for phase in whole.phases:
            assert f"{whole.run_of(phase)} (phase '{phase['name']}')" in said


@pytest.fixture
def declared_two(tmp_path) -> list[str]:
    (tmp_path / "pipeline").mkdir()
    text = "# @package pipeline\n# Two of a kind.\n" + yaml.safe_dump(tree(), sort_keys=False)
    (tmp_path / "pipeline" / "two.yaml").write_text(text)
    return ["pipeline=two", "--config-dir", str(tmp_path)]


def test_a_pipeline_is_checked_as_training_it_would(declared_two):
    said = wheelleg("check", *declared_two)
    found = "no mistakes in the pipeline 'two': first (task 'stand'), second (task 'stand')\n"
    assert (said.status, said.out) == (0, found)
    said = wheelleg("check", *declared_two, "env.num_envs=0", "--json")
    assert said.status == 2
    mistakes = json.loads(said.out)["mistakes"]
    assert [(mistake["key"], "phase" in mistake["message"]) for mistake in mistakes] == [("env.num_envs", False)]
    said = refused("check", *declared_two, "pipeline.phases.first.gate.protocol=walk", "pipeline.phases.second=null")
    assert "protocol 'walk' has no such metric" in said


def test_pipelines_are_explained_and_composed_without_naming_their_primary_config(declared_two):
    said = succeed("explain", "pipeline.phases.second.max_iterations", *declared_two)
    assert said.out.startswith("pipeline.phases.second.max_iterations = 3\n")
    said = wheelleg("explain", "pipeline.phases.walk.gate.protocol")
    assert "stand_to_terrain.yaml:" in said.out
    said = wheelleg("compose", *declared_two)
    assert yaml.safe_load(said.out)["pipeline"] == tree()


@pytest.mark.parametrize("lacks", ["name", "phases[0].status"])
def test_an_incomplete_record_is_reported_and_not_read(whole: PipelineIndex, tmp_path, lacks):
    data = json.loads(whole.path.read_text())
    part, _, key = lacks.rpartition(".")
    del (data["phases"][0] if part else data)[key]
    (tmp_path / "pipeline.json").write_text(json.dumps(data))
    with pytest.raises(RunDirectoryError, match=re.escape(f"'{lacks}' is missing")):
        PipelineIndex.load(tmp_path)
    (tmp_path / "pipeline.json").write_text(json.dumps({**json.loads(whole.path.read_text()), "phases": [7]}))
    with pytest.raises(RunDirectoryError, match=r"'phases\[0\]' is missing"):
        PipelineIndex.load(tmp_path)


def test_pipelines_are_listed_those_declared_and_those_begun(whole: PipelineIndex, declared_two):
    said = wheelleg("list", "pipelines", *declared_two[1:], "--root", whole.root, "--json")
    rows = {(row["pipeline"], row["status"]): row for row in json.loads(said.out)}
    stock = {(name, "declared") for name in ("first_drive", "get_up", "jump", "stand_to_terrain")}
    assert set(rows) == {*stock, ("two", "declared"), ("two", "finished")}
    assert rows["stand_to_terrain", "declared"]["phases"] == "stand, walk, velocity, terrain"
    assert rows["two", "declared"]["help"] == "Two of a kind."
    assert rows["two", "finished"]["phases"] == "first passed, second passed"
    assert rows["two", "finished"]["file"] == str(whole.folder)


def test_a_changed_gate_is_checked_against_the_metrics_before_the_record_changes(whole: PipelineIndex):
    index = PipelineIndex.load(whole.folder)
    index.data["status"] = "interrupted"
    index.phases[1]["status"] = "training"
    before = index.path.read_bytes()
    with pytest.raises(ConfigError, match="no such metric") as told:
        resume_pipeline(index, ["pipeline.phases.second.gate.at_least={stand/drft:0.5}"], [])
    assert told.value.nearest == "stand/drift"
    for word, why in (("protocol=walk", "the gate sets this itself"), ("seed=abc", "in 'seed=abc'")):
        with pytest.raises(ConfigError, match=why) as told:
            resume_pipeline(index, [f"++pipeline.phases.second.gate.overrides=['{word}']"], [])
        assert told.value.key == "pipeline.phases.second.gate.overrides"
    assert index.path.read_bytes() == before
