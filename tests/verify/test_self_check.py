import contextlib
import hashlib
import json
import os
import shutil

import pytest
import torch

from verify import synthetic
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.recording.rrd_file import RrdFile
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.run import file_inventory
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_lock import this_process
from wheelleg_exp.verify import verify_run


@pytest.fixture
def run(copy_run):
    return copy_run("one")


def failures(run):
    found = verify_run(run)
    wrong = {check.name: check.failures for check in found.checks if check.failures}
    assert (found.is_sound, found.verdict) == (not wrong, "damaged" if wrong else "sound")
    assert found.lines()[-1].startswith(found.verdict)
    return wrong


def notes(run):
    assert failures(run) == {}
    return [note for check in verify_run(run).checks for note in check.notes]


def only(run, check, *words):
    wrong = failures(run)
    assert list(wrong) == [check], wrong
    (failure,) = wrong[check]
    assert [word for word in words if word not in failure] == []


def test_a_whole_run_is_sound_and_every_check_is_made(run):
    found = verify_run(run)
    names = ["files", "params", "source", "asset", "iterations", "checkpoints", "failure", "recording", "exported"]
    # The copy of the run has another name.
    assert {check.name: check.state for check in found.checks} == {"manifest": "note", **dict.fromkeys(names, "ok")}
    assert "3 files; 3 agree" in "\n".join(found.lines())
    assert json.loads(json.dumps(found.as_dict()))["verdict"] == "sound"


def test_a_flipped_bit_anywhere_in_the_manifest_is_found(run):
    path = run.path / "manifest.json"
    whole = path.read_bytes()
    number = whole.index(b"14.0") + 3  # Additional digits of this float do not change its value.
    path.write_bytes(whole[:number] + b"0000000000000000000" + whole[number:])
    only(run, "manifest", "manifest.json was changed")
    for at in {*range(0, len(whole), 97), number, len(whole) - 1}:
        path.write_bytes(whole)
        synthetic.flip(path, at)
        with contextlib.suppress(RunDirectoryError):  # The changed file is not a valid manifest.
            assert failures(run), at
    path.write_bytes(whole)
    assert failures(run) == {}


def test_what_a_later_command_adds_does_not_hide_a_change(run):
    path = run.path / "manifest.json"
    path.write_bytes(path.read_bytes().replace(b'"seconds": 1.5', b'"seconds": 9.5'))
    run.manifest().add("export", [], {"a": 1})
    assert '"seconds": 9.5' in path.read_text()
    only(run, "manifest", "manifest.json was changed")


def of_format_1(run, **digest):
    data = {k: v for k, v in run.manifest().data.items() if k != "sha256"} | {"format": 1}
    if digest:
        content = json.dumps(data, sort_keys=True)
        data["sha256"] = digest["flipped"] if "flipped" in digest else hashlib.sha256(content.encode()).hexdigest()
    (run.path / "manifest.json").write_text(json.dumps(data, indent=2))


def test_a_manifest_of_format_1_is_checked_by_its_values_and_named(run):
    of_format_1(run)
    assert any("no digest of itself" in note for note in notes(run))
    of_format_1(run, flipped="0" * 64)
    only(run, "manifest", "manifest.json was changed")
    of_format_1(run, digest=True)
    assert any("its digest is of rounded values" in note for note in notes(run))
    run.manifest().add("export", [], {"a": 1})
    data = run.manifest().data
    assert (data.pop("sha256", None) is not None, data["format"], failures(run)) == (True, 2, {})
    (run.path / "manifest.json").write_text(json.dumps(data))
    only(run, "manifest", "manifest.json was changed")


def test_a_users_file_or_link_is_noted_and_a_link_in_place_of_a_file_is_wrong(run, tmp_path):
    (run.path / "notes.txt").write_text("mine")
    (run.path / "play").mkdir()
    (run.path / "play" / "half.rrd").write_bytes(b"")
    assert [note.split()[0] for note in notes(run) if "does not list it" in note] == ["notes.txt", "play/half.rrd"]
    target = tmp_path / "elsewhere"
    shutil.move(run.path / "environment.txt", target)
    for name in ("environment.txt", "other"):
        (run.path / name).symlink_to(target)
    assert failures(run)["files"] == ["environment.txt is a symbolic link, which may lead anywhere"]
    assert any("other is a symbolic link" in n for check in verify_run(run).checks for n in check.notes)


@pytest.mark.parametrize("name", ["model_9.pt", "failure.npz", "params/extra.yaml", "exported/policy2.onnx"])
def test_a_file_that_commands_would_treat_as_part_of_the_run_is_wrong(run, name):
    (run.path / name).write_bytes(b"x")
    assert any(f.startswith(name) and "not in the manifest" in f for f in failures(run)["files"])


def test_a_file_that_cannot_be_read_is_named_and_the_others_are_still_checked(run, monkeypatch):
    read = file_inventory.sha256

    def deny(path):
        if path.name == "environment.txt":
            raise RunDirectoryError(f"cannot read '{path}'")
        return read(path)

    monkeypatch.setattr(file_inventory, "sha256", deny)
    synthetic.flip(run.path / "events.out.tfevents.1")
    assert [f.split()[0] for f in failures(run)["files"]] == ["events.out.tfevents.1", "environment.txt"]


@pytest.mark.parametrize(
    ("change", "check", "words"),
    [
        (lambda run: (run.path / "events.out.tfevents.1").write_bytes(b"x" * 10), "files", ["10 bytes instead of 6"]),
        (lambda run: synthetic.edit_params(run, lambda env, agent: env["rewards"]["alive"].update(weight=1.5)),
         "params", ["env.rewards.alive.weight", "1.5", "1.0"]),
        (lambda run: synthetic.edit(run, lambda data: data.update(seeds=[4])), "params", ["seed is 3", "4"]),
        (lambda run: synthetic.flip(run.source / "source.patch"), "source", ["source.patch"]),
        (lambda run: synthetic.edit(run, lambda data: data["source"].update(commit="f" * 40)),
         "source", ["commit", "f" * 40]),
        (lambda run: run.iterations.write_text(run.iterations.read_text() + '{"iteration": 5, "dig'),
         "iterations", ["cut off"]),
        (lambda run: synthetic.edit(run, lambda data: data["results"].update({"Train/mean_reward": 15.0})),
         "iterations", ["Train/mean_reward", "15.0", "14.0"]),
        (lambda run: run.recording.write_bytes(run.recording.read_bytes()[:-40]), "recording", []),
        (lambda run: synthetic.flip(path := run.exported / "policy.pt", path.read_bytes().index(b"weights")),
         "exported", ["policy.pt"]),
    ],
)  # fmt: skip
def test_a_contradiction_is_found_by_one_check(run, change, check, words):
    change(run)
    if check != "files":  # The other checks find the change although the manifest records the changed file.
        synthetic.record(run)
    wrong = failures(run)
    assert (list(wrong), [word for word in words if word not in " ".join(wrong[check])]) == ([check], [])


@pytest.mark.parametrize(
    ("change", "part"),
    [
        (lambda s: s["actor_state_dict"]["weight"].__setitem__((1, 1), 0.5), "parameters"),
        (lambda s: s["optimizer_state_dict"]["param_groups"][0].update(lr=2e-3), "optimizer"),
        (lambda s: s["env"]["state"].__setitem__((0, 0), 0.5), "environment"),
        (lambda s: s["env"]["streams"]["events"].__setitem__(0, 9), "streams"),
        (lambda s: s["rng"]["torch"].__setitem__(0, 9), "streams"),
        (lambda s: s["log"].update(returns=[1.0, 3.0]), "log"),
        (lambda s: s["actor_state_dict"].update(bias=torch.tensor([0.5, 0.0, float("nan")])), "parameters"),
    ],
)
def test_a_checkpoint_that_is_not_what_the_log_saw_is_wrong_whatever_was_changed(run, change, part):
    synthetic.edit_state(run, 2, change)
    synthetic.record(run)
    only(run, "checkpoints", "model_2.pt", f"digests of {part}")


def test_a_checkpoint_of_another_iteration_or_beyond_the_log_is_wrong(run):
    shutil.copyfile(run.path / "model_0.pt", run.path / "model_2.pt")
    content = checkpoint.load(run.path / "model_4.pt", finite=False)
    (run.path / "model_7.pt").write_bytes(checkpoint.serialize({**content, "iter": 7}))
    synthetic.record(run)
    wrong = failures(run)["checkpoints"]
    assert any("model_2.pt is of iteration 0" in failure for failure in wrong)
    assert any("model_7.pt" in failure and "not in the log" in failure for failure in wrong)


def test_a_checkpoint_that_contains_code_is_refused_and_the_code_never_runs(run, tmp_path):
    planted = type("Planted", (), {"__reduce__": lambda self: (os.mkdir, (str(tmp_path / "ran"),))})
    torch.save({"iter": 2, "x": planted()}, run.path / "model_2.pt")
    synthetic.record(run)
    only(run, "checkpoints", "model_2.pt", "cannot be read as a checkpoint")
    assert not (tmp_path / "ran").exists()


def test_a_run_that_ends_before_the_iteration_of_its_results_is_wrong(run):
    synthetic.shorten(run, 3)
    synthetic.record(run)
    assert set(failures(run)) == {"iterations", "checkpoints"}


def test_digests_of_an_earlier_definition_are_reported_and_not_counted(run):
    for iteration in range(synthetic.ITERATIONS):
        synthetic.edit_line(run, iteration, lambda line: line.pop("digest_format"))
    synthetic.record(run)
    assert any("another definition" in note for note in notes(run))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda lines: lines.pop(2), ["line 3", "gap", "2 was expected"]),
        (lambda lines: lines.insert(3, lines[2]), ["line 4", "repeats iteration 2"]),
        (lambda lines: lines.__setitem__(1, "{half"), ["line 2", "cannot be read"]),
        (lambda lines: lines.pop(0), ["line 1", "0 was expected"]),
    ],
)
def test_iterations_that_do_not_follow_each_other_are_wrong(run, change, words):
    lines = run.iterations.read_text().splitlines()
    change(lines)
    run.iterations.write_text("\n".join(lines) + "\n")
    synthetic.record(run)
    (failure,) = failures(run)["iterations"]
    assert [word for word in words if word not in failure] == []


def test_a_recording_without_an_index_is_damage_unless_the_run_left_it_so(run):
    file = RrdFile(run.recording)
    content = file.header + b"".join(file.body())
    run.recording.write_bytes(content)
    assert "files" in failures(run)
    synthetic.record(run)
    (note,) = [note for note in notes(run) if "index" in note]
    assert "wheelleg inspect RUN --repair" in note
    synthetic.edit(run, lambda data: data.update(recording_unfinished="no room"))
    assert any("(no room)" in note for note in notes(run))
    synthetic.edit(run, lambda data: data["files"].pop("recording.rrd"))
    assert set(failures(run)) == {"files", "recording"}
    run.recording.write_bytes(content[:-10])  # The recording ends in the middle of a message.
    synthetic.record(run)
    assert list(failures(run)) == ["recording"]


def test_a_crashed_run_is_sound_as_far_as_it_came(run):
    synthetic.crash(run)
    run.iterations.write_text(run.iterations.read_text() + '{"iteration": 5, "dig')
    run.recording.write_bytes(run.recording.read_bytes()[:-40])
    told = notes(run)
    assert verify_run(run).status == "crashed"
    for words in ("recorded when the run ends", "wheelleg resume", "cut off"):
        assert any(words in note for note in told), words


def test_a_running_run_is_sound_and_the_settings_of_a_crashed_run_are_still_checked(run):
    synthetic.crash(run)
    process = run.manifest().data["process"]
    synthetic.edit(run, lambda data: data.update(process=this_process()))
    assert (failures(run), verify_run(run).status) == ({}, "running")
    synthetic.edit(run, lambda data: data.update(process=process))
    (run.params / "more.yaml").write_text("x: 1\n")
    only(run, "files", "params/more.yaml")
    synthetic.flip(run.params / "env.yaml")
    assert any("params/env.yaml was changed" in f for f in failures(run)["files"])


def test_a_run_that_stopped_before_its_first_step_is_reported_as_such(run):
    synthetic.crash(run)
    synthetic.edit(run, lambda data: data.update(source={}, files={}))
    for path in (*run.checkpoints(), run.iterations, run.recording, run.params / "agent.yaml"):
        path.unlink()
    shutil.rmtree(run.source)
    assert failures(run) == {}


def test_a_checkpoint_from_before_a_resume_is_checked_against_its_old_record(run):
    before = {"files": dict(run.manifest().data["files"])}
    entry = {"when": "2026-11-20T10:00:00.000000Z", "iteration": 3, "overrides": [], "exact": True, "before": before}
    synthetic.crash(run)
    synthetic.edit(run, lambda data: data["resumes"].append(entry))
    assert any("resumed" in note and "exactly" in note for note in notes(run))
    (run.path / "model_4.pt").write_bytes(b"")  # The resume rewrote this checkpoint.
    (run.path / "model_4.pt").unlink()
    assert failures(run) == {}
    synthetic.flip(run.path / "model_2.pt")
    assert "model_2.pt was changed after it was recorded" in failures(run)["files"]


def test_a_resume_that_broke_off_before_it_wrote_its_settings_is_no_damage(run):
    old = (run.params / "agent.yaml").read_text()
    synthetic.edit_params(run, lambda env, agent: agent["algorithm"].update(gamma=0.5))
    synthetic.record(run)
    synthetic.crash(run)
    (run.params / "agent.yaml").write_text(old)
    assert "files" in failures(run)
    entry = {"when": "2026-11-20T10:00:00.000000Z", "files_to_write": {"params/agent.yaml": "..."}}
    synthetic.edit(run, lambda data: data["resumes"].append(entry))
    assert any("params/agent.yaml is not rewritten yet" in note for note in notes(run))


@pytest.mark.parametrize("recorded", [{}, {"RATE": "0.25"}])
def test_a_setting_from_the_environment_is_checked_against_the_record(run, monkeypatch, recorded):
    monkeypatch.setenv("RATE", "0.75")  # by now
    config = (run.hydra / "config.yaml").read_text()
    (run.hydra / "config.yaml").write_text(config.replace("gamma: 0.99", "gamma: ${oc.decode:${oc.env:RATE}}"))
    synthetic.edit_params(run, lambda env, agent: agent["algorithm"].update(gamma=0.25))
    synthetic.record(run)
    synthetic.edit(run, lambda data: data.update(config_variables=recorded))
    assert bool([note for note in notes(run) if "agent.algorithm.gamma" in note]) == (not recorded)
    synthetic.edit_params(run, lambda env, agent: agent.update(max_iterations=6))
    synthetic.record(run)
    only(run, "params", "agent.max_iterations")


def test_what_is_no_run_is_an_error_for_people(run, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunDirectoryError, match="no manifest"):
        verify_run(RunDirectory(tmp_path / "empty"))
    synthetic.edit(run, lambda data: data.update(format=99))
    with pytest.raises(RunDirectoryError, match="format 99"):
        verify_run(run)
