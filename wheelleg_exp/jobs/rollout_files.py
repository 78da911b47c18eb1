"""Files that a job writes about its rollouts: their folder, the recording and its texts, and the dataset."""

from __future__ import annotations

import io
import re
import shlex
import shutil
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Self

import numpy as np

from wheelleg_exp.config.schema import PlayRecording, RecordingOptions
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.files import dump_json, read_text, sha256, while_running, write_bytes
from wheelleg_exp.managers.recorder_manager import Arrays
from wheelleg_exp.plain_data import dump_yaml, json_value
from wheelleg_exp.recording.blueprint import FIGURES
from wheelleg_exp.recording.writing.live_view import LiveView
from wheelleg_exp.recording.writing.recorder import Recorder
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.run_config import CONFIG
from wheelleg_exp.run.run_directory import RunDirectory, create_exclusively

_MAX_CHARACTERS = 400_000  # The Rerun viewer cannot show texts of more than 400,000 characters.


def fenced(text: str, language: str) -> str:
    """Return ``text`` as a code block of Markdown."""
    if len(text) > _MAX_CHARACTERS:
        text = f"{text[:_MAX_CHARACTERS]}\n… ({len(text)} characters in all)"
    return f"```{language}\n{text.rstrip()}\n```"


def run_documents(directory: RunDirectory) -> dict[str, str]:
    """Return the readable documents of a run directory: manifest, source state, command line, config."""
    found = {}
    files = (("manifest", MANIFEST_NAME, "json"), ("git", "source/git.json", "json"), ("config", CONFIG, "yaml"))
    for title, name, language in files:
        try:
            text = read_text(directory.path / name)
        except RunDirectoryError:
            continue
        found[title] = fenced(text, language)
        if title == "manifest":
            with suppress(ValueError, LookupError, TypeError):
                found |= command_document([str(word) for word in json_value(text)["command"]])
    return found


def command_document(command: Sequence[str]) -> dict[str, str]:
    """Return a command line as a text document for a recording; an empty command line gives no document."""
    return {"command": fenced(shlex.join(command), "sh")} if command else {}


def config_document(config: Mapping[str, object]) -> dict[str, str]:
    """Return a composed config as a text document for a recording."""
    return {"config": fenced(dump_yaml(dict(config)), "yaml")}


class ObservingRecording:
    """A context manager that records every control step of an environment; ``notes`` are the recording's warnings."""

    def __init__(self, env: ManagerBasedRLEnv, recorder: Recorder, *, live: bool) -> None:
        self._env, self._recorder, self._is_live = env, recorder, live
        self._live: LiveView | None = None
        self.notes: Sequence[str] = ()

    def __enter__(self) -> Self:
        self._env.observers.append(self._recorder.capture)
        self._begin_recording()
        self._recorder.flush()
        if self._is_live:
            self._live = LiveView(self._recorder)
        return self

    def __exit__(self, *error: object) -> None:
        self._env.observers.remove(self._recorder.capture)
        try:
            self._recorder.close()
        finally:
            if self._live is not None:
                self._live.close()

    def warn(self, report: Callable[[str], None]) -> None:
        """Pass each warning about the recording file, such as a small size limit, to the function ``report``."""
        for note in self.notes:
            report(f"warning: {note}")

    def _begin_recording(self) -> None:
        raise NotImplementedError


class EpisodeRecording(ObservingRecording):
    """A context manager that records every control step of a rollout, until the recording file has its largest size."""

    def __init__(
        self,
        path: Path,
        env: ManagerBasedRLEnv,
        options: RecordingOptions | PlayRecording,
        *,
        name: str,
        about: Mapping[str, object],
        documents: Mapping[str, str],
    ) -> None:
        ids, every = options.env_ids, max(round(1.0 / env.step_dt), 1)
        recorder = Recorder(
            path, env, recording_id=name, name=name, env_ids=ids, purpose="play", about=about, flush_every=every
        )
        for title, text in {**documents, FIGURES: "None yet: the episode is not over."}.items():
            recorder.document(title, text)
        super().__init__(env, recorder, live=options.live)
        self._bound = float(options.max_mb)
        self._frames = recorder.frames_within(self._bound)
        if self._frames < env.max_episode_length:
            room = f"at least {self._frames} steps fit" if self._frames else "maybe no step fits"
            text = f"the limit of {self._bound:g} MB is small: {room} in addition to shapes and texts; "
            self.notes = (text + f"{recorder.megabytes(env.max_episode_length):.1f} MB are enough for an episode",)

    @property
    def path(self) -> Path:
        """The recording file."""
        return self._recorder.path

    def figures(self, value: object) -> None:
        """Write the rollout's final metrics into the recording."""
        self._recorder.document(FIGURES, fenced(dump_json(value), "json"))

    def _begin_recording(self) -> None:
        words = f"the limit of {self._bound:g} MB is reached; later steps are not recorded"
        self._recorder.start(steps=self._frames, last_words=words)
        if not self._frames:
            self._recorder.say(words)


_DATASET_NAME = re.compile(r"(\d+)(_unfinished)?\.npz")


@contextmanager
def dated_folder(parent: Path, suffix: str = "") -> Iterator[Path]:
    """Yield a new folder whose name is the current time; an error or an interrupt removes the folder."""
    folder = create_exclusively(parent, datetime.now().strftime("%Y-%m-%d_%H-%M-%S") + suffix)
    try:
        with while_running():
            yield folder
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def checkpoint_facts(run: RunDirectory, checkpoint: Path) -> dict[str, str]:
    """Return a checkpoint's path (relative to the run directory if possible) and the checkpoint's sha256."""
    path = checkpoint.resolve()
    name = path.relative_to(run.path) if path.is_relative_to(run.path) else path
    return {"checkpoint": str(name), "checkpoint_sha256": sha256(checkpoint)}


def close_dataset(folder: Path, env: ManagerBasedRLEnv, iteration: int | None = None) -> list[Path]:
    """Write the remaining episodes to ``episodes.npz``, or to ``000012_unfinished.npz`` if ``iteration`` is 12."""
    env.recorder_manager.close()
    return write_dataset(folder, env, "episodes.npz" if iteration is None else f"{iteration:06d}_unfinished.npz")


def dataset_files_from(folder: Path, iteration: int) -> list[Path]:
    """Return the dataset files of ``iteration`` and later iterations, and all files with unfinished episodes."""
    found = ((path, _DATASET_NAME.fullmatch(path.name)) for path in folder.rglob("*.npz"))
    return [path for path, match in found if match and (match[2] or int(match[1]) >= iteration)]


def write_dataset(folder: Path, env: ManagerBasedRLEnv, name: str) -> list[Path]:
    """Write the episodes recorded since the last call, one file ``name`` per recorder group, below ``folder``."""
    paths = []
    for group, arrays in env.recorder_manager.take().items():
        path = (folder if group == "episodes" else folder / group) / name
        write_bytes(path, _archive(arrays))
        paths.append(path)
    return paths


def _archive(arrays: Arrays) -> bytes:
    """Return an ``.npz`` like numpy's, but without times: the same arrays always give the same bytes."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED) as file:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, array, allow_pickle=False)
            file.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getvalue())
    return archive.getvalue()
