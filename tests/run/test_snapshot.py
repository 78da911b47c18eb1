import json

import pytest
import yaml

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.run_config import load_params, write_params
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.start_run import start_run

PARAMS = {
    "env": {"decimation": 4, "sim": {"dt": 0.008333333333333333}, "rewards": {"b": {"weight": -5e-5}, "a": None}},
    "agent": {"lr": 1e-5, "clip": float("inf"), "flag": True, "name": "1e5"},
}


@pytest.fixture
def run(tmp_path, repository, git):
    directory = RunDirectory.create(repository / "runs", "walk", 7)
    (repository / "package" / "new.py").write_text("y = 2\n")
    files = {"config.yaml": "a: 1\n", "overrides.yaml": "- task=walk\n"}
    return directory, start(directory, hydra_files=files, source_roots=[repository / "package"])


def test_the_snapshot_is_complete_before_the_first_step(run):
    directory, manifest = run
    files = {p.relative_to(directory.path).as_posix() for p in directory.path.rglob("*") if p.is_file()}
    snapshot = {"params/env.yaml", "params/agent.yaml", ".hydra/config.yaml", ".hydra/overrides.yaml"}
    snapshot |= {"source/git.json", "source/source.patch", "environment.txt"}
    assert files == snapshot | {"manifest.json", ".manifest.lock"}
    assert (directory.hydra / "overrides.yaml").read_text() == "- task=walk\n"
    data = json.loads((directory.path / "manifest.json").read_text())
    assert (data, data["status"], set(data["files"])) == (manifest.data, "running", snapshot)
    assert data["source"]["dirty"] is True
    assert data["source"]["tree"]
    assert not manifest.compare_files()
    source = json.loads((directory.source / "git.json").read_text())  # The source excludes the run itself.
    assert (source["untracked"], source["folders"]) == (["package/new.py"], ["package"])
    env, agent = load_params(directory)
    assert (env, list(env["rewards"]), agent) == (PARAMS["env"], ["b", "a"], PARAMS["agent"])
    assert yaml.safe_load((directory.params / "agent.yaml").read_text()) == PARAMS["agent"]


def test_parameters_that_are_not_plain_missing_or_broken_are_refused(tmp_path):
    with pytest.raises(RunDirectoryError, match="tuple cannot be saved"):
        write_params(tmp_path, {"env": {"a": 1}, "agent": {"b": (1, 2)}})
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(RunDirectoryError, match=r"'.*params/env\.yaml' is missing"):
        load_params(tmp_path)
    write_params(tmp_path, PARAMS)
    broken = {"a: 1\nb: ]\n": r"agent\.yaml:2", "- 1\n": r"agent\.yaml: the file contains a list"}
    for text, message in broken.items():
        (tmp_path / "params" / "agent.yaml").write_text(text)
        with pytest.raises(RunDirectoryError, match=message):
            load_params(tmp_path)


def start(directory, **changes):
    given = {"command": ["wheelleg"], "params": PARAMS, "hydra_files": {"config.yaml": "a: 1\n"}, "source_roots": []}
    return start_run(directory, **({**given, "seed": 7, "task": "walk", "threads": {"torch": 2}} | changes))


def snapshot_of(tmp_path, **changes):
    """Return the values of a new run's manifest and source record that do not depend on the time."""
    directory = RunDirectory.create(tmp_path / "runs", "walk", 7)
    data = start(directory, **changes).data
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


@pytest.mark.parametrize("name", [None, "configs/task/a.yaml", "terms.py", "assets/mesh.stl"])
def test_a_second_snapshot_differs_only_if_a_users_file_changes(tmp_path, repository, git, user_folder, name):
    roots = [repository, user_folder]
    if name is not None:
        git(user_folder, "init", "-q")
    before = snapshot_of(tmp_path, source_roots=roots)
    if name is not None:
        (user_folder / name).write_text("2\n")
    after = snapshot_of(tmp_path, source_roots=roots)
    assert ("git" in changed(before, after)) == bool(changed(before, after)) == (name is not None)
    trees = [snapshot["git"]["others"][0]["tree"] for snapshot in (before, after)]
    assert (trees[0] != trees[1]) == (name is not None)


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"params": {**PARAMS, "env": {**PARAMS["env"], "decimation": 5}}}, "files"),
        ({"hydra_files": {"config.yaml": "a: 2\n"}}, "files"),
        ({"command": ["wheelleg", "train"]}, "command"),
        ({"seed": 8}, "seeds"),
        ({"threads": {"torch": 3}}, "threads"),
    ],
)
def test_a_change_of_what_is_given_shows(tmp_path, change, where):
    assert where in changed(snapshot_of(tmp_path), snapshot_of(tmp_path, **change))


VARIABLES = {"OMP_NUM_THREADS": "environment_variables", "LEG_LENGTH": "config_variables"}


@pytest.mark.parametrize(("name", "where"), VARIABLES.items())
def test_a_variable_that_changes_numbers_or_that_the_config_requests_shows(tmp_path, monkeypatch, name, where):
    files = {"config.yaml": "a: ${oc.env:LEG_LENGTH}\n"}
    found = []
    for value in ("1", "2"):
        monkeypatch.setenv(name, value)
        found.append(snapshot_of(tmp_path, hydra_files=files))
    assert where in changed(*found)
    monkeypatch.delenv("LEG_LENGTH", raising=False)
    assert snapshot_of(tmp_path, hydra_files=files)["config_variables"] == {}


def test_a_config_that_cannot_be_resolved_here_is_stored_as_written(tmp_path):
    snapshot_of(tmp_path, hydra_files={"config.yaml": (written := "a: '${oc.env:NOWHERE_SET}'\n")})
    (kept,) = tmp_path.rglob(".hydra/config.yaml")
    assert kept.read_text() == written


def test_a_snapshot_that_fails_is_recorded_in_the_manifest(tmp_path, git, monkeypatch):
    directory = RunDirectory.create(tmp_path / "runs", "walk", 7)
    with pytest.raises(RunDirectoryError, match="tuple cannot be saved"):
        start(directory, params={"env": {"a": (1, 2)}, "agent": {}})
    assert directory.manifest().status == "failed"
    assert "tuple cannot be saved" in directory.manifest().data["error"]["message"]
    other, seen = RunDirectory.create(tmp_path / "runs", "walk", 7), []

    def interrupt(*arguments, **keywords):
        seen.append(other.manifest().status)  # The manifest exists before the source is read.
        raise KeyboardInterrupt

    monkeypatch.setattr("wheelleg_exp.run.start_run.snapshot_source", interrupt)
    with pytest.raises(KeyboardInterrupt):
        start(other)
    assert (seen, other.manifest().status) == (["running"], "interrupted")
