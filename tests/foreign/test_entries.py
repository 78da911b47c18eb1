import os
from collections.abc import Callable

import pytest
from jobs.small import wheelleg

from foreign.trial import Trial, every_second
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.run_lock import RunLock

pytestmark = pytest.mark.train

FILES = (
    *(".lock", ".manifest.lock", "params/env.yaml", "params/agent.yaml", ".hydra/config.yaml", ".hydra/overrides.yaml"),
    *("source/git.json", "environment.txt", "iterations.jsonl", "model_2.pt", "recording.rrd", "report.html"),
    *("asset/robot.xml", "asset/asset.json", "exported/policy.json", "events.out.tfevents.9"),
)
FOLDERS = ("params", ".hydra", "source", "asset", "exported", "play", "evaluation")
COMMANDS = ("play", "resume", "inspect", "diff", "compare", "replay")


def try_all(trial: Trial, name: str, what: str) -> None:
    """Check that no command follows the entry ``name`` of the run, and that the commands report the entry."""
    trial.try_each(COMMANDS, 2, name, what)
    trial.try_("verify", 1, f"{name} is {what}")
    trial.try_("list", 0)


@pytest.mark.parametrize("name", [*FILES[1::2], *FOLDERS])
def test_a_link_is_not_followed(trial, name):
    precious = trial.outside()
    trial.replace(name, lambda path: path.symlink_to(precious if name in FILES else precious.parent))
    try_all(trial, name, "a symbolic link")


@pytest.mark.parametrize("target", ["/dev/zero", "/dev/stdin", "manifest.json", "nowhere", "."])
def test_where_a_link_leads_does_not_matter(trial, target):
    trial.replace("model_2.pt", lambda path: path.symlink_to(target))
    try_all(trial, "model_2.pt", "a symbolic link")


@pytest.mark.parametrize("name", FILES[::2])
def test_a_pipe_is_not_read(trial, name):
    trial.replace(name, os.mkfifo)
    try_all(trial, name, "a pipe, a socket or a device")


READ = ["params/env.yaml", "iterations.jsonl", "recording.rrd", "source/git.json"]


@pytest.mark.parametrize(("name", "make"), every_second(READ, [os.mkfifo, lambda path: path.symlink_to("/dev/zero")]))
def test_a_report_names_it_and_reads_nothing_of_it(trial, name, make):
    trial.replace(name, make)
    trial.try_("report", 0, name)


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")], ids=["pipe", "device"])
def test_a_manifest_that_is_a_pipe_or_a_device_is_refused(trial, make):
    trial.replace("manifest.json", make)
    trial.try_each(("play", "resume", "compare", "replay", "verify", "report"), 2, "manifest.json")
    trial.try_("inspect", 0)  # The folder contains a recording but is not a run directory.
    trial.try_("list", 0)


def test_a_lock_empties_nothing_that_it_leads_to(trial):
    precious = trial.outside()
    trial.replace(".lock", lambda path: path.symlink_to(precious))
    with pytest.raises(RunDirectoryError):
        RunLock(trial.run).acquire()
    assert precious.read_text()


def test_a_checkpoint_named_on_the_command_line_may_be_a_link(trial):
    link = trial.root / "here" / "best.pt"
    link.symlink_to(trial.healthy.path / "model_2.pt")
    assert wheelleg(*trial.words("play"), "--checkpoint", link).status == 0


ODD = "\x1b[2J\x9b31m\r\x07\u202e"
PLANTS: dict[str, Callable[[Trial], None]] = {
    "names": lambda trial: [(trial.run.path / os.fsdecode(n)).touch() for n in (f"a{ODD}.rrd", b"\xff\xfe")],
    "task and error": lambda trial: trial.manifest(task=ODD, status="failed", error={"type": ODD, "message": ODD}),
    "status": lambda trial: trial.manifest(status=ODD),
    "files": lambda trial: trial.manifest(files={ODD: {"sha256": ODD, "size": 1}}),
    "results": lambda trial: trial.manifest(results={ODD: ODD}),
    "resumes": lambda trial: trial.manifest(resumes=[{"when": ODD, "why": [ODD], "overrides": [ODD], "exact": False}]),
    "config": lambda trial: trial.yaml("params/env.yaml", lambda env: env.update({ODD: ODD})),
}


@pytest.mark.parametrize("plant", PLANTS.values(), ids=PLANTS)
def test_no_text_of_a_run_reaches_the_terminal_as_more_than_text(trial, plant):
    plant(trial)
    for command in ("list", "verify", "compare", "diff"):
        said = trial.try_(command, (0, 1, 2))
        assert not {"\x1b", "\x9b", "\r", "\x07", "\u202e"} & set(said.out + said.err)


def test_a_run_with_such_a_name_is_reported_by_the_codes_of_its_name(trial):
    moved = trial.run.path.parent / f"a{ODD}b"
    trial.run.path.rename(moved)
    trial.run = RunDirectory(moved)
    trial.try_each(("list", "verify", "report", "play"), (0, 1, 2), "\\x1b[2J\\x9b31m")
