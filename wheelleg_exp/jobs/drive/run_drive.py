"""Drive one trained robot: in real time in the browser, or from a script as fast as it computes."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from wheelleg_exp.config import schema
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.composing.sized_values import robot_sizes
from wheelleg_exp.config.explaining.catalog import options
from wheelleg_exp.errors import ConfigError, RunDirectoryError, SimulationFailure, nearest_name
from wheelleg_exp.files import write_json, write_yaml
from wheelleg_exp.jobs.drive.drive_page import DrivePage
from wheelleg_exp.jobs.drive.drive_script import Choose, Controls, Finish, Request, Script, ScriptPlayer, read_script
from wheelleg_exp.jobs.drive.drive_session import DriveSession
from wheelleg_exp.jobs.job_display import Display
from wheelleg_exp.jobs.play_policy import Tree, prepare_policy
from wheelleg_exp.jobs.rollout_files import close_dataset, dated_folder
from wheelleg_exp.jobs.saved_robot import saved_mjcf
from wheelleg_exp.packages import with_current
from wheelleg_exp.run.run_config import load_params
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.run.stock_policies import PREFIX, stock_names
from wheelleg_exp.sim.scene import RobotState
from wheelleg_exp.stop_request import StopRequest
from wheelleg_exp.user_exceptions import ending_as

OWN_GROUND = "own"  # The name ``own`` selects the ground on which the policy was trained.
_GROUP = "scene"
_SETTINGS = ("seed=", "drive.", "recording.")  # overrides that do not depend on the policy
_RESTING = "reset_to_resting_pose"  # fits only level ground; a policy that takes over does not need it


def scenes() -> list[str]:
    """Return the name ``own`` (the training's ground) and the names of all scene configs."""
    return [OWN_GROUND, *(entry.name for entry in options(_GROUP, with_current([])))]


def policies(run: RunDirectory, root: Path) -> dict[str, RunDirectory]:
    """Return the run, and the undamaged shipped policies for the run's robot with the same actuators, by name."""
    shipped: dict[str, RunDirectory] = {}
    for name in stock_names():
        with suppress(RunDirectoryError):
            shipped[PREFIX + name] = RunDirectory.open(PREFIX + name, root)
    names, robot = {other.path: name for name, other in shipped.items()}, _robot(run)
    same = {name: other for name, other in shipped.items() if _robot(other) == robot}
    return {names.get(run.path, run.id): run} | same


def _robot(run: RunDirectory) -> tuple[bytes, object]:
    return saved_mjcf(run).read_bytes(), load_params(run)[0]["robot"]["actuators"]


def drivable(tree: Tree, scene: str = OWN_GROUND, handed_over: Tree | None = None) -> Tree:
    """Return the config of ``wheelleg play``, changed so that a user can drive the robot.

    It has one environment, episodes of ``drive.episode_length_s`` seconds, no curriculum, events only at startup and
    reset, and no heading control or random zero commands. ``scene`` names the scene config whose ground is simulated;
    ``own`` is that of the training. ``handed_over`` is the config of the scene in which a policy takes over the robot.
    """
    tree = copy.deepcopy(tree)
    env = tree["env"]
    env["events"] = {n: e for n, e in env["events"].items() if e.get("mode") not in ("interval", "step")}
    env["num_envs"] = 1
    env["episode_length_s"] = tree["drive"]["episode_length_s"]
    env["curriculum"] = {}
    for node in (env.get("commands") or {}).values():
        node |= {k: v for k, v in {"rel_standing_envs": 0.0, "heading_command": False}.items() if k in node}
        if "heading_command" in node:
            node["ranges"] = {**node["ranges"], "heading": None}
    other = handed_over
    if other is None and scene != OWN_GROUND:
        words = [*robot_sizes(env), f"+{_GROUP}={scene}"]
        other = compose(words, primary="play", config_dirs=with_current([])).config["env"]["scene"]
    if other is not None:
        # Use the other scene's ground, and its configs of those sensors that the training also has.
        own = env["scene"]
        shared = {key: node for key, node in other.get("sensors", {}).items() if key in (own.get("sensors") or {})}
        ground = {key: value for key, value in other.items() if key != "sensors"}
        env["scene"] = {**own, **ground, "sensors": {**(own.get("sensors") or {}), **shared}}
    if handed_over is not None:
        env["events"] = {k: node for k, node in env["events"].items() if not str(node["_target_"]).endswith(_RESTING)}
    return tree


_MAX_DELAY_S = 0.1  # If the simulation is more than 0.1 s behind real time, the excess delay is not caught up.


class RealTimePacer:
    """Waits between control steps so that simulated time passes as fast as real time."""

    def __init__(
        self,
        step_dt: float,
        frames_per_s: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._step_dt, self._frame_s = step_dt, 1.0 / frames_per_s
        self._clock, self._sleep = clock, sleep
        self._due = self._next_frame = clock()

    def wait(self, speed: float) -> None:
        """Wait until the real time at which the next control step must start."""
        self._due = max(self._due + self._step_dt / speed, self._clock() - _MAX_DELAY_S)
        left = self._due - self._clock()
        if left > 0.0:
            self._sleep(left)

    def is_frame_due(self) -> bool:
        """Return True if the view must draw the robot now, and schedule the next drawing."""
        now = self._clock()
        if now < self._next_frame:
            return False
        self._next_frame += self._frame_s
        if self._next_frame <= now:
            self._next_frame = now + self._frame_s
        return True


@dataclass(frozen=True)
class Drive:
    """The files and metrics of a robot that a user drove; ``definitions.drive`` explains the metrics in ``figures``."""

    checkpoint: Path
    folder: Path
    recording: Path | None
    figures: dict[str, Any]


@dataclass(frozen=True)
class DriveRequest:
    """A request to drive a robot with a run's checkpoint (default: the last) on a ground (default: the training's)."""

    run: RunDirectory
    checkpoint: Path | None = None
    overrides: Sequence[str] = ()
    scene: str | None = None
    script: Path | None = None
    command: Sequence[str] = ()


@dataclass(frozen=True)
class _End:
    """What a drive leaves to the next one: the user's choice, the robot's last state, and the config of its scene."""

    choice: Choose
    state: RobotState
    scene: Tree


def drive(
    request: DriveRequest,
    display: Display,
    view: DrivePage | None = None,
    others: Mapping[str, RunDirectory] | None = None,
) -> list[Drive]:
    """Simulate the driven robot until the user finishes.

    Another checkpoint or ground resets the robot; another policy of ``others`` takes over the robot in its present
    state. Without ``view``, the commands of the file ``request.script`` are simulated as fast as possible. With
    ``view``, they are applied in real time before the user takes control.
    """
    drives: list[Drive] = []
    first = request
    choice = Choose(request.checkpoint or request.run.latest_checkpoint(), request.scene)
    before: _End | None = None
    with StopRequest() as stop:
        while True:
            made, end = _drive_one(request, choice, before, display, view, stop)
            drives.append(made)
            if end is None:
                return drives
            choice, request = end.choice, replace(request, script=None)
            before = None if choice.policy is None else end
            if choice.policy is not None:
                run, checkpoint, overrides = (others or {})[choice.policy], first.checkpoint, first.overrides
                if run.path != first.run.path:
                    # The other overrides fit the first policy, and perhaps no other.
                    checkpoint, overrides = None, [word for word in overrides if word.startswith(_SETTINGS)]
                request = replace(request, run=run, overrides=overrides)
                choice = replace(choice, checkpoint=checkpoint or run.latest_checkpoint())


def _drive_one(
    request: DriveRequest,
    pick: Choose,
    before: _End | None,
    display: Display,
    view: DrivePage | None,
    stop: StopRequest,
) -> tuple[Drive, _End | None]:
    """Simulate one drive, which can take over the robot from ``before``; return it, and the user's next choice."""
    scene = pick.scene or OWN_GROUND
    if scene not in (known := scenes()):
        expected, nearest = "one of " + ", ".join(known), nearest_name(scene, known)
        raise ConfigError(f"unknown ground '{scene}'", key="--scene", expected=expected, nearest=nearest)
    state, around = (None, None) if before is None else (before.state, before.scene)
    prepared = prepare_policy(
        request.run, pick.checkpoint, request.overrides, display, lambda tree: drivable(tree, scene, around)
    )
    session = DriveSession(prepared.adapter, prepared.policy, state)
    script = None
    if request.script is not None:
        has = {"jump": session.jumps, "trigger": session.controls.trigger}
        script = read_script(request.script, session.axes, missing=[name for name, one in has.items() if not one])
    with dated_folder(request.run.play) as folder:
        settings = prepared.settings
        recording = prepared.recording(folder, request.command) if settings.recording.enabled else None
        with recording or nullcontext():
            if view is not None:
                now = Choose(prepared.checkpoint, pick.scene, pick.policy)
                where = view.open(session, now, settings.drive, request.run.checkpoints())
                display.note(f"drive it at {where}  (Finish in the page, or Ctrl-C, ends the drive)")
            following = _Driver(session, script, settings.drive, display, view, stop).run()
            content = {**prepared.about, "seed": settings.seed, "overrides": list(request.overrides), "scene": scene}
            content |= {"handed_over": before is not None, **session.meter.figures()}
            if recording is not None:
                recording.figures(content)
        driven = folder / "driven.yaml"
        write_yaml(driven, session.driven.script(session.steps))
        write_json(folder / "figures.json", content)
        files = [*close_dataset(folder / "dataset", session.env), folder / "figures.json", driven]
        files += [] if recording is None else [recording.path]
        request.run.manifest().add("drive", files, content, command=request.command)
    made = Drive(prepared.checkpoint, folder, recording.path if recording else None, content)
    if following is None:
        return made, None
    choice = Choose(following.checkpoint or prepared.checkpoint, following.scene or pick.scene, following.policy)
    return made, _End(choice, session.env.scene.get_state(), prepared.tree["env"]["scene"])


@dataclass
class _Driver:
    """Simulates a driven robot until a script ends, the user stops, or the user chooses a new checkpoint or ground."""

    session: DriveSession
    script: Script | None
    options: schema.Drive
    display: Display
    view: DrivePage | None
    stop: StopRequest

    def __post_init__(self) -> None:
        self._controls: Controls = self.session.controls
        step_dt = self.session.env.step_dt
        self._hand = None if self.script is None else ScriptPlayer(self.script, self._controls, step_dt)
        self._pace = None if self.view is None else RealTimePacer(step_dt, self.options.frames_per_s)
        self._shown_s = 0.0 if self.view is None else self.options.fall_shown_s
        self._fallen_at: float | None = None

    @ending_as(SimulationFailure)
    @torch.inference_mode()
    def run(self) -> Choose | None:
        """Simulate the driven robot; if the user makes another choice, stop and return this choice."""
        while not self._is_over():
            for request in self._requests():
                if isinstance(request, Finish):
                    return None
                if isinstance(request, Choose):
                    return request
                self.session.obey(request)
            if self.session.fallen is not None:
                # Reset a fallen robot after the web page has shown the fall for a moment.
                now = time.monotonic()
                self._fallen_at = now if self._fallen_at is None else self._fallen_at
                if now - self._fallen_at >= self._shown_s:
                    self.session.reset()
                if self.session.fallen is None:
                    self._fallen_at = None
            elif not self._controls.paused:
                self.session.step()
                if self._hand is not None and self.view is None:
                    self.display.steps(self.session.steps, self._hand.last_step)
            if self._pace is not None and self.view is not None:
                if self._pace.is_frame_due():
                    self.view.show(self.session.status())
                self._pace.wait(self._controls.speed)
        return None

    def _requests(self) -> list[Request]:
        if self._hand is not None and not self._controls.paused and self.session.fallen is None:
            self._hand.before(self.session.steps)
        return self._controls.take()

    def _is_over(self) -> bool:
        if self.view is not None:
            return self.stop.requested
        self.stop.check()
        return self._hand is None or self.session.steps >= self._hand.last_step
