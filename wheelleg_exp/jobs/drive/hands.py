"""Keys and gamepads: which there are, the script that reads them in the page, and the socket that tells of them."""

from __future__ import annotations

import json
import threading
from collections.abc import Sequence
from importlib.resources import files
from types import TracebackType
from typing import Any, Self

from wheelleg_exp.jobs.drive.controls import Controls, Push, Reset
from wheelleg_exp.reading import Unreadable, json_value
from wheelleg_exp.recording.writing.feed import LOOPBACK

# By the names that browsers give to the places of keys, whatever is printed on them.
KEYS: dict[str, tuple[str, float]] = {
    **dict.fromkeys(("KeyW", "ArrowUp"), ("lin_vel_x", 1.0)),
    **dict.fromkeys(("KeyS", "ArrowDown"), ("lin_vel_x", -1.0)),
    **dict.fromkeys(("KeyA", "ArrowLeft"), ("ang_vel_z", 1.0)),
    **dict.fromkeys(("KeyD", "ArrowRight"), ("ang_vel_z", -1.0)),
    "KeyQ": ("lin_vel_y", 1.0),
    "KeyE": ("lin_vel_y", -1.0),
    "KeyT": ("height", 1.0),
    "KeyG": ("height", -1.0),
}
PRESSES = {"Space": "pause", "KeyR": "reset", "KeyF": "push", "KeyX": "stop", "KeyM": "slow"}
# Of a pad in the standard layout: the left stick forwards is axis 1 at -1, the right one to the right axis 2 at 1.
_STICKS: dict[int, tuple[str, float]] = {1: ("lin_vel_x", -1.0), 0: ("lin_vel_y", -1.0), 2: ("ang_vel_z", -1.0)}
_BUTTONS = {0: "push", 1: "reset", 2: "slow", 9: "pause"}
_DEADZONE = 0.12  # of a stick that nobody touches
SLOW = 0.25  # simulated seconds in one second of slow motion
_LONGEST = 1024  # bytes of a message


class Hands:
    """Listens to keys and gamepads of a page on the loopback address; one whose page goes away lets go of all.

    Args:
        controls: of whom they ask.
        origins: the pages that may ask, such as ``http://127.0.0.1:8080``.
        port: of the loopback address; 0 takes a free one.

    Attributes:
        push: the push of a key, m/s.
    """

    def __init__(self, controls: Controls, origins: Sequence[str], port: int = 0) -> None:
        from websockets.sync.server import serve

        self.controls, self.push = controls, 0.0
        allowed: Any = list(origins)
        self._server = serve(self._listen, LOOPBACK, port, origins=allowed, max_size=_LONGEST, compression=None)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    def javascript(self) -> str:
        """Return what the page runs."""
        port = self._server.socket.getsockname()[1]
        axes = self.controls.axes
        told = {
            "url": f"ws://{LOOPBACK}:{port}/",
            "keys": {code: pair for code, pair in KEYS.items() if pair[0] in axes},
            "presses": PRESSES,
            "sticks": {index: pair for index, pair in _STICKS.items() if pair[0] in axes},
            "buttons": _BUTTONS,
            "deadzone": _DEADZONE,
        }
        return f"const DRIVE = {json.dumps(told)};\n{files(__package__).joinpath('keys.js').read_text('utf-8')}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.shutdown()
        self._thread.join()

    def press(self, name: str) -> None:
        """Do what a key asks for by its name; unknown ones count for nothing."""
        controls = self.controls
        if name == "pause":
            controls.paused = not controls.paused
        elif name == "slow":
            controls.speed = 1.0 if controls.speed == SLOW else SLOW
        elif name == "stop":
            controls.stop()
        elif name == "reset":
            controls.request(Reset())
        elif name == "push":
            controls.request(Push(self.push))

    def _listen(self, connection: Any) -> None:
        steered: set[str] = set()
        try:
            for message in connection:
                self._take(message, steered)
        finally:
            for axis in steered:
                self.controls.steer(axis, 0.0)

    def _take(self, message: str | bytes, steered: set[str]) -> None:
        try:
            said = json_value(message)
        except Unreadable:
            return
        if not isinstance(said, dict):
            return
        axis, share = said.get("steer"), said.get("share")
        if isinstance(axis, str) and isinstance(share, (int, float)):
            steered.add(axis)
            self.controls.steer(axis, float(share))
        elif isinstance(said.get("press"), str):
            self.press(said["press"])
