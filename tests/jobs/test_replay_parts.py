"""Test the parts of a replay that need no training."""

from __future__ import annotations

import json
from dataclasses import asdict
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from jobs.replays import commit, git
from jobs.small import cache_of
from wheelleg_exp.asset import convert_cached
from wheelleg_exp.errors import RunDirectoryError, WheellegError
from wheelleg_exp.files import write_text
from wheelleg_exp.jobs.replay import replay_run
from wheelleg_exp.jobs.replay import restored_imports as replay_boot
from wheelleg_exp.jobs.replay.replay_run import RestoredSource, describe_code, restore_all
from wheelleg_exp.jobs.replay.snapshot_training import PROTOCOL, ReplayDisplay, Request, _asset, _first_difference
from wheelleg_exp.jobs.saved_robot import REPORT, save_robot
from wheelleg_exp.paths import find_asset
from wheelleg_exp.run.environment import replay_environ, requested_variables
from wheelleg_exp.run.environment import variables as recorded_variables
from wheelleg_exp.run.manifest import Manifest
from wheelleg_exp.run.records import Resume
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.source_snapshot import snapshot_source


@pytest.mark.parametrize(
    ("recorded", "here", "also", "found"),
    [
        (
            {"MKL_CBWR": "AVX2,STRICT", "OPENBLAS_CORETYPE": "Haswell", "WHEELLEG_CACHE": "/there"},
            {"PATH": "/bin", "OMP_NUM_THREADS": "8", "MKL_CBWR": "AUTO", "WHEELLEG_CACHE": "/here"},
            [],
            {"PATH": "/bin", "MKL_CBWR": "AVX2,STRICT", "OPENBLAS_CORETYPE": "Haswell", "WHEELLEG_CACHE": "/here"},
        ),
        ({"ROBOT_MASS": "2.5", "LANG": "C"}, {"ROBOT_MASS": "3"}, ["ROBOT_MASS"], {"ROBOT_MASS": "2.5"}),
    ],
)
def test_variables_that_decide_numbers_are_those_of_the_run_and_places_are_not(recorded, here, also, found):
    assert replay_environ(recorded, here, also=also) == found


def request(**changes) -> Request:
    lists = {name: [] for name in ("config_dirs", "projects", "source_roots", "command")}
    known = {"run": "r", "until": 3, "root": "x", "name": "n", "workplace": "w", "moved": {}, "facts": {}}
    return Request(**{"protocol": PROTOCOL, **known, **lists, **changes})


def test_a_request_is_read_without_keys_of_a_newer_program_and_refused_with_another_protocol():
    assert Request.read(request().line()) == request()
    assert Request.read(json.dumps(asdict(request()) | {"invented_later": 1}).encode()) == request()
    with pytest.raises(WheellegError, match=rf"version {PROTOCOL + 1} in a replay request.*expected {PROTOCOL}"):
        Request.read(request(protocol=PROTOCOL + 1).line())


@pytest.fixture
def places(tmp_path):
    for top in ("wheelleg_exp", "lab_terms"):
        (tmp_path / top).mkdir()
        (tmp_path / top / "__init__.py").write_text("")
    (tmp_path / "wheelleg_exp" / "there.py").write_text("")
    return replay_boot.RestoredFinder({"wheelleg_exp": str(tmp_path), "lab_terms": str(tmp_path)})


def test_a_module_comes_from_its_restored_folder_alone(places, tmp_path):
    folder = tmp_path / "wheelleg_exp"
    assert places.find_spec("wheelleg_exp").origin == str(folder / "__init__.py")
    assert places.find_spec("wheelleg_exp.there", [str(folder)]).origin == str(folder / "there.py")
    assert places.find_spec("numpy") is None
    with pytest.raises(ModuleNotFoundError, match=r"code of the run lacks the module wheelleg_exp\.cli"):
        places.find_spec("wheelleg_exp.cli", [str(folder)])


def test_the_boot_code_imports_nothing_of_this_program():
    assert not {name for name in vars(replay_boot) if "wheelleg" in name}


@pytest.mark.parametrize(
    ("now", "said"),
    [
        ({"a": {"b": 1, "c": 2}}, None),
        ({"a": {"b": 1, "c": 3}}, "a.c was 2 and composes to 3"),
        ({"a": {"b": 1}}, "a.c is only in the snapshot"),
        ({"a": {"c": 2, "b": 1}}, "a has its keys in another order"),
    ],
)
def test_the_first_difference_of_two_configs_is_named(now, said):
    assert _first_difference({"a": {"b": 1, "c": 2}}, now, "") == said


def test_a_robot_is_converted_again_without_the_conversion_report_of_the_run(tmp_path, tmp_path_factory):
    name, run = "wheelleg/wheelleg.usda", RunDirectory.create(tmp_path / "runs", "stand", 0)
    saved = convert_cached(find_asset(name), cache_dir=cache_of(tmp_path_factory) / "assets")
    save_robot(run, saved, name, model_sha256="")
    (run.asset / REPORT).unlink()
    display, env = ReplayDisplay(Mock(), Mock()), {"robot": {"asset": name, "base": "auto"}}
    made = _asset(run, env, request(workplace=str(tmp_path)), display)
    assert display.found["asset"] == {"converted": True, "note": None}
    assert made.output.read_text() == saved.output.read_text()
    assert made.output.is_relative_to(tmp_path / "assets")


def resumed(**entry) -> list[str]:
    return replay_run._resume_notes(SimpleNamespace(facts=SimpleNamespace(resumes=[Resume(**entry)])))


def test_a_resume_is_reported_and_a_changed_one_voids_the_claim():
    assert resumed(overrides=[]) == ["the run was stopped and resumed once; the replay trains without a stop"]
    assert len(resumed(overrides=["agent.max_iterations=9"], exact=True)) == 1
    told = resumed(overrides=["agent.algorithm.gamma=0.9"], exact=False, iteration=7)
    assert "a resume before iteration 7 was not exact (agent.algorithm.gamma=0.9)" in told[1]
    assert "its numbers will differ" in told[1]
    assert "(another torch; another CPU)" in resumed(exact=False, why=["another torch", "another CPU"])[1]


@pytest.fixture
def program(tmp_path):
    """Return a small repository with the files that a replay needs, and an uncommitted file."""
    folder = tmp_path / "program"
    entry = folder / "wheelleg_exp" / "jobs" / "snapshot_training.py"
    entry.parent.mkdir(parents=True)
    entry.write_text("")
    (folder / "wheelleg_exp" / "__init__.py").write_text("")
    commit(folder)
    (folder / "new.yaml").write_text("a: 1\n")
    return folder


@pytest.fixture
def lab(tmp_path):
    folder = tmp_path / "lab"
    (folder / "configs").mkdir(parents=True)
    (folder / "configs" / "a.yaml").write_text("a: 1\n")
    commit(folder)
    return folder


def run_of(tmp_path, *roots, config_dirs=()) -> RunDirectory:
    run = RunDirectory.create(tmp_path / "runs", "stand", 0)
    snapshot_source(roots, run.source)
    manifest = Manifest.begin(run.path, task="stand", seed=0, command=["wheelleg"], threads={})
    manifest.record(config_dirs=[str(folder) for folder in config_dirs])
    return run


def restored(run, tmp_path, *repositories) -> RestoredSource:
    workplace = tmp_path / "workplace"
    workplace.mkdir()
    return restore_all(run, workplace, repositories)


def test_every_repository_is_restored_in_a_folder_of_its_own_name(program, lab, tmp_path):
    run = run_of(tmp_path, program, lab / "configs", config_dirs=[lab / "configs"])
    source = restored(run, tmp_path)
    assert [tree.how for tree in source.trees] == ["restored", "restored"]
    assert source.places["wheelleg_exp"].name == "program"
    assert (source.places["wheelleg_exp"] / "new.yaml").is_file()
    assert [folder.parent.name for folder in source.config_dirs] == ["lab"]
    assert (source.config_dirs[0] / "a.yaml").is_file()
    assert source.notes == []
    commit_id = git(program, "rev-parse", "HEAD")[:12]
    assert describe_code(run).startswith(f"replay runs the code of commit {commit_id} plus ")
    assert "the code of 1 more source folder of it" in describe_code(run)


def test_a_missing_user_repository_is_reported(program, lab, tmp_path):
    run = run_of(tmp_path, program, lab, config_dirs=[lab / "configs"])
    commit_id = git(lab, "rev-parse", "HEAD")
    lab.rename(tmp_path / "moved")
    source = restored(run, tmp_path)
    assert ([tree.how for tree in source.trees], source.config_dirs) == (["restored", "missing"], [])
    (note,) = source.notes
    assert f"no repository here contains commit {commit_id[:12]}; see --repository" in note


def test_a_repository_that_is_named_comes_before_the_recorded_one(program, lab, tmp_path):
    run = run_of(tmp_path, program, lab)
    git(tmp_path, "clone", "-q", str(lab), str(tmp_path / "clone"))
    assert restored(run, tmp_path, tmp_path / "clone").trees[1].origin == str(tmp_path / "clone")


def test_what_was_not_captured_is_named(program, lab, tmp_path):
    (program / "nested").mkdir()
    git(program / "nested", "init", "-q")
    git(program, "-c", "protocol.file.allow=always", "submodule", "--quiet", "add", str(lab), "library")
    git(program, "commit", "-qm", "with a submodule")
    plain = tmp_path / "plain"
    plain.mkdir()
    (plain / "helper.py").write_text("x = 1\n")
    source = restored(run_of(tmp_path, program, plain / "helper.py"), tmp_path)
    assert source.notes == [
        "'nested/' was not captured with the run (it is a repository of its own) and is missing",
        "submodules were not captured with the run, and are empty: library",
        f"'{plain / 'helper.py'}' was not captured with the run, and is used as it is now",
    ]
    assert ([tree.how for tree in source.trees], source.places["helper"]) == (["restored", "in place"], plain)


def asking(tmp_path, text, monkeypatch, **variables) -> RunDirectory:
    """Return a run whose config names environment variables, which its manifest records."""
    run = RunDirectory.create(tmp_path / "runs", "stand", 0)
    write_text(run.hydra / "config.yaml", text)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    manifest = Manifest.begin(run.path, task="stand", seed=0, command=["wheelleg"], threads={})
    requested = requested_variables([text])
    found = recorded_variables(also=requested)
    manifest.record(config_variables={name: found[name] for name in requested if name in found})
    for name in variables:
        monkeypatch.delenv(name)
    return run


def test_a_variable_that_was_not_stored_is_requested_by_name(tmp_path, monkeypatch):
    run = asking(tmp_path, "run: {name: '${oc.env:MY_TOKEN}'}\n", monkeypatch, MY_TOKEN="abc")
    with pytest.raises(RunDirectoryError, match="variable MY_TOKEN, which was not stored with the run"):
        replay_run._config(run, run.manifest())
    monkeypatch.setenv("MY_TOKEN", "abc")
    replay_run._config(run, run.manifest())
    assert replay_run._environ(run, run.manifest())["MY_TOKEN"] == "abc"


@pytest.mark.parametrize("text", ["${oc.env:MY_TOKEN,x}", "${oc.env:RUN_NAME}", "${oc.env:USER_OF,${oc.env:OTHER,y}}"])
def test_variables_that_were_stored_or_have_a_default_need_not_be_set(tmp_path, monkeypatch, text):
    run = asking(tmp_path, f"run: {{name: '{text}'}}\n", monkeypatch, RUN_NAME="mine")
    replay_run._config(run, run.manifest())


def test_a_variable_has_its_value_at_the_start_of_the_run_or_is_unset(tmp_path, monkeypatch):
    run = asking(tmp_path, "run: {name: '${oc.env:RUN_NAME}'}\n", monkeypatch, RUN_NAME="mine")
    made = replay_run._request(run, run.manifest(), 1, tmp_path, tmp_path, RestoredSource(), [])
    assert made.name == "mine_replay"
    run = asking(tmp_path, "run: {name: '${oc.env:RUN_NAME,x}'}\n", monkeypatch)
    monkeypatch.setenv("RUN_NAME", "later")
    assert "RUN_NAME" not in replay_run._environ(run, run.manifest())


def test_an_installed_program_is_used_unchanged_and_a_difference_is_reported(tmp_path):
    package = tmp_path / "site-packages" / "wheelleg_exp"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    run = run_of(tmp_path, package)
    source = restored(run, tmp_path)
    assert [tree.how for tree in source.trees] == ["installed"]
    assert (source.places["wheelleg_exp"] / "wheelleg_exp" / "jobs" / "play_policy.py").is_file()
    assert any("are not those of" in note for note in source.notes)
    assert describe_code(run).startswith("replay runs the installed wheelleg_exp, with")
