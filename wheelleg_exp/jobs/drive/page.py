"""The page: the robot in the browser, what it is asked for, and how it does. Drawn by viser and mjviser."""

from __future__ import annotations

import contextlib
import copy
import io
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import mujoco

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.jobs.drive import figures_html as html
from wheelleg_exp.jobs.drive.controls import Choose, Controls, Finish, Push, Reset
from wheelleg_exp.jobs.drive.hands import SLOW, Hands
from wheelleg_exp.jobs.drive.ports import require_free, taken
from wheelleg_exp.jobs.drive.session import DriveSession, Status
from wheelleg_exp.recording.writing.feed import LOOPBACK

_CAMERA_FROM, _HEIGHTS_AWAY = (-0.75, -0.5, 0.4), 6.5  # as seen from the base, in heights of it
_PUSHES = {"forwards": (1.0, 0.0), "left": (0.0, 1.0), "right": (0.0, -1.0), "back": (-1.0, 0.0)}


class DrivePage:
    """A server of the page on the loopback address; ``with`` starts and ends it.

    Args:
        port: where; keys and gamepads use the next one. 0 takes free ones.
        scenes: the grounds that can be chosen.
        checkpoints: the checkpoints that can be chosen.

    Raises:
        WheellegError: what draws the page is not installed, or the port is taken.
    """

    def __init__(self, port: int, scenes: Sequence[str], checkpoints: Sequence[Path]) -> None:
        self._server_class, self._scene_class = _viewer()
        self._port = port
        self._scenes, self._checkpoints = list(scenes), {path.stem: path for path in checkpoints}
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        keys = self._port + 1 if self._port else 0
        require_free(self._port, "the page")
        require_free(keys, "the page's keys and gamepads")
        with _silent():
            self._server = self._server_class(host=LOOPBACK, port=self._port, label="wheelleg", verbose=False)
        self._stack.callback(self._stop)
        if self._port not in (0, self._server.get_port()):
            raise taken(self._port, "the page")
        origins = [f"http://{host}:{self._server.get_port()}" for host in (LOOPBACK, "localhost")]
        _refuse_strangers(self._server, origins)
        self._hands = Hands(Controls([]), origins, keys)
        self._stack.enter_context(self._hands)
        self._server.gui.configure_theme(show_share_button=False, control_width="large")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def url(self) -> str:
        """What a browser opens."""
        return f"http://{LOOPBACK}:{self._server.get_port()}/"

    def open(self, session: DriveSession, choice: Choose, push: float) -> str:
        """Show a drive that begins: its robot, its ground, what can be asked of it; return the page's address.

        Args:
            session: the drive.
            choice: the checkpoint and the ground.
            push: the push of a key or a button, m/s.
        """
        self._session, self._hands.push = session, push
        self._controls = self._hands.controls = session.controls
        self._data = mujoco.MjData(session.env.scene.sim.model)
        self._server.scene.reset()
        self._server.gui.reset()
        model = copy.copy(session.env.scene.sim.model)  # the viewer changes its colours
        self._scene = self._scene_class(self._server, model, num_envs=1)
        self._look_from()
        self._build(choice)
        _run_in_page(self._server, self._hands.javascript())
        return self.url

    def show(self, status: Status) -> None:
        """Show how the drive stands."""
        env = self._session.env
        self._data.qpos[:] = env.scene.sim.view("qpos")[0].cpu().numpy()
        mujoco.mj_kinematics(self._scene.mj_model, self._data)
        with self._server.atomic():
            self._scene.update_from_mjdata(self._data)
            self._state.content = html.state(status, self._controls, env.step_dt)
            self._rewards.content = html.bars(status.rewards)
            for name, value in status.commands.items():
                if self._mirrored.get(name) != value:  # by keys or a script; a slider in somebody's hand stays in it
                    self._mirrored[name] = self._sliders[name].value = value
            self._pause.label = "Go on" if self._controls.paused else "Pause"

    def _stop(self) -> None:
        with _silent():
            self._server.stop()

    def _look_from(self) -> None:
        away = _HEIGHTS_AWAY * max(float(self._session.env.scene.robot.default_root_pos[2]), 0.02)
        self._server.initial_camera.position = tuple(away * part for part in _CAMERA_FROM)
        self._server.initial_camera.look_at = (0.0, 0.0, 0.0)

    def _build(self, choice: Choose) -> None:
        gui, controls = self._server.gui, self._controls
        self._state = gui.add_html("")
        with gui.add_folder("Commands"):
            self._mirrored: dict[str, float] = {}
            self._sliders = {name: self._slider(name) for name in controls.axes}
            if not controls.axes:
                gui.add_markdown("This task's commands have no range: the robot can be pushed, not driven.")
            gui.add_button("Stop", hint="x").on_click(lambda _: controls.stop())
        with gui.add_folder("Time"):
            self._pause = gui.add_button("Pause", hint="space")
            self._pause.on_click(lambda _: self._hands.press("pause"))
            speed = gui.add_button_group("Speed", ("1", f"{SLOW:g}", "0.1"))
            speed.on_click(lambda _: setattr(controls, "speed", float(speed.value)))
            gui.add_button("Reset", hint="r").on_click(lambda _: controls.request(Reset()))
            pushes = gui.add_button_group("Push", tuple(_PUSHES))
            pushes.on_click(lambda _: controls.request(self._push_to(pushes.value)))
        with gui.add_folder("Rewards, per second"):
            self._rewards = gui.add_html("")
        with gui.add_folder("What is driven"):
            self._choices(choice)
            gui.add_button("Finish", hint="end the drive and write its figures").on_click(
                lambda _: controls.request(Finish())
            )
        gui.add_html(html.HELP)

    def _push_to(self, way: str) -> Push:
        x, y = _PUSHES[way]
        return Push(self._hands.push * x, self._hands.push * y)

    def _slider(self, name: str) -> Any:
        axis = self._controls.axes[name]
        slider = self._server.gui.add_slider(
            name, min=axis.low, max=axis.high, step=(axis.high - axis.low) / 200.0, initial_value=axis.rest
        )

        @slider.on_update
        def _(event: Any) -> None:
            if event.client is not None:  # not our own picture of it
                self._mirrored[name] = float(slider.value)
                self._controls.set(name, self._mirrored[name])

        return slider

    def _choices(self, choice: Choose) -> None:
        gui, controls, names = self._server.gui, self._controls, list(self._checkpoints)
        if choice.checkpoint is not None and choice.checkpoint.stem not in names:
            names.append(choice.checkpoint.stem)
        now = names[0] if choice.checkpoint is None else choice.checkpoint.stem
        checkpoint = gui.add_dropdown("Checkpoint", names, initial_value=now)
        scene = gui.add_dropdown("Ground", self._scenes, initial_value=choice.scene or self._scenes[0])

        @checkpoint.on_update
        def _(_: Any) -> None:
            if checkpoint.value in self._checkpoints:
                controls.request(Choose(checkpoint=self._checkpoints[checkpoint.value]))

        @scene.on_update
        def _(_: Any) -> None:
            if scene.value in self._scenes:
                controls.request(Choose(scene=scene.value))


def _viewer() -> tuple[Any, Any]:
    """Return the server's class, which never opens a tunnel to elsewhere, and the scene's."""
    try:
        import viser
        from mjviser import ViserMujocoScene
    except ImportError as error:
        raise WheellegError(
            f"the page is drawn by viser and mjviser, and there is no {error.name}",
            key="--drive",
            expected='pip install "wheelleg_exp[drive]"',
        ) from error

    class LocalServer(viser.ViserServer):
        def request_share_url(self, verbose: bool = True) -> str | None:
            """Return None: nothing is shown to others, whoever in the page asks for it."""
            del verbose
            return None

    return LocalServer, ViserMujocoScene


def _run_in_page(server: Any, source: str) -> None:
    """Let every page that is open, or opened later, run a script, as viser itself does for its plots."""
    from viser._messages import RunJavascriptMessage

    server.gui._websock_interface.queue_message(RunJavascriptMessage(source=source))


def _refuse_strangers(server: Any, origins: Sequence[str]) -> None:
    """Close connections of pages that are not ours: a page of anybody's may try to reach the loopback address."""
    own = server._websock_server

    async def check(client: Any) -> None:
        connection = own._live_connections[client.client_id]
        if connection.request.headers.get("Origin") not in origins:
            await connection.close(1008, "another page")

    own.on_client_connect(check)


@contextmanager
def _silent() -> Iterator[None]:
    """Keep what viser prints away from standard output, on which reports go."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
