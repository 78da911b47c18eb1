import io
import json
import re
from contextlib import redirect_stderr, redirect_stdout

import pytest

from verify import synthetic
from wheelleg_exp.cli.main import main
from wheelleg_exp.recording.reading import recording_contents
from wheelleg_exp.run.file_inventory import inventory

DAMAGES = {
    "missing": lambda path: path.unlink(),
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-3]),
    "flipped": synthetic.flip,
    "empty": lambda path: path.write_bytes(b""),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.fixture
def pair(copy_run):
    runs = copy_run("a"), copy_run("b")
    for run in runs:
        (run.hydra / "overrides.yaml").write_text("[]\n")
        (run.play / "one").mkdir(parents=True)
        (run.play / "one" / "figures.json").write_text("{}\n")
        synthetic.write_recording(run.play / "one" / "recording.rrd")
        synthetic.record(run)
    return runs


def damaged(damage, *runs, part=slice(None)):
    for name in [*inventory(runs[0].path)][part]:
        whole = [(run.path / name, (run.path / name).read_bytes()) for run in runs]
        for path, _ in whole:
            DAMAGES[damage](path)
        yield name
        for path, content in whole:
            if path.is_dir():
                path.rmdir()
            path.write_bytes(content)


def wheelleg(*words):
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        status = main([str(word) for word in words])
    return status, re.sub(r"\n {4,}", " ", out.getvalue()), err.getvalue()


CASES = [("missing", "A"), *((damage, "B") for damage in DAMAGES), ("missing", "AB"), ("flipped", "AB")]


@pytest.mark.parametrize(("number", "case"), enumerate(CASES))
def test_two_runs_of_which_a_file_is_damaged_are_different_and_the_file_and_its_run_are_named(pair, number, case):
    damage, sides = case
    for name in damaged(damage, *(pair["AB".index(side)] for side in sides), part=slice(number % 2, None, 2)):
        status, out, err = wheelleg("verify", pair[0].path, pair[1].path)
        assert (status, err) == (1, ""), (name, out, err)
        lines = out.splitlines()
        assert lines[-1].startswith("different: damaged: "), (name, out)
        for side in sides:
            assert any(line.startswith(f"{side}: {name} ") for line in lines), (name, out)


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_run_of_which_a_file_is_damaged_is_not_sound_and_the_file_is_named(pair, damage):
    for name in damaged(damage, pair[0]):
        status, out, err = wheelleg("verify", pair[0].path)
        assert (status, err) == (1, ""), (name, out, err)
        lines = out.splitlines()
        assert lines[-1].startswith("damaged: "), (name, out)
        assert any(line.startswith(f"  {name} ") for line in lines), (name, out)


@pytest.mark.parametrize("words", [["verify"], ["resume"], ["play"], ["replay"], ["diff", "task=stand"]])
def test_a_manifest_of_brackets_is_wrong_input(pair, words):
    (pair[0].path / "manifest.json").write_text("[" * 100_000)
    status, out, err = wheelleg(words[0], pair[0].path, *words[1:])
    assert (status, out, "manifest.json" in err) == (2, "", True)


WRONG = [(key, 5) for key in ("error", "seeds", "source", "process", "threads", "command", "resumes", "additions")]
WRONG += [("resumes", [entry]) for entry in (5, {"iteration": "x"}, {"overrides": True}, {"before": []})]
WRONG += [("additions", [5]), ("files", {"x": {"sha256": 1, "size": 1}})]


@pytest.mark.parametrize(("key", "value"), WRONG)
def test_a_manifest_with_a_value_of_another_type_is_wrong_input(pair, key, value):
    synthetic.edit(pair[0], lambda data: data.update({key: value}))
    status, out, err = wheelleg("verify", pair[0].path)
    assert (status, out, "manifest.json" in err) == (2, "", True)


def test_a_manifest_that_was_changed_is_never_identical(pair):
    data = json.loads((pair[1].path / "manifest.json").read_text())
    (pair[1].path / "manifest.json").write_text(json.dumps({**data, "id": "another"}))
    status, out, _ = wheelleg("verify", pair[0].path, pair[1].path)
    assert status == 1
    assert "different: damaged: B: manifest.json was changed after it was written" in out


def test_a_changed_recording_is_not_decoded_in_this_process(pair, monkeypatch):
    decoded, stores = [], recording_contents._stores
    monkeypatch.setattr(recording_contents, "_stores", lambda path: decoded.append(path) or stores(path))
    synthetic.flip(pair[0].recording)
    for words in ([pair[0].path], [pair[0].path, pair[1].path], [pair[1].path, pair[0].path]):
        assert wheelleg("verify", *words)[0] == 1
    assert decoded
    assert pair[0].recording not in decoded


@pytest.mark.parametrize("name", ["recording.rrd", "exported/policy.onnx", "iterations.jsonl", "asset/robot.xml"])
def test_what_a_finished_run_must_have_is_missed_though_its_manifest_never_named_it(pair, name):
    for run in pair:
        (run.path / name).unlink()
        synthetic.record(run)
    status, out, err = wheelleg("verify", pair[0].path)
    assert (status, err) == (1, "")
    assert f"  {name} is missing, and the manifest does not list it" in out.splitlines()
    status, out, err = wheelleg("verify", *(run.path for run in pair))
    assert (status, err) == (1, "")
    assert f"B: {name} is missing, and the manifest does not list it" in out.splitlines()


SEALED_AGAIN = {
    "config": (lambda run: synthetic.flip(run.hydra / "config.yaml"), "params/env.yaml is not the config's env"),
    "patch": (lambda run: synthetic.flip(run.source / "source.patch"), "source/source.patch is not the patch"),
    "no patch": (lambda run: (run.source / "source.patch").unlink(), "source/source.patch is missing"),
    "checkpoint": (lambda run: run.checkpoint(4).unlink(), "last checkpoint is model_4.pt"),
    "recording": (lambda run: synthetic.flip(run.recording), "messages are damaged"),
}


@pytest.mark.parametrize("side", ["A", "B"])
@pytest.mark.parametrize("change", SEALED_AGAIN)
def test_files_that_contradict_each_other_are_damage_though_the_manifest_was_rewritten_and_sealed(pair, change, side):
    alter, words = SEALED_AGAIN[change]
    run = pair["AB".index(side)]
    alter(run)
    synthetic.record(run)
    status, out, err = wheelleg("verify", pair[0].path, pair[1].path)
    assert (status, err) == (1, "")
    last = out.splitlines()[-1]
    assert last.startswith(f"different: damaged: {side}: "), out
    assert words in last
    alone = wheelleg("verify", *[one.path for one in pair], "--iterations", 1)[1].splitlines()[-1]
    assert alone.startswith("different" if change in ("config", "patch", "no patch") else "identical"), alone


def test_later_files_have_no_part_in_the_first_iterations(pair):
    for name in ("recording.rrd", "exported/policy.pt", "model_4.pt", "play/one/figures.json"):
        (pair[1].path / name).unlink()
    both = [run.path for run in pair]
    assert wheelleg("verify", *both, "--iterations", "3")[0] == 0
    (pair[1].path / "model_2.pt").unlink()
    status, out, _ = wheelleg("verify", *both, "--iterations", "3")
    assert status == 1
    assert out.splitlines()[-1].startswith("different: damaged: B: model_2.pt is missing; ")
