"""Show a drive in the browser: the robot, sliders, keys and gamepads, and figures. viser and mjviser draw the page.

The server listens only on the loopback address, and refuses connections from all other web pages.
"""

from __future__ import annotations

import copy
import errno
import io
import json
import logging
import math
import re
import socket
import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack, redirect_stdout, suppress
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import mujoco
import numpy as np
from PIL import Image

from wheelleg_exp.config import schema
from wheelleg_exp.errors import ConfigError, WheellegError, nearest_name
from wheelleg_exp.jobs.drive.drive_script import Axis, Choose, Controls, Finish, Jump, Push, Reset, Trigger
from wheelleg_exp.jobs.drive.drive_session import DriveSession, Status
from wheelleg_exp.plain_data import Unreadable, json_value
from wheelleg_exp.recording.writing.live_view import LOOPBACK
from wheelleg_exp.run.stock_policies import PREFIX, stock_names

if TYPE_CHECKING:
    import viser


def require_free(port: int, use: str) -> None:
    """Raise WheellegError if a TCP port cannot be opened; ``use`` is the port's purpose, for the error message."""
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((LOOPBACK, port))
    except OverflowError as error:
        message = f"the port {port} for {use} is not a valid TCP port"
        raise WheellegError(message, key="--port", expected="0 to 65534") from error
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise _port_in_use(port, use) from error
        why = "it is reserved for system services" if error.errno == errno.EACCES else f"{error.strerror}"
        message = f"port {port} for {use} cannot be opened: {why}"
        raise WheellegError(message, key="--port", expected=_OTHER_PORT) from error


_OTHER_PORT = "another port, such as --port 8123, or --port 0 for any that is free"


def _port_in_use(port: int, use: str) -> WheellegError:
    return WheellegError(f"port {port}, for {use}, is in use", key="--port", expected=_OTHER_PORT)


_GOOD, _BAD, _PLAIN = "#2f9e44", "#e03131", "#1c7ed6"
_BOX_STYLE = "font-size:0.82em;line-height:1.5;padding:0.2em 1em"
# The keys that the page lists; the axis or skill before a colon is one that not every task has.
_KEYS_HELP = (
    "lin_vel_x: W S drive | ang_vel_z: A D turn | lin_vel_y: Q E sideways | height: T G height | jump: J jump | "
    "trigger: B jump at bumps | F push | get_up: U get up | R reset | X stop | M slow | Space pause"
)


def keys_html(has: Collection[str]) -> str:
    """Return the keys and their actions as HTML; ``has`` contains the axes and skills of the task."""
    rows = (row.rpartition(": ") for row in _KEYS_HELP.split(" | "))
    shown = "".join(f"<span>{text}</span>" for needed, _, text in rows if not needed or needed in has)
    return re.sub(r"\b([A-Z]|Space)\b", r"<kbd>\1</kbd>", shown)


def state_html(status: Status, controls: Controls, step_dt: float) -> str:
    """Return the simulated time, the commands, the measured values, and the robot's height as HTML."""
    fallen = f'<b style="color:{_BAD}">fallen: {escape(status.fallen)}</b>' if status.fallen else ""
    word = "paused" if controls.paused else f"{controls.speed:g}x"
    time = f'<div id="drive-time"><b>{status.time_s:.2f} s</b> · {word} · {1.0 / step_dt:.0f} Hz · '
    lines = [time + f"falls {status.falls} {fallen}</div>"]
    lines += [_axis(axis, status.commands[name], status.measured.get(name)) for name, axis in controls.axes.items()]
    lines.append(f'<div id="drive-height">height {1e3 * status.height_m:.1f} mm</div>')
    return f'<div style="{_BOX_STYLE}">{"".join(lines)}</div>'


def reward_bars_html(values: Mapping[str, float]) -> str:
    """Return an HTML bar for each reward term: rewards to the right, penalties to the left, as long as their share."""
    most = max((abs(value) for value in values.values()), default=0.0) or 1.0
    rows = []
    for name, value in values.items():
        width = 50.0 * abs(value) / most
        left, colour = (50.0, _GOOD) if value >= 0.0 else (50.0 - width, _BAD)
        text = f"<div>{escape(name)}<span style='float:right'>{value:+z.3f}</span></div>"
        rows.append(text + _bar(left, width, colour))
    return f'<div id="drive-rewards" style="{_BOX_STYLE}">{"".join(rows)}</div>'


def _axis(axis: Axis, commanded: float, measured: float | None) -> str:
    shown = "" if measured is None else f" · is {measured:+.3f}"
    width = axis.high - axis.low
    middle, end = (100.0 * (axis.bounded(v) - axis.low) / width for v in (axis.rest, commanded))
    name = escape(axis.name)
    text = f'<div data-axis="{name}" data-command="{commanded:.4f}">{name} {commanded:+.3f}{shown}</div>'
    return text + _bar(min(middle, end), abs(end - middle), _PLAIN)


def _bar(left: float, width: float, colour: str) -> str:
    return (
        '<div style="position:relative;height:5px;background:#8883;border-radius:3px">'
        f'<div style="position:absolute;left:{left:.1f}%;width:{width:.1f}%;height:5px;background:{colour};'
        'border-radius:3px"></div></div>'
    )


# A JavaScript key code such as ``KeyW`` names a key's position, whatever letter the keyboard layout assigns.
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
KEY_ACTIONS = {
    "Space": "pause",
    "KeyR": "reset",
    "KeyF": "push",
    "KeyJ": "jump",
    "KeyB": "trigger",
    "KeyU": "get_up",
    "KeyX": "stop",
    "KeyM": "slow",
}
# Axis 1 of a standard gamepad is -1 if the left stick points forwards.
# Axis 2 of a standard gamepad is 1 if the right stick points to the right.
_STICKS: dict[int, tuple[str, float]] = {1: ("lin_vel_x", -1.0), 0: ("lin_vel_y", -1.0), 2: ("ang_vel_z", -1.0)}
_BUTTONS = {0: "push", 1: "reset", 2: "slow", 9: "pause"}
_DEADZONE = 0.12  # Gamepad stick values below 0.12 are ignored, because an untouched stick is not exactly at 0.
SLOW = 0.25  # The number of simulated seconds that slow motion shows in one second of real time.
_MAX_MESSAGE = 1024  # bytes of a message


class InputServer:
    """Receives key and gamepad input from web pages in a browser on this machine.

    When a web page disconnects, its commands return to neutral. ``origins`` are the accepted web origins, such as
    ``http://127.0.0.1:8080``. ``push`` is in m/s. ``next_policy`` takes over when the key for getting up is pressed.
    """

    def __init__(self, controls: Controls, origins: Sequence[str], port: int = 0) -> None:
        from websockets.sync.server import serve

        self.controls, self.push = controls, 0.0
        self.next_policy: str | None = None
        limits: Any = {"origins": list(origins), "max_size": _MAX_MESSAGE, "compression": None}
        quiet = logging.Logger("drive", logging.CRITICAL)  # A wrong message or request must not print a traceback.
        self._server = serve(self._listen, LOOPBACK, port, logger=quiet, **limits)
        self.port: int = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    def javascript(self, title: str, help: str) -> str:
        """Return the JavaScript that sends key and gamepad input, and shows the page's title and the HTML ``help``."""
        axes = self.controls.axes
        settings = {
            "url": f"ws://{LOOPBACK}:{self.port}/",
            "keys": {code: pair for code, pair in KEYS.items() if pair[0] in axes},
            "presses": KEY_ACTIONS,
            "sticks": {index: pair for index, pair in _STICKS.items() if pair[0] in axes},
            "buttons": _BUTTONS,
            "deadzone": _DEADZONE,
            "title": title,
            "help": help,
        }
        return f"const DRIVE = {json.dumps(settings)};\n{files(__package__).joinpath('keys.js').read_text('utf-8')}"

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._server.shutdown()
        self._thread.join()

    def press(self, name: object) -> None:
        """Carry out the action of the keyboard key ``name``; a key without an action has no effect."""
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
        elif name == "jump":
            controls.request(Jump())
        elif name == "trigger" and controls.trigger is not None:
            controls.trigger = "step" if controls.trigger == "bump" else "bump"
        elif name == "get_up" and self.next_policy is not None:
            controls.request(Choose(policy=self.next_policy))

    def _listen(self, connection: Iterable[str | bytes]) -> None:
        steered: set[str] = set()
        try:
            for message in connection:
                said = None
                with suppress(Unreadable):
                    said = json_value(message)
                said = said if isinstance(said, dict) else {}
                axis, share = said.get("steer"), said.get("share")
                if isinstance(axis, str) and isinstance(share, (int, float)):
                    steered.add(axis)
                    self.controls.steer(axis, float(share))
                else:
                    self.press(said.get("press"))
        finally:
            for axis in steered:
                self.controls.steer(axis, 0.0)


# The camera starts at this offset from the robot, in radii of the robot, with this vertical field of view in rad.
_CAMERA_FROM, _VIEW_ANGLE = np.array([-2.55, -1.85, 0.95]), 0.7
_PANEL_WIDTH = 320  # pixels
_SKY, _HORIZON, _TILES, _LINES = (118, 160, 200), (224, 233, 241), ((150, 162, 174), (136, 149, 162)), (176, 187, 197)
_PUSHES = {"forwards": (1.0, 0.0), "left": (0.0, 1.0), "right": (0.0, -1.0), "back": (-1.0, 0.0)}


class DrivePage:
    """A context manager that serves a web page on which a user drives the robot, to browsers on this machine."""

    def __init__(self, port: int, scenes: Sequence[str], policies: Sequence[str]) -> None:
        # Import the optional packages viser and mjviser only when a web page is requested.
        try:
            import viser
            from mjviser import ViserMujocoScene
        except ImportError as error:
            message = f"viser and mjviser draw the page, and {error.name} is missing"
            raise WheellegError(message, key="--drive", expected='pip install "wheelleg_exp[drive]"') from error

        # The page is never shared with another machine.
        methods = {"request_share_url": lambda _self, verbose=True: None}  # noqa: ARG005
        self._server_class: Any = type("LocalServer", (viser.ViserServer,), methods)
        self._scene_class = ViserMujocoScene
        self._port = port
        self._scenes, self._policies = list(scenes), list(policies)
        self._policy = self._policies[0] if self._policies else None
        self._trigger: Trigger | None = None  # the user's choice, also while a policy without jumps has the robot
        self._back: str | None = None  # the policy to which the key for getting up hands the robot back
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        keys = self._port + 1 if self._port else 0
        require_free(self._port, "the page")
        require_free(keys, "the page's keys and gamepads")
        with redirect_stdout(io.StringIO()):  # Suppress the output of viser.
            self._server = self._server_class(host=LOOPBACK, port=self._port, label="wheelleg_exp", verbose=False)
        self._stack.callback(self._stop)
        if self._port not in (0, self._server.get_port()):
            raise _port_in_use(self._port, "the page")
        origins = [f"http://{host}:{self._server.get_port()}" for host in (LOOPBACK, "localhost")]
        # Reject connections from other web pages, because any page in a browser can try to connect to this server.
        own = self._server._websock_server

        async def check(client: viser.ClientHandle) -> None:
            connection = own._live_connections[client.client_id]
            if connection.request.headers.get("Origin") not in origins:
                await connection.close(1008, "another page")

        own.on_client_connect(check)
        self._hands = InputServer(Controls([]), origins, keys)
        self._stack.enter_context(self._hands)
        self._server.gui.configure_theme(show_share_button=False)
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    @property
    def url(self) -> str:
        """The address for the browser."""
        return f"http://{LOOPBACK}:{self._server.get_port()}/"

    @property
    def ports(self) -> tuple[int, int]:
        """The TCP ports of the page, and of its keys and gamepads."""
        return self._server.get_port(), self._hands.port

    def open(self, session: DriveSession, choice: Choose, options: schema.Drive, checkpoints: Sequence[Path]) -> str:
        """Show the robot and its controls, and return the page's URL."""
        self._session, self._hands.push = session, options.push
        session.controls.paused, session.controls.speed = self._hands.controls.paused, self._hands.controls.speed
        self._trigger = self._hands.controls.trigger or self._trigger
        session.controls.trigger = session.controls.trigger and (self._trigger or session.controls.trigger)
        self._checkpoints = {path.stem: path for path in checkpoints}
        self._policy = choice.policy or self._policy
        get_up = options.get_up
        known = list(dict.fromkeys([*self._policies, *(PREFIX + name for name in stock_names())]))
        if get_up is not None and get_up not in known:
            message, expected, nearest = f"there is no policy '{get_up}'", ", ".join(known), nearest_name(get_up, known)
            raise ConfigError(message, key="drive.get_up", expected=f"one of {expected}", nearest=nearest)
        if self._policy != get_up:
            self._back = self._policy
        other = get_up if self._policy != get_up else self._back
        self._hands.next_policy = other if other in self._policies else None
        self._controls = self._hands.controls = session.controls
        self._data = mujoco.MjData(session.env.scene.sim.model)
        self._server.scene.reset()
        self._server.gui.reset()
        self._server.gui.main_panel.dock_right()  # A floating panel would cover the robot in a narrow window.
        self._server.gui.main_panel.set_width(_PANEL_WIDTH)
        model = copy.copy(session.env.scene.sim.model)  # Copy the model, because mjviser changes the model's colours.
        self._scene = self._scene_class(self._server, model, num_envs=1)
        self._show_surroundings()
        gui, controls = self._server.gui, self._controls
        self._state = gui.add_html("")
        with gui.add_folder("Commands"):
            self._mirrored: dict[str, float] = {}
            self._sliders = {name: self._slider(name) for name in controls.axes}
            if not controls.axes:
                gui.add_markdown("This task's commands have no ranges: the robot can be pushed, not driven.")
            self._bumps = gui.add_button("Jump at bumps", hint="b", visible=controls.trigger is not None)
            self._bumps.on_click(lambda _: self._hands.press("trigger"))
            gui.add_button("Stop", hint="x").on_click(lambda _: controls.stop())
        with gui.add_folder("Time"):
            self._pause = gui.add_button("Pause", hint="space")
            self._pause.on_click(lambda _: self._hands.press("pause"))
            speed = gui.add_button_group("Speed", ("1", f"{SLOW:g}", "0.1"))
            speed.on_click(lambda _: setattr(controls, "speed", float(speed.value)))
            gui.add_button("Reset", hint="r").on_click(lambda _: controls.request(Reset()))
            pushes = gui.add_button_group("Push", tuple(_PUSHES))
            pushes.on_click(
                lambda _: controls.request(Push(*(self._hands.push * way for way in _PUSHES[pushes.value])))
            )
        with gui.add_folder("Rewards, per second"):
            self._rewards = gui.add_html("")
        with gui.add_folder("What is driven"):
            self._choices(choice)
            finish = gui.add_button("Finish", hint="end the drive and write its figures")
            finish.on_click(lambda _: controls.request(Finish()))
        # Run the JavaScript for keys and gamepads in every browser page, including pages that are opened later.
        skills = {"jump": session.jumps, "trigger": controls.trigger, "get_up": self._hands.next_policy}
        has = {*controls.axes, *(name for name, one in skills.items() if one)}
        source = self._hands.javascript(f"wheelleg_exp · {self._policy or 'drive'}", keys_html(has))
        from viser._messages import RunJavascriptMessage

        self._server.gui._websock_interface.queue_message(RunJavascriptMessage(source=source))
        return self.url

    def show(self, status: Status) -> None:
        """Show the current state of the driven robot on the web page."""
        env = self._session.env
        self._data.qpos[:] = env.scene.sim.view("qpos")[0].cpu().numpy()
        mujoco.mj_kinematics(self._scene.mj_model, self._data)
        with self._server.atomic():
            self._scene.update_from_mjdata(self._data)
            for geom, handle in self._grounds.items():  # Move the tiles by whole patterns, so that they have no end.
                axes, place = self._data.geom_xmat[geom].reshape(3, 3), self._data.geom_xpos[geom]
                offset = (self._data.qpos[:3] - place) @ axes
                handle.position = place + axes[:, :2] @ (offset - offset % self._pattern)[:2]
            self._state.content = state_html(status, self._controls, env.step_dt)
            self._rewards.content = reward_bars_html(status.rewards)
            for name, value in status.commands.items():
                if self._mirrored.get(name) != value:  # Move the slider of a command that keyboard or script changed.
                    self._mirrored[name] = self._sliders[name].value = value
            self._bumps.label = f"Jump at bumps: {'on' if self._controls.trigger == 'bump' else 'off'}"
            self._pause.label = "Resume" if self._controls.paused else "Pause"

    def _show_surroundings(self) -> None:
        """Place the camera near the robot, replace mjviser's grid by tiles, and show a sky."""
        from trimesh import Trimesh
        from trimesh.visual import TextureVisuals, material

        model, scene, count = self._scene.mj_model, self._server.scene, 60
        mujoco.mj_kinematics(model, self._data)
        moving = model.geom_bodyid > 0
        offsets = self._data.geom_xpos[moving] - self._data.qpos[:3]
        size = float((np.linalg.norm(offsets, axis=1) + model.geom_rbound[moving]).max())  # the robot's radius, m
        middle = np.array([0.0, 0.0, 0.5 * (offsets[:, 2].min() + offsets[:, 2].max())])
        camera = self._server.initial_camera
        camera.position, camera.look_at, camera.fov = middle + size * _CAMERA_FROM, middle, _VIEW_ANGLE
        self._pattern = 2.0 * 10.0 ** round(math.log10(size))  # The picture shows 2 x 2 tiles of 0.1, 1, or 10 m.
        odd = np.kron(np.eye(2), np.ones((128, 128)))[..., None]
        tiles = ((1.0 - odd) * _TILES[0] + odd * _TILES[1]).astype(np.uint8)
        tiles[::128] = tiles[:, ::128] = _LINES
        paint: Any = material.PBRMaterial
        painted = paint(baseColorTexture=Image.fromarray(tiles), roughnessFactor=1.0, metallicFactor=0.0)
        corners = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]) * count
        texture: Any = TextureVisuals
        visual = texture(uv=corners[:, :2], material=painted)
        square = Trimesh(corners * self._pattern, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)
        self._grounds = {}
        for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE):
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
            name = f"/fixed_bodies/{model.body(model.geom_bodyid[geom]).name}/{name}"  # as in mjviser
            self._grounds[geom] = scene.add_mesh_trimesh(name, square, cast_shadow=False, wxyz=model.geom_quat[geom])
        scene.configure_environment_map(environment_intensity=0.45)  # The remaining light casts shadows.
        scene.configure_fog(10.0 * size, 0.8 * count * self._pattern, color=_HORIZON)
        share = np.linspace(0.0, 8.0, 64).clip(max=1.0)[:, None, None]  # The horizon is near the upper edge.
        scene.set_background_image(((1.0 - share) * _SKY + share * _HORIZON).astype(np.uint8), format="png")

    def _stop(self) -> None:
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _slider(self, name: str) -> viser.GuiSliderHandle[float]:
        axis, add = self._controls.axes[name], self._server.gui.add_slider
        slider = add(name, min=axis.low, max=axis.high, step=(axis.high - axis.low) / 200.0, initial_value=axis.rest)

        def moved(event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
            if event.client is not None:  # ``event.client`` is None if this program, not the user, moved the slider.
                self._mirrored[name] = float(slider.value)
                self._controls.set(name, self._mirrored[name])

        slider.on_update(moved)
        return slider

    def _choices(self, choice: Choose) -> None:
        gui, controls, names = self._server.gui, self._controls, list(self._checkpoints)
        if choice.checkpoint is not None and choice.checkpoint.stem not in names:
            names.append(choice.checkpoint.stem)

        def request(dropdown: viser.GuiDropdownHandle[str], choose: Callable[[str], Choose | None]) -> None:
            def changed(_: object) -> None:
                if chosen := choose(dropdown.value):
                    controls.request(chosen)

            dropdown.on_update(changed)

        now = names[0] if choice.checkpoint is None else choice.checkpoint.stem
        checkpoint = gui.add_dropdown("Checkpoint", names, initial_value=now)
        scene = gui.add_dropdown("Ground", self._scenes, initial_value=choice.scene or self._scenes[0])
        if self._policies:
            policy = gui.add_dropdown("Policy", self._policies, initial_value=self._policy)
            request(policy, lambda name: Choose(policy=name) if name in self._policies else None)
        paths = self._checkpoints
        request(checkpoint, lambda name: Choose(checkpoint=paths[name]) if name in paths else None)
        request(scene, lambda name: Choose(scene=name) if name in self._scenes else None)
