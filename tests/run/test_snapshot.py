from __future__ import annotations

import json

import pytest
import yaml
from omegaconf import OmegaConf

from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.run.run_config import load_params, write_params
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.start_run import refuse_secrets, start_run

PARAMS = {
    "env": {
        "decimation": 4,
        "sim": {"dt": 0.008333333333333333},
        "rewards": {"b": {"weight": -5e-5}, "a": None},
    },
    "agent": {"lr": 1e-5, "clip": float("inf"), "flag": True, "name": "1e5"},
}


@pytest.fixture
def run(tmp_path, repository, git):
    """A run below the repository itself, as users have it."""
    directory = RunDirectory.create(repository / "runs", "walk", 7)
    (repository / "package" / "new.py").write_text("y = 2\n")
    manifest = start_run(
        directory,
        command=["wheelleg", "train", "task=walk"],
        params=PARAMS,
        hydra_files={"config": "a: 1\n", "overrides.yaml": "- task=walk\n"},
        source_roots=[repository / "package"],
        seed=7,
        task="walk",
        threads={"torch": 2},
    )
    return directory, manifest


def test_everything_stands_before_the_first_step(run):
    directory, _ = run
    files = {p.relative_to(directory.path).as_posix() for p in directory.path.rglob("*") if p.is_file()}
    assert files == {
        "manifest.json",
        ".manifest.lock",
        "params/env.yaml",
        "params/agent.yaml",
        ".hydra/config.yaml",
        ".hydra/overrides.yaml",
        "source/git.json",
        "source/source.patch",
        "environment.txt",
    }
    assert (directory.hydra / "overrides.yaml").read_text() == "- task=walk\n"


def test_the_manifest_lists_the_snapshot_and_says_running(run):
    directory, manifest = run
    data = json.loads((directory.path / "manifest.json").read_text())
    assert data == manifest.data
    assert data["status"] == "running"
    assert len(data["files"]) == 7
    assert data["source"]["dirty"] is True
    assert data["source"]["tree"]
    assert not manifest.compare_files()


def test_the_source_holds_the_change_and_not_the_run_itself(run):
    directory, _ = run
    record = json.loads((directory.source / "git.json").read_text())
    assert record["untracked"] == ["package/new.py"]
    assert record["folders"] == ["package"]


def test_the_parameters_read_back_equal_in_their_order(run):
    directory, _ = run
    env, agent = load_params(directory)
    assert env == PARAMS["env"]
    assert list(env["rewards"]) == ["b", "a"]
    assert agent == PARAMS["agent"]
    assert yaml.safe_load((directory.params / "agent.yaml").read_text()) == PARAMS["agent"]


def test_parameters_that_are_not_plain_write_nothing(tmp_path):
    with pytest.raises(RunDirectoryError, match="tuple cannot be kept"):
        write_params(tmp_path, {"env": {"a": 1}, "agent": {"b": (1, 2)}})
    assert list(tmp_path.iterdir()) == []


def test_a_missing_part_is_an_error(tmp_path):
    with pytest.raises(RunDirectoryError, match="env and agent"):
        write_params(tmp_path, {"env": {}})


def test_missing_and_broken_parameters_are_told_with_their_file(tmp_path):
    with pytest.raises(RunDirectoryError, match=r"there is no '.*params/env\.yaml'"):
        load_params(tmp_path)
    write_params(tmp_path, PARAMS)
    (tmp_path / "params" / "agent.yaml").write_text("a: 1\nb: ]\n")
    with pytest.raises(RunDirectoryError, match=r"agent\.yaml:2"):
        load_params(tmp_path)
    (tmp_path / "params" / "agent.yaml").write_text("- 1\n")
    with pytest.raises(RunDirectoryError, match=r"agent\.yaml: holds a list"):
        load_params(tmp_path)


def snapshot_of(tmp_path, **changes):
    """The manifest and the source record of a run, as far as they tell what it was made from."""
    directory = RunDirectory.create(tmp_path / "runs", "walk", 7)
    given = {"command": ["wheelleg"], "params": PARAMS, "hydra_files": {"config": "a: 1\n"}, "source_roots": []}
    given |= {"seed": 7, "task": "walk", "threads": {"torch": 2}} | changes
    data = start_run(directory, **given).data
    source = json.loads((directory.source / "git.json").read_text())
    timeless = ("id", "started", "process", "sha256")
    return {k: v for k, v in data.items() if k not in timeless} | {"git": source}


def changed(one, other):
    return {key for key in one if one[key] != other[key]}


@pytest.fixture
def user_folder(tmp_path):
    folder = tmp_path / "mine"
    for name in ("configs/task/a.yaml", "terms.py", "assets/mesh.stl"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("1\n")
    return folder


def test_the_same_twice_is_the_same_snapshot(tmp_path, repository, git, user_folder):
    roots = [repository, user_folder]
    assert not changed(snapshot_of(tmp_path, source_roots=roots), snapshot_of(tmp_path, source_roots=roots))


@pytest.mark.parametrize("name", ["configs/task/a.yaml", "terms.py", "assets/mesh.stl"])
def test_a_change_in_a_users_folder_without_a_repository_shows(tmp_path, repository, git, user_folder, name):
    roots = [repository, user_folder]
    before = snapshot_of(tmp_path, source_roots=roots)
    (user_folder / name).write_text("2\n")
    after = snapshot_of(tmp_path, source_roots=roots)
    assert "git" in changed(before, after)
    assert before["git"]["others"][0]["tree"] != after["git"]["others"][0]["tree"]


def test_a_changed_installed_package_and_a_loose_module_show(tmp_path, git):
    package, module = tmp_path / "site-packages" / "terms", tmp_path / "helpers.py"
    package.mkdir(parents=True)
    (package / "a.py").write_text("1\n")
    module.write_text("1\n")
    before = snapshot_of(tmp_path, source_roots=[package, module])["git"]
    (package / "a.py").write_text("2\n")
    module.write_text("2\n")
    after = snapshot_of(tmp_path, source_roots=[package, module])["git"]
    assert before["content_sha256"] != after["content_sha256"]
    assert before["others"][0]["tree"] != after["others"][0]["tree"]


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"params": {**PARAMS, "env": {**PARAMS["env"], "decimation": 5}}}, "files"),
        ({"hydra_files": {"config": "a: 2\n"}}, "files"),
        ({"command": ["wheelleg", "train"]}, "command"),
        ({"seed": 8}, "seeds"),
        ({"threads": {"torch": 3}}, "threads"),
    ],
)
def test_a_change_of_what_is_given_shows(tmp_path, change, where):
    assert where in changed(snapshot_of(tmp_path), snapshot_of(tmp_path, **change))


@pytest.mark.parametrize(
    ("name", "where"),
    [("OMP_NUM_THREADS", "environment_variables"), ("LEG_LENGTH", "config_variables")],
)
def test_a_variable_that_matters_or_that_the_config_asks_for_shows(tmp_path, monkeypatch, name, where):
    files = {"config": "a: ${oc.env:LEG_LENGTH}\n"}
    found = []
    for value in ("1", "2"):
        monkeypatch.setenv(name, value)
        found.append(snapshot_of(tmp_path, hydra_files=files))
    assert where in changed(*found)
    monkeypatch.delenv("LEG_LENGTH", raising=False)
    assert snapshot_of(tmp_path, hydra_files=files)["config_variables"] == {}


def test_another_version_and_another_processor_show(tmp_path, monkeypatch):
    before = snapshot_of(tmp_path)
    versions, hardware = before["versions"], before["hardware"]
    monkeypatch.setattr("wheelleg_exp.run.environment.versions", lambda: {**versions, "mujoco": "9"})
    monkeypatch.setattr("wheelleg_exp.run.environment.hardware", lambda: {**hardware, "cpu": "another"})
    assert {"versions", "hardware"} <= changed(before, snapshot_of(tmp_path))


def look_for_secrets(command=("wheelleg",), hydra_files=None, config=None):
    """Look through what a run would keep, with the config resolved as composing resolves it."""
    files = {"config": "a: 1\n", **(hydra_files or {})}
    resolved = OmegaConf.to_container(OmegaConf.create(files["config"]), resolve=True)
    refuse_secrets(command, files, {**resolved, **(config or {})})


@pytest.mark.parametrize(
    "change",
    [
        {"command": ["wheelleg", "run.name=gh" + "p_" + "a1" * 18]},
        {"hydra_files": {"hydra": "hydra: {job: {env_set: {X: AKIA" + "A" * 16 + "}}}"}},
        {"config": {"env": {"events": {"a": {"api_key": "abc"}}}, "agent": {}}},
    ],
)
def test_a_token_in_a_config_or_on_the_command_line_is_refused(change):
    with pytest.raises(ConfigError, match="kept in the run directory"):
        look_for_secrets(**change)


TOKEN = "hf" + "_" + "a1" * 17


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("run: {name: '${oc.env:NAME_OF_RUN}'}\n", "run.name"),
        ("recording: {notes: ['x', '${run.note}']}\nrun: {note: '${oc.env:NAME_OF_RUN}'}\n", "recording.notes.1"),
    ],
)
def test_a_token_that_the_resolved_config_would_hold_is_refused_wherever_it_stands(monkeypatch, text, where):
    monkeypatch.setenv("NAME_OF_RUN", TOKEN)
    with pytest.raises(ConfigError, match="kept in the run directory") as caught:
        look_for_secrets(hydra_files={"config": text})
    assert caught.value.key == where
    assert TOKEN not in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        {"hydra_files": {"config": "run: {name: '${oc.env:MY_TOKEN}'}\n"}},
        {"hydra_files": {"config": "a: ${oc.decode:${oc.env:MY_TOKEN,1}}\n"}},
        {"hydra_files": {"overrides": "- run.name=${oc.env:MY_TOKEN}\n"}},
        {"command": ["wheelleg", "train", "run.name=${oc.env:MY_TOKEN}"]},
    ],
)
def test_a_variable_whose_name_says_secret_is_not_asked_for(monkeypatch, change):
    """Its value need not look like a token; it would be written resolved."""
    monkeypatch.setenv("MY_TOKEN", "abc123")
    with pytest.raises(ConfigError, match=r"\$\{oc\.env:MY_TOKEN\} would bring .* its name says that it is a secret"):
        look_for_secrets(**change)


def test_a_config_that_cannot_be_resolved_here_is_kept_as_it_is_written(tmp_path):
    snapshot_of(tmp_path, hydra_files={"config.yaml": (written := "a: '${oc.env:NOWHERE_SET}'\n")})
    (kept,) = tmp_path.rglob(".hydra/config.yaml")
    assert kept.read_text() == written


def test_what_a_run_holds_already_is_not_asked_about_again():
    kept = {"env": {"a": {"api_key": "abc"}}}
    refuse_secrets([], {}, {**kept, "seed": 1}, kept)
    with pytest.raises(ConfigError, match=r"agent\.token"):
        refuse_secrets([], {}, {**kept, "agent": {"token": "x"}}, kept)


def test_a_token_as_the_name_of_a_run_makes_no_folder(tmp_path):
    with pytest.raises(ConfigError, match=r"run\.name: .* access token"):
        RunDirectory.create(tmp_path / "runs", "walk", 7, TOKEN)
    assert not (tmp_path / "runs").exists()


def test_a_snapshot_that_fails_says_so_in_the_manifest(tmp_path, git):
    directory = RunDirectory.create(tmp_path / "runs", "walk", 7)
    params = {"env": {"a": (1, 2)}, "agent": {}}
    with pytest.raises(RunDirectoryError, match="tuple cannot be kept"):
        start_run(
            directory,
            command=[],
            params=params,
            hydra_files={},
            source_roots=[],
            seed=7,
            task="walk",
            threads={},
        )
    assert directory.manifest().status == "failed"
    assert "tuple cannot be kept" in directory.manifest().data["error"]["message"]


def test_the_manifest_is_there_before_the_source_is_read(tmp_path, git, monkeypatch):
    directory = RunDirectory.create(tmp_path / "runs", "walk", 7)
    seen = []

    def look(*arguments, **keywords):
        seen.append(directory.manifest().status)
        raise KeyboardInterrupt

    monkeypatch.setattr("wheelleg_exp.run.start_run.snapshot_source", look)
    with pytest.raises(KeyboardInterrupt):
        start_run(
            directory,
            command=[],
            params=PARAMS,
            hydra_files={},
            source_roots=[],
            seed=7,
            task="walk",
            threads={},
        )
    assert seen == ["running"]
    assert directory.manifest().status == "interrupted"


def test_a_hydra_file_cannot_leave_its_folder(tmp_path, repository, git):
    directory = RunDirectory.create(tmp_path / "runs", "walk", 7)
    with pytest.raises(RunDirectoryError, match="no file name"):
        start_run(
            directory,
            command=[],
            params=PARAMS,
            hydra_files={"../config": ""},
            source_roots=[],
            seed=7,
            task="walk",
            threads={},
        )
