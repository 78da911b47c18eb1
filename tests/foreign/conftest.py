"""One healthy training run for all trials, and a copy of the run for each trial."""

import functools
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from jobs.small import cache_of

from foreign.trial import SECRET, VARIABLE, Trial
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.jobs import play_policy
from wheelleg_exp.jobs.train import run_training
from wheelleg_exp.recording.reading import recording_digest
from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.report import plot_images
from wheelleg_exp.report.page_blocks import Plot
from wheelleg_exp.run.run_directory import RunDirectory

_LIMIT_S = 240


@pytest.fixture(autouse=True, scope="module")
def _threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def _against_hanging() -> Iterator[None]:
    def stuck(*_: object) -> None:
        raise TimeoutError("a command does not end")

    before = signal.signal(signal.SIGALRM, stuck)
    signal.alarm(_LIMIT_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@functools.cache
def _composed(words: tuple[str, ...], primary: str, folders: tuple[Path, ...]) -> object:
    return compose(words, primary=primary, config_dirs=folders)


_known: dict[bytes, dict[str, str]] = {}


def _digests_once(path: Path) -> dict[str, str]:
    """Compute the digests of equal recordings once, because most trials do not change the recording."""
    content = path.read_bytes()
    if content not in _known:
        _known[content] = entity_digests(path)
    return _known[content]


@pytest.fixture
def trial(trained, tmp_path, tmp_path_factory, monkeypatch) -> Trial:
    """Return a trial with a copy of the healthy run in a folder of the test."""

    def once(overrides=(), *, primary="train", config_dirs=()):
        return _composed(tuple(overrides), primary, tuple(config_dirs))

    monkeypatch.setattr(plot_images, "_plot", lambda panel: Plot(None, panel.title))
    monkeypatch.setattr(recording_digest, "entity_digests", _digests_once)
    monkeypatch.setattr(play_policy, "compose", once)
    monkeypatch.setattr("wheelleg_exp.config.composing.compose.compose", once)
    monkeypatch.setenv("WHEELLEG_CACHE", str(cache_of(tmp_path_factory)))
    monkeypatch.setenv(VARIABLE, SECRET)
    run = tmp_path / "runs" / "stand" / trained.run.id
    shutil.copytree(trained.run.path, run)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert run_training  # Import the module before the trial compares the files on disk.
    return Trial(tmp_path, RunDirectory(run.resolve()), trained.run)
