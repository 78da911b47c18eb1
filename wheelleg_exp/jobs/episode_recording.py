"""The recording of a play, an evaluation or an agent: one segment from beginning to end."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.jobs.documents import json_document
from wheelleg_exp.jobs.observing_recording import ObservingRecording
from wheelleg_exp.recording.blueprint import FIGURES, Purpose
from wheelleg_exp.recording.recorder import Recorder


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
