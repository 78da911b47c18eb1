"""Train a run again from its snapshot, in a child process that imports the run's restored source code.

Both processes may run different versions of ``wheelleg_exp``, so the request contains a protocol version.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.child_process import EventPipe, serve_job
from wheelleg_exp.errors import ConfigError, WheellegError
from wheelleg_exp.files import for_people
from wheelleg_exp.jobs.job_display import PipeDisplay
from wheelleg_exp.stop_request import StopRequest

if TYPE_CHECKING:
    from wheelleg_exp.asset import CachedConversion
    from wheelleg_exp.rl.trainer import Iteration
    from wheelleg_exp.run.run_directory import RunDirectory

PROTOCOL = 1


@dataclass(frozen=True)
class Request:
    """The parent process's request to train a run again from its snapshot."""

    protocol: int
    run: str  # the directory of the run that the replay trains again
    until: int  # the number of iterations that the replay trains
    root: str  # the folder in which the replay creates its run directory
    name: str  # the name of the run that the replay trains
    workplace: str  # a temporary folder that the parent process removes after the training
    config_dirs: list[str]
    projects: list[str]
    source_roots: list[str]
    moved: dict[str, str]  # maps each recorded source folder to its restored folder
    command: list[str]
    facts: dict[str, Any]  # additional entries for the manifest of the replay's run

    def line(self) -> bytes:
        """Return the request for a replay as one line of JSON."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def read(cls, line: bytes) -> Request:
        """Parse a request from one line of JSON; ignore the keys that this version of the package does not know."""
        found = json.loads(line)
        if found.get("protocol") != PROTOCOL:
            message = f"unknown protocol version {found.get('protocol')!r} in a replay request"
            raise WheellegError(message, expected=str(PROTOCOL))
        return cls(**{field.name: found[field.name] for field in fields(cls)})


class ReplayDisplay(PipeDisplay):
    """Sends the events of a training to the parent process, and stops the training after the requested iterations."""

    def __init__(self, pipe: EventPipe, stop: StopRequest) -> None:
        super().__init__(pipe)
        self._stop = stop
        self.until: int | None = None
        self.warnings_only = False
        self.found: dict[str, object] = {}

    def record(self, event: str, **facts: object) -> None:
        """Send an event to the parent process, and keep the event's data for the new run's manifest."""
        self.found[event] = facts
        self._pipe.send(event, **facts)

    def note(self, text: str) -> None:
        """Send a message for the user to the parent process; if ``warnings_only`` is true, send only warnings."""
        if not self.warnings_only or text.startswith("warning"):
            super().note(text)

    def iteration(self, iteration: Iteration, total: int) -> None:
        until = total if self.until is None else min(self.until, total)
        super().iteration(iteration, until)
        if until < total and iteration.index + 1 >= until and not self._stop.requested:
            self._pipe.reached = True
            self._stop.requested = True


def main() -> int:
    """Read a request from standard input, train the requested replay, and return the exit status."""
    return serve_job(_train)


def _train(pipe: EventPipe, line: bytes, stop: StopRequest) -> None:
    import wheelleg_exp
    from wheelleg_exp.packages import join, read_project
    from wheelleg_exp.run.run_directory import RunDirectory

    request, display = Request.read(line), ReplayDisplay(pipe, stop)
    pipe.send("began", protocol=PROTOCOL, package=str(Path(wheelleg_exp.__file__).parent))
    for folder in request.projects:
        project = read_project(Path(folder))
        if project is not None:
            join(project)
    run_directory = RunDirectory.open(request.run, request.root)
    config = _config(run_directory, request)
    display.record("composed", **_composed_again(run_directory, request))
    stop.check()

    from wheelleg_exp.jobs.train.prepare_training import Recipe, prepare_recipe
    from wheelleg_exp.paths import configs_dir

    hydra = sorted(run_directory.hydra.glob("*.yaml"))
    recipe = Recipe(
        config=config,
        hydra_files={path.name: path.read_text(encoding="utf-8") for path in hydra},
        source_roots=[configs_dir().parent, *map(Path, request.source_roots)],
        asset=_asset(run_directory, config["env"], request, display),
        config_dirs=[Path(folder) for folder in request.config_dirs],
    )
    display.warnings_only = True
    training = prepare_recipe(recipe, request.command, display)
    display.warnings_only = False
    training.manifest.record(**{**request.facts, "replay": {**request.facts.get("replay", {}), **display.found}})
    pipe.send("run", path=str(training.directory.path))

    from wheelleg_exp.jobs.train.run_training import run

    stop.check()
    display.until = request.until
    run(training, display, stop)


def _config(run: RunDirectory, request: Request) -> dict[str, Any]:
    """Return the config that the original run saved, with a new run directory, and without videos and W&B logging."""
    from wheelleg_exp.run.run_config import load_params, recorded_config

    env, agent = load_params(run)
    config = {"env": env, "agent": agent, **recorded_config(run, os.environ)}
    config["run"] = {**config["run"], "root": request.root, "name": request.name}
    config["recording"] = {**config["recording"], "video_every": 0}
    agent["logger"] = agent.get("logger") and "tensorboard"
    # A resume may have trained more iterations than the run's config requests.
    agent["max_iterations"] = max(int(agent["max_iterations"]), request.until)
    return config


def _asset(run: RunDirectory, env: Mapping[str, Any], request: Request, display: ReplayDisplay) -> CachedConversion:
    """Convert the robot again from its restored source files; if impossible, copy the robot that the run saved."""
    from wheelleg_exp.asset.conversion_cache import MODEL, convert_cached, find_extra_files, source_digest
    from wheelleg_exp.jobs.saved_robot import load_saved_robot, saved_mjcf
    from wheelleg_exp.paths import INITIAL, TEACHER, find_asset
    from wheelleg_exp.run.run_config import recorded_robot

    workplace = Path(request.workplace)
    folders = [Path(folder) for folder in request.config_dirs]
    robot, roots = env["robot"], [root for folder in folders for root in (folder.parent / "assets", folder.parent)]
    why = "the conversion gives another MJCF than the run's; the libraries differ"
    try:
        source = find_asset(_moved(str(robot["asset"]), request.moved), roots, key="env.robot.asset")
        networks = {name: path for name in (TEACHER, INITIAL) if (path := run.asset / name).is_file()}
        extra = find_extra_files(env, roots) | networks
        if source_digest(source, extra_files=extra) != recorded_robot(run).sources:
            why = f"'{source.name}' or a file that it uses is not the recorded one"
        else:
            made = convert_cached(source, base=robot["base"], cache_dir=workplace / "assets", extra_files=extra)
            if made.output.read_text(encoding="utf-8") == saved_mjcf(run).read_text(encoding="utf-8"):
                display.record("asset", converted=True, note=None)
                return made
    except WheellegError as error:
        why = f"the robot cannot be converted again ({error})"
    display.record("asset", converted=False, note=f"{why}: the replay simulates the saved MJCF")
    kept, saved = workplace / "kept", load_saved_robot(run)
    with for_people(kept):
        shutil.copytree(run.asset, kept)
        (kept / saved.output.name).rename(kept / MODEL)
    return replace(saved, output=kept / MODEL)


def _moved(name: str, moved: Mapping[str, str]) -> str:
    """Replace a recorded source folder at the start of a path by its restored copy."""
    for before, after in moved.items():
        if Path(name).is_relative_to(before):
            return str(Path(after) / Path(name).relative_to(before))
    return name


def _composed_again(run: RunDirectory, request: Request) -> dict[str, object]:
    """Compose a config from a run's overrides and restored YAML files, and compare it with the run's saved config."""
    from wheelleg_exp.config.composing.compose import compose
    from wheelleg_exp.files import read_yaml
    from wheelleg_exp.run.run_config import load_params, recorded_overrides

    try:
        composed = compose(recorded_overrides(run), config_dirs=[Path(folder) for folder in request.config_dirs])
    except ConfigError as error:
        return {"equal": False, "difference": str(error)}
    env, agent = load_params(run)
    for key, recorded in (("env", env), ("agent", agent)):
        difference = _first_difference(recorded, composed.config.get(key), key)
        if difference is not None:
            return {"equal": False, "difference": difference}
    if composed.hydra_files()["config.yaml"] != (run.hydra / "config.yaml").read_text(encoding="utf-8"):
        difference = _first_difference(read_yaml(run.hydra / "config.yaml"), composed.raw_tree, "")
        return {"equal": False, "difference": difference}
    return {"equal": True, "difference": None}


def _first_difference(recorded: object, now: object, path: str) -> str | None:
    """Describe the first difference between two configs; a different order of keys is also a difference."""
    if isinstance(recorded, Mapping) and isinstance(now, Mapping):
        for key in [*recorded, *(k for k in now if k not in recorded)]:
            below = f"{path}.{key}" if path else str(key)
            if (key in recorded) != (key in now):
                return f"{below} is only in the {'snapshot' if key in recorded else 'composed config'}"
            difference = _first_difference(recorded[key], now[key], below)
            if difference is not None:
                return difference
        return None if list(recorded) == list(now) else f"{path or 'the config'} has its keys in another order"
    if recorded == now and type(recorded) is type(now):
        return None
    return f"{path} was {recorded!r} and composes to {now!r}"


if __name__ == "__main__":
    sys.exit(main())
