"""A viewer that shows a run as it goes, and can never disturb it."""

from __future__ import annotations

import contextlib
import pickle
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path

from wheelleg_exp.recording.writing.feed import LAYOUT
from wheelleg_exp.recording.writing.recorder import Recorder


class LiveView:
    """Opens a viewer and feeds it from the recording's file, in a process of its own.

    The run itself does nothing but write its file, as without a viewer: the feeding process follows that file, so that
    a viewer that is slow, hangs, dies or cannot be opened costs the run neither time nor memory. It ends with the run;
    the viewer stays open.

    Args:
        recorder: the recording, open and flushed.
        viewer: the viewer's command, in which ``{port}`` stands for the port that it is to listen on; None is rerun's.
    """

    def __init__(self, recorder: Recorder, viewer: Sequence[str] | None = None) -> None:
        self._recorder = recorder
        self._shown: tuple[int, int] | None = None
        self._folder = Path(tempfile.mkdtemp(prefix="wheelleg-live-"))
        self._write_layout()
        module = "wheelleg_exp.recording.writing.feed"
        words = [sys.executable, "-P", "-m", module, str(recorder.path), str(self._folder)]
        self._process: subprocess.Popen[bytes] | None = None
        with contextlib.suppress(OSError):  # no more processes: then there is no live view
            self._process = subprocess.Popen(
                [*words, *(viewer or [])],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
            threading.Thread(target=_attend, args=(self._process,), daemon=True).start()

    def show(self) -> None:
        """Let the viewer's layout follow what is recorded by now."""
        self._write_layout()

    def close(self) -> None:
        """Tell the feeding process that the file is finished; it shows the rest and ends."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()

    def _write_layout(self) -> None:
        state = self._recorder.layout_state()
        if self._shown == (len(state[2]), len(state[3])):
            return
        self._shown = (len(state[2]), len(state[3]))
        with contextlib.suppress(OSError):
            temporary = self._folder / f"{LAYOUT}.tmp"
            temporary.write_bytes(pickle.dumps(state))
            temporary.replace(self._folder / LAYOUT)


def _attend(process: subprocess.Popen[bytes]) -> None:
    """Pass on what the feeding process has to say, as long as the run lasts."""
    if process.stdout is not None:
        with process.stdout as words:
            for line in words:
                sys.stderr.write(line.decode(errors="replace"))
    process.wait()
