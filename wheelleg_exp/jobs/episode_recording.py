"""The recordings of jobs: what all of them share, and that of a play or an agent, one segment from end to end."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.jobs.documents import json_document
from wheelleg_exp.recording.blueprint import FIGURES, Purpose
from wheelleg_exp.recording.writing.live import LiveView
from wheelleg_exp.recording.writing.recorder import Recorder


class ObservingRecording:
    """Captures every control step from entering to leaving, and shows it meanwhile where that is asked for.

    Args:
        env: the environment.
        recorder: writes the file; it is closed on leaving.
        live: whether a viewer is opened.

    Attributes:
        notes: what people should know of the recording before it begins.
    """

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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._env.observers.remove(self._recorder.capture)
        try:
            self._recorder.close()
        finally:
            if self._live is not None:
                self._live.close()

    def warn(self, tell: Callable[[str], None]) -> None:
        """Tell the notes, one line each."""
        for note in self.notes:
            tell(f"warning: {note}")

    def _begin_recording(self) -> None:
        """Begin the first segment."""
        raise NotImplementedError


class EpisodeRecording(ObservingRecording):
    """Records every control step from entering to leaving, as far as the bound on the size allows.

    Each simulated second is in the file as soon as it is over.

    Args:
        path: the file.
        env: the environment.
        options: ``env_ids``, ``max_mb`` and ``live`` of the config's ``recording``.
        purpose: decides what the layout shows.
        name: the recording's identity and what the viewer shows.
        about: what the recording says of itself besides what the environment tells.
        documents: texts that go into the recording, by name.
    """

    def __init__(
        self,
        path: Path,
        env: ManagerBasedRLEnv,
        options: Mapping[str, Any],
        *,
        purpose: Purpose,
        name: str,
        about: Mapping[str, Any],
        documents: Mapping[str, str],
    ) -> None:
        recorder = Recorder(
            path,
            env,
            recording_id=name,
            name=name,
            env_ids=options["env_ids"],
            purpose=purpose,
            about=about,
            flush_every=max(round(1.0 / env.step_dt), 1),
        )
        for title, text in {**documents, FIGURES: "None yet: the episode is not over."}.items():
            recorder.document(title, text)
        super().__init__(env, recorder, live=options["live"])
        self._bound = float(options["max_mb"])
        self._frames = recorder.frames_within(self._bound)
        if self._frames < env.max_episode_length:
            self.notes = (self._warning(),)

    @property
    def path(self) -> Path:
        """The file."""
        return self._recorder.path

    def figures(self, value: Any) -> None:
        """Put what was found at the end into the recording."""
        for name, text in json_document(FIGURES, value).items():
            self._recorder.document(name, text)

    def _begin_recording(self) -> None:
        words = f"the bound of {self._bound:g} MB is reached; what follows is not recorded"
        self._recorder.start(steps=self._frames, last_words=words)
        if not self._frames:
            self._recorder.say(words)

    def _warning(self) -> str:
        room = f"{self._frames} steps surely fit" if self._frames else "no step surely fits"
        return (
            f"the bound of {self._bound:g} MB is small: {room} beside shapes and texts; "
            f"{self._recorder.megabytes(self._env.max_episode_length):.1f} MB are enough for an episode"
        )
