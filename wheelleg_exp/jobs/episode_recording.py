"""The recording of a play, an evaluation or an agent: one segment from beginning to end."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.jobs.documents import json_document
from wheelleg_exp.recording.blueprint import FIGURES, Purpose
from wheelleg_exp.recording.live import LiveView
from wheelleg_exp.recording.recorder import Recorder


class EpisodeRecording:
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
        self._env, self._options = env, options
        self._recorder = Recorder(
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
            self._recorder.document(title, text)
        self._live: LiveView | None = None

    @property
    def path(self) -> Path:
        """The file."""
        return self._recorder.path

    def figures(self, value: Any) -> None:
        """Put what was found at the end into the recording."""
        for name, text in json_document(FIGURES, value).items():
            self._recorder.document(name, text)

    def __enter__(self) -> Self:
        bound = self._options["max_mb"]
        words = f"the bound of {bound:g} MB is reached; what follows is not recorded"
        self._recorder.start(steps=self._recorder.frames_within(bound), last_words=words)
        if self._recorder.frames_within(bound) == 0:
            self._recorder.say(words)
        self._recorder.flush()
        self._env.observers.append(self._recorder.capture)
        if self._options["live"]:
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
