"""The job around a drive: paced or as fast as it goes, recorded like any play, kept under the run."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol

import torch

from wheelleg_exp.errors import SimulationFailure
from wheelleg_exp.files import while_running, write_json, write_yaml
from wheelleg_exp.jobs.dataset import close_dataset
from wheelleg_exp.jobs.display import Display
from wheelleg_exp.jobs.drive.controls import Choose, Controls, Finish
from wheelleg_exp.jobs.drive.ground import OWN, drivable, require_scene
from wheelleg_exp.jobs.drive.pace import Pace
from wheelleg_exp.jobs.drive.script import Script, ScriptedHand, read_script
from wheelleg_exp.jobs.drive.session import DriveSession, Status
from wheelleg_exp.jobs.run_policy import RunPolicy, prepare
from wheelleg_exp.jobs.stop import StopRequest
from wheelleg_exp.run.directory import RunDirectory, create_exclusively
from wheelleg_exp.user_code import ending_as


class Face(Protocol):
    """What shows a drive to the one who drives, and lets them ask."""

    def open(self, session: DriveSession, choice: Choose, push: float) -> str:
        """Show a drive that begins, of a checkpoint on a ground, with pushes of so many m/s; return where it is."""

    def show(self, status: Status) -> None:
        """Show how it stands."""


@dataclass(frozen=True)
class Drive:
    """What a drive made.

    Attributes:
        checkpoint: the checkpoint.
        folder: what was written, below the run.
        recording: the recording, or None.
        figures: see ``definitions.drive``.
    """

    checkpoint: Path
    folder: Path
    recording: Path | None
    figures: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Wish:
    """What is to be driven.

    Attributes:
        run: the run.
        checkpoint: which of its checkpoints; None is the last.
        overrides: changes to the run's parameters.
        scene: option of the config group ``scene``; None or ``own`` is the run's own ground.
        script: a file of commands, or None.
        command: the command line, for the manifest.
    """

    run: RunDirectory
    checkpoint: Path | None = None
    overrides: Sequence[str] = ()
    scene: str | None = None
    script: Path | None = None
    command: Sequence[str] = ()


def drive(wish: Wish, display: Display, face: Face | None = None) -> list[Drive]:
    """Drive until somebody finishes; each checkpoint and each ground that is chosen on the way is a drive of its own.

    Without a face there must be a script, which is driven as fast as it goes. With both the script goes first, in
    real time, and the hand takes over.

    Args:
        wish: what is to be driven.
        display: receives progress.
        face: what shows the drive, or None.

    Raises:
        WheellegError: the run, a checkpoint, an override or the script is wrong.
        SimulationFailure: numbers are not finite, or the disk is full.
    """
    drives: list[Drive] = []
    choice: Choose | None = Choose(wish.checkpoint or wish.run.latest_checkpoint(), wish.scene)
    script = wish.script
    with StopRequest() as stop:
        while choice is not None:
            made, choice = _drive_one(wish, choice, script, display, face, stop)
            drives.append(made)
            script = None
    return drives


def _drive_one(
    wish: Wish, choice: Choose, path: Path | None, display: Display, face: Face | None, stop: StopRequest
) -> tuple[Drive, Choose | None]:
    """Return what was driven, and what is to be driven next."""
    scene = choice.scene or OWN
    require_scene(scene)
    prepared = prepare(
        wish.run, choice.checkpoint, wish.overrides, wish.command, display, lambda tree: drivable(tree, scene)
    )
    session = DriveSession(prepared.adapter, prepared.policy)
    script = None if path is None else read_script(path, session.axes)
    folder = create_exclusively(wish.run.play, datetime.now().strftime("%Y-%m-%d_%H-%M-%S"))
    try:
        with while_running():
            return _recorded(wish, choice, prepared, session, script, folder, display, face, stop)
    except BaseException:  # what was not finished leaves nothing that looks like a drive
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _recorded(
    wish: Wish,
    choice: Choose,
    prepared: RunPolicy,
    session: DriveSession,
    script: Script | None,
    folder: Path,
    display: Display,
    face: Face | None,
    stop: StopRequest,
) -> tuple[Drive, Choose | None]:
    tree = prepared.tree
    recording = prepared.recording(folder, wish.command) if tree["recording"]["enabled"] else None
    with recording or nullcontext():
        if face is not None:
            where = face.open(session, Choose(prepared.checkpoint, choice.scene), float(tree["drive"]["push"]))
            display.note(f"drive it at {where}  (Finish in the page, or Ctrl-C, ends the drive)")
        following = _Driver(session, script, tree["drive"], display, face, stop).run()
        content = {
            **prepared.about,
            "seed": tree["seed"],
            "overrides": list(wish.overrides),
            "scene": choice.scene or OWN,
        }
        content |= session.meter.figures()
        if recording is not None:
            recording.figures(content)
    driven = folder / "driven.yaml"
    write_yaml(driven, session.driven.script(session.steps))
    write_json(folder / "figures.json", content)
    files = [*close_dataset(folder / "dataset", session.env), folder / "figures.json", driven]
    files += [] if recording is None else [recording.path]
    wish.run.manifest().add("drive", files, content, command=wish.command)
    made = Drive(prepared.checkpoint, folder, recording.path if recording else None, content)
    if following is None:
        return made, None
    return made, Choose(following.checkpoint or prepared.checkpoint, following.scene or choice.scene)


class _Driver:
    """Does step after step until the script is over, or somebody finishes or chooses something else."""

    def __init__(
        self,
        session: DriveSession,
        script: Script | None,
        options: dict[str, Any],
        display: Display,
        face: Face | None,
        stop: StopRequest,
    ) -> None:
        self._session, self._display, self._face, self._stop = session, display, face, stop
        self._controls: Controls = session.controls
        step_dt = session.env.step_dt
        self._hand = None if script is None else ScriptedHand(script, self._controls, step_dt)
        self._pace = None if face is None else Pace(step_dt, float(options["frames_per_s"]))
        self._shown_s = 0.0 if face is None else float(options["fall_shown_s"])
        self._fallen_at: float | None = None

    @ending_as(SimulationFailure)
    @torch.inference_mode()
    def run(self) -> Choose | None:
        """Return what was chosen, or None when the drive is over."""
        while not self._is_over():
            for request in self._requests():
                if isinstance(request, Finish):
                    return None
                if isinstance(request, Choose):
                    return request
                self._session.obey(request)
            if self._session.fallen is not None:
                self._stand_up()
            elif not self._controls.paused:
                self._session.step()
                if self._hand is not None and self._face is None:
                    self._display.steps(self._session.steps, self._hand.last_step)
            self._keep_time()
        return None

    def _requests(self) -> list[Any]:
        if self._hand is not None and not self._controls.paused and self._session.fallen is None:
            self._hand.before(self._session.steps)
        return self._controls.take()

    def _is_over(self) -> bool:
        if self._face is not None:
            return self._stop.requested
        self._stop.check()
        return self._hand is None or self._session.steps >= self._hand.last_step

    def _stand_up(self) -> None:
        """Reset a robot that has fallen, as soon as that was seen."""
        now = time.monotonic()
        self._fallen_at = now if self._fallen_at is None else self._fallen_at
        if now - self._fallen_at >= self._shown_s:
            self._session.reset()
        if self._session.fallen is None:
            self._fallen_at = None

    def _keep_time(self) -> None:
        if self._pace is None or self._face is None:
            return
        if self._pace.is_frame_due():
            self._face.show(self._session.status())
        self._pace.wait(self._controls.speed)
