"""Tables of results: what they hold, and that they come out again to the bit; what does not is told."""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import pytest

from jobs.small import copied, succeed
from wheelleg_exp.cli.main import main
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import write_json, write_text
from wheelleg_exp.jobs import result_record as records
from wheelleg_exp.jobs.result_record import (
    machines_of,
    read_manifests,
    read_result,
    recipe,
    require_one_method,
    result_manifest,
    result_page,
)
from wheelleg_exp.paths import TEACHER, configs_dir
from wheelleg_exp.run.records import ProcessFacts
from wheelleg_exp.run.records import read_record as read_facts
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.verify import FactDifference

pytestmark = [pytest.mark.train, pytest.mark.usefixtures("forks")]

FOLDER = configs_dir().parent / "docs" / "results"

SHORT = ("protocol.stand={episodes:3,horizon_s:1.1,survival_s:[0.5]}", "protocol.resamples=50")


@pytest.fixture(scope="module")
def first(trained, tmp_path_factory) -> Path:
    """Write a result of a copy of the run once."""
    root = tmp_path_factory.mktemp("first")
    succeed("results", "small", copied(trained, root).path, *SHORT, "--reference", "--into", root / "results")
    return root


@pytest.fixture
def written(first, tmp_path):
    return shutil.copytree(first / "results", tmp_path / "results")


def rewritten(folder, record) -> None:
    write_json(folder / "small.json", record)
    write_text(folder / "small.md", result_page(record, read_manifests(record, folder)))


@pytest.fixture(scope="module")
def made_again() -> Iterator[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as folder:
        yield {"root": Path(folder)}


@pytest.fixture
def once(monkeypatch, made_again):
    """Train and evaluate once for all comparisons, because a changed record does not change the reproduction."""

    def first(kind, make):
        return lambda *args: made_again.get(kind) or made_again.setdefault(kind, make(*args))

    train = records._trained_run
    trained = first("run", lambda how, *_: train(how, made_again["root"], {}, print, ()))
    monkeypatch.setattr(records, "_trained_run", trained)
    policy, controller = records.evaluate_run, partial(records.evaluate_run, reference=True)
    policy, controller = first("policy", policy), first("reference", controller)
    evaluate = lambda *args, reference=False: (controller if reference else policy)(*args)  # noqa: E731
    monkeypatch.setattr(records, "evaluate_run", evaluate)


def again(written, capsys, *more: str) -> tuple[int, str]:
    status = main(["results", "small", "--again", "--into", str(written), *more])
    said = capsys.readouterr()
    return status, said.out + said.err


def leaves(value, keys=()):
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from leaves(inner, (*keys, key))
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from leaves(inner, (*keys, index))
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield keys


ALTERED = {
    ("runs", 0, "evaluation", "metrics", "stand/time_to_failure", "value"): "run 1: stand/time_to_failure is",
    ("runs", 0, "evaluation", "metrics", "stand/time_to_failure", "low"): "run 1: stand/time_to_failure is",
    ("reference", "metrics", "stand/height_rmse", "high"): "reference: stand/height_rmse is",
    ("over_seeds", "stand/time_to_failure", "mean", "value"): "over_seeds.stand/time_to_failure.mean.value is",
    ("differences", "stand/time_to_failure", "second"): "differences.stand/time_to_failure.second is",
    ("about", "physics_dt_s"): "about.physics_dt_s is",
}


def test_a_result_repeats_to_the_bit_and_every_change_in_it_is_reported(written, once, capsys):
    status, told = again(written, capsys)
    assert (status, told.splitlines()[-1]) == (0, "small: reproduced to the bit")
    whole = (written / "small.json").read_text()
    for keys, words in ALTERED.items():
        record = json.loads(whole)
        assert keys in set(leaves(record))
        node = record
        for key in keys[:-1]:
            node = node[key]
        node[keys[-1]] *= 1 + 1e-12
        rewritten(written, record)
        status, told = again(written, capsys)
        assert status == 1
        assert [line for line in told.splitlines() if line.startswith(words)], (keys, told)
        assert told.splitlines()[-1].startswith("small: not reproduced to the bit")


def test_other_networks_and_other_facts_are_reported(written, once, capsys):
    record = json.loads((written / "small.json").read_text())
    record["runs"][0]["parameters"] = "0" * 16
    record["runs"][0]["evaluation"]["metrics"]["stand/time_to_failure"]["better"] = "lower"
    rewritten(written, record)
    status, told = again(written, capsys)
    words = ("run 1: the networks are ", "run 1: stand/time_to_failure.better is higher, and was lower")
    assert (status, [word for word in words if word not in told]) == (1, [])


def test_a_page_changed_by_hand_is_reported_before_training(written, capsys):
    page = written / "small.md"
    page.write_text(page.read_text().replace("| survival |", "| Survival |"))
    status, told = again(written, capsys)
    assert status == 2
    assert "small.md: the result's page and the result's JSON file differ" in told
    assert "wheelleg train" not in told


@pytest.mark.parametrize("word", ["--reference", "--stored"])
def test_a_repeated_result_is_reported_once(written, capsys, word):
    status, told = again(written, capsys, word)
    assert status == 2
    assert "--again: the record determines the evaluations" in told


DAMAGES = [
    (lambda record: record.pop("runs"), "the key 'runs' is missing"),
    (lambda record: record.update(runs=[]), "the result record contains no run"),
    (lambda record: record["runs"][0]["train"].pop("overrides"), "the key 'runs[0].train.overrides' is missing"),
    (lambda record: record.update(name="other"), "the record is of 'other'; expected a record of its own name"),
]


@pytest.mark.parametrize(("damage", "message"), DAMAGES)
def test_an_incomplete_record_is_reported_by_its_file(written, capsys, damage, message):
    record = json.loads((written / "small.json").read_text())
    damage(record)
    write_json(written / "small.json", record)
    status, told = again(written, capsys)
    assert status == 2, told
    assert message in told
    assert "small.json" in told
    assert "wheelleg train" not in told


def test_a_record_without_the_robots_profile_is_read_and_its_page_names_none(tmp_path):
    record = json.loads((FOLDER / "stand.json").read_text())
    assert "with `profile: article`" in result_page(record, read_manifests(record, FOLDER))
    del record["about"]["profile"]  # Records of earlier versions lack this key.
    write_json(tmp_path / "stand.json", record)
    page = result_page(records.read_record(tmp_path / "stand.json"), read_manifests(record, FOLDER))
    assert "profile:" not in page


@pytest.mark.parametrize("word", ["latest", "protocol=walk", "smal"])
def test_only_results_are_repeated_and_all_are_found_before_the_first_starts(written, capsys, word):
    status, told = again(written, capsys, word)
    assert status == 2
    assert f"NAME: there is no result '{word}'" in told
    assert "wheelleg train" not in told


def test_a_training_from_a_shipped_policy_starts_again_with_this_policy(trained, tmp_path):
    run = copied(trained, tmp_path)
    path = run.hydra / "overrides.yaml"
    write_text(path, path.read_text() + "- init_from=stock:walk\n")
    manifest = json.loads((run.path / "manifest.json").read_text())
    write_json(run.path / "manifest.json", manifest | {"init_from": {"run": "walk_0123abcd", "named": "stock:walk"}})
    found = recipe(RunDirectory.open(run.path, tmp_path))
    assert (found["overrides"][-1], found["begins_with"]) == ("init_from=stock:walk", None)


def test_what_two_results_share_is_trained_once(run, written, capsys, monkeypatch):
    assert main(["results", "other", str(run.path), *SHORT, "--into", str(written)]) == 0
    trained = []
    monkeypatch.setattr(records, "_train", lambda *given: trained.append(given) or str(run.path))
    status, told = again(written, capsys, "other")
    assert (status, len(trained)) == (0, 1)
    verdicts = ["small: reproduced to the bit", "other: reproduced to the bit"]
    assert [line for line in told.splitlines() if "reproduced" in line] == verdicts


def test_on_another_machine_the_promised_precision_is_stated(written, once, capsys):
    record = json.loads((written / "small.json").read_text())
    path = written / "small" / f"{record['runs'][0]['id']}.json"
    manifest = json.loads(path.read_text())
    manifest["hardware"] |= {"cpu": "AMD Other"}
    del manifest["versions"]["mujoco-core"]  # Manifests of earlier versions state the metapackage's version alone.
    manifest["versions"]["mujoco"] = "4.0.0-old"
    write_json(path, manifest)
    rewritten(written, record)
    status, told = again(written, capsys)
    assert status == 0
    assert "differs: cpu was AMD Other, is " in told
    assert f"differs: mujoco-core was 4.0.0-old, is {mujoco.mj_versionString()}\n" in told
    assert told.endswith("small: reproduced to the bit, on another machine\n")
    record["reference"]["metrics"]["stand/height_rmse"]["value"] *= 2.0
    rewritten(written, record)
    status, told = again(written, capsys)
    assert status == 1
    assert "where hardware differed (cpu was AMD Other, is " in told
    assert told.endswith("on the same kind of machine with the same versions and source\n")


def test_the_page_has_the_numbers_the_commands_and_the_manifests(run, first, written):
    page, record = (written / "small.md").read_text(), json.loads((written / "small.json").read_text())
    assert page.startswith("# small\n\n![stand of the first run](small/stand.png)\n")
    assert (written / "small/stand.png").read_bytes().startswith(b"\x89PNG")
    assert f"on MuJoCo {mujoco.mj_versionString()} with contacts of elliptic cones, impratio 10.\n" in page
    assert page.index("| stand/survival |") < page.index("<details") < page.index("| survival |")
    assert f"SHA-256 `{record['scenarios_sha256'][:16]}" in page
    assert [word for word in ("| survival |", "\nwheelleg train env.num_envs=16 ") if word not in page] == []
    manifest = json.loads((written / "small" / f"{run.id}.json").read_text())
    assert manifest["files"]["model_2.pt"] == run.manifest().data["files"]["model_2.pt"]
    assert str(first) not in (page + json.dumps(record) + json.dumps(manifest))


def test_a_result_takes_the_place_of_an_earlier_one_with_its_manifests_and_of_nothing_else(run, written, capsys):
    record = json.loads((written / "small.json").read_text())
    record["runs"] = [{**record["runs"][0], "id": name} for name in ("another", "../outside", "folder")]
    write_json(written / "small.json", record)
    for name in ("another", "own", "../outside", "folder.json/in"):
        (written / "small" / f"{name}.json").parent.mkdir(exist_ok=True)
        write_json(written / "small" / f"{name}.json", {})
    words = ["results", "small", str(run.path), *SHORT, "--into", str(written)]
    kept = {path: path.read_bytes() for path in written.rglob("*.*") if path.is_file()}
    assert (main(words), "--replace" in capsys.readouterr().err) == (2, True)
    assert {path: path.read_bytes() for path in kept} == kept
    words.append("--replace")
    assert (main(words), {path.stem for path in (written / "small").iterdir()}) == (
        0,
        {run.id, "own", "folder", "stand"},
    )
    assert (written / "outside.json").is_file()


@pytest.mark.parametrize(
    "text", ['{"format": 2, "runs": [', '{"format": 1}', '{"format": 2, "runs": [3]}', '{"format": 2}']
)
def test_what_is_no_result_is_not_written_over(run, tmp_path, capsys, text):
    folder = tmp_path / "results"
    folder.mkdir()
    (folder / "small.json").write_text(text)
    assert main(["results", "small", str(run.path), *SHORT, "--into", str(folder)]) != 0
    assert str(folder / "small.json") in capsys.readouterr().err
    assert ((folder / "small.json").read_text(), [path.name for path in folder.iterdir()]) == (text, ["small.json"])


def test_a_run_that_was_resumed_exactly_to_go_on_for_longer_is_one_training_of_that_length(run):
    data = json.loads((run.path / "manifest.json").read_text())
    longer = {"exact": True, "overrides": ["agent.max_iterations=9"]}
    write_json(run.path / "manifest.json", {**data, "resumes": [{"exact": True, "overrides": []}, longer]})
    lengths = [word for word in recipe(run)["overrides"] if word.startswith("agent.max_iterations")]
    assert lengths == ["agent.max_iterations=9"]
    elsewhere = {"section": "hardware", "name": "cpu_model", "was": "1", "now": "2"}
    moved = {"exact": False, "overrides": [], "why": ["hardware cpu_model was 1 and is 2"], "differences": [elsewhere]}
    threads = {"section": "threads", "name": "torch", "was": 2, "now": 1}
    fewer = {**moved, "overrides": ["agent.torch_threads=1"], "why": ["", ""], "differences": [elsewhere, threads]}
    both = {**fewer, "overrides": ["agent.torch_threads=1", "agent.max_iterations=9"]}
    for changed in ([moved], [fewer], [fewer, both]):
        write_json(run.path / "manifest.json", {**data, "resumes": changed})
        assert recipe(run)
    assert [word for word in recipe(run)["overrides"] if word.startswith("agent.max_iterations")] == lengths
    before = {"hardware": {"cpu": "Abacus", "cores_usable": 7}, "process": {"host": "secret"}}
    named = {"init_from": {"run": "walk_0123abcd", "named": "/home/secret/first"}}
    write_json(run.path / "manifest.json", {**data, **named, "resumes": [{**moved, "before": before}]})
    kept = result_manifest(run)
    assert kept["init_from"]["named"] == "first"
    assert next(machines_of(read_facts(ProcessFacts, kept, "broken", "here"))) == "Abacus, 7 cores"
    on_gpu = {**kept, "resumes": [], "threads": {"device": "cuda:0"}}
    assert next(machines_of(read_facts(ProcessFacts, on_gpu, "broken", "here"))).endswith(" cores and a GPU")
    assert "secret" not in json.dumps(kept)
    code = {**moved, "differences": [{**elsewhere, "section": "code"}]}
    versions = {**moved, "differences": [{**elsewhere, "section": "versions", "name": "torch"}]}
    device = {**fewer, "differences": [elsewhere, {**threads, "name": "device"}]}
    inexact, changed = {"exact": False, "overrides": []}, {"exact": True, "overrides": ["agent.algorithm.gamma=0.9"]}
    others = [{"resumes": [entry]} for entry in (code, versions, device, inexact, changed)]
    for other in (*others, {"status": "interrupted"}):
        write_json(run.path / "manifest.json", {**data, **other})
        with pytest.raises(RunDirectoryError, match="not an uninterrupted training"):
            recipe(run)


def test_runs_of_one_result_differ_by_their_seed_alone(run):
    data = json.loads((run.path / "manifest.json").read_text())
    require_one_method([run, run])
    longer = {"exact": True, "overrides": ["agent.max_iterations=9"]}
    with tempfile.TemporaryDirectory() as folder:
        other = RunDirectory(shutil.copytree(run.path, Path(folder) / "small" / "other"))
        write_json(other.path / "manifest.json", {**data, "resumes": [longer]})
        said = f"was trained differently from {run.id}: with agent.max_iterations=9, without agent.max_iterations="
        with pytest.raises(RunDirectoryError, match=re.escape(said)):
            require_one_method([run, other])


def test_a_student_is_no_result_because_its_teacher_is_not_stored(run):
    (run.asset / TEACHER).parent.mkdir(exist_ok=True)
    (run.asset / TEACHER).write_bytes(b"")
    with pytest.raises(RunDirectoryError, match="another run's policy"):
        recipe(run)


@pytest.mark.parametrize("name", ["../outside", "a/b", "", ".."])
def test_a_page_has_no_path_for_a_name(run, capsys, tmp_path, name):
    assert main(["results", name, str(run.path), *SHORT, "--into", str(tmp_path / "results")]) == 2
    assert "is not a valid name for a results page" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.md"))


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.json")), ids=lambda path: path.stem)
def test_every_page_of_the_docs_shows_its_record_and_marks_verdicts_that_depend_on_the_seeds(path):
    record, manifests = read_result(path.stem, FOLDER)
    lines = result_page(record, manifests).partition("<details")[2].splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith("| ")]
    marked = sorted(row[0] for row in rows if row[-1].endswith(" ¹"))
    zero = sorted(
        name.partition("/")[2]
        for name, found in record["differences"].items()
        if found["outcome"] and found["interval"]["low"] < 0 < found["interval"]["high"]
    )
    assert marked == (zero if len(record["runs"]) > 1 else [])
    # On these pages, all verdicts are clear for all seeds.
    assert bool(zero) == (path.stem not in ("jump", "push_physical"))
    assert "¹" not in result_page({**record, "runs": record["runs"][:1]}, manifests[:1])


@pytest.mark.parametrize(
    ("words", "iteration", "said"),
    [
        (["env.num_envs=8"], 9, "the run it starts with was trained with env.num_envs=8"),
        ([], 19, "it starts with another checkpoint"),
    ],
)
def test_what_runs_began_with_is_of_one_method_too(run, monkeypatch, words, iteration, said):
    def begun(iteration: int, *words: str) -> dict[str, Any]:
        parent = {"overrides": ["task=walk", *words], "begins_with": None, "iteration": None}
        return {"overrides": ["task=velocity"], "begins_with": parent, "iteration": iteration}

    recipes = iter([begun(9), begun(iteration, *words)])
    monkeypatch.setattr(records, "recipe", lambda _: next(recipes))
    with pytest.raises(RunDirectoryError, match=f"was trained differently from {run.id}: {said};"):
        require_one_method([run, run])


def test_the_verdict_states_where_equal_bits_are_promised():
    cpu = FactDifference("hardware", "cpu", "AMD", "Intel", "another CPU")
    assert records.Reproduction([], [], False).verdict == "reproduced to the bit"
    same = records.Reproduction(["a is 1, and was 2"], [], False).verdict
    assert same == "not reproduced to the bit, with the same source, on the same kind of machine"
    other = records.Reproduction(["a is 1, and was 2"], [cpu], True).verdict
    assert "it was made with other source files; where hardware differed (cpu was AMD, is Intel)" in other
    assert "on the same kind of machine" in other
