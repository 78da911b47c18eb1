"""What the recordings of a training and of an episode share: capturing while they are entered, and a live view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.recording.live import LiveView
from wheelleg_exp.recording.recorder import Recorder


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
