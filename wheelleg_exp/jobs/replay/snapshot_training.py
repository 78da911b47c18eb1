"""Training again from a run's snapshot, in a process of its own that imports the run's restored source.

The parent may be of another version than this code, so what passes between them (see ``processes``) is small and
numbered. The events are ``began``, ``note``, ``composed``, ``asset``, ``run``, ``iteration`` and ``ended``.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wheelleg_exp.errors import ConfigError, WheellegError
from wheelleg_exp.jobs.processes import Events, serve
from wheelleg_exp.stop_request import StopRequest

if TYPE_CHECKING:
    from wheelleg_exp.asset import CachedConversion
    from wheelleg_exp.jobs.train.run_training import Training
    from wheelleg_exp.rl.trainer import Iteration
    from wheelleg_exp.run.run_directory import RunDirectory

PROTOCOL = 1


@dataclass(frozen=True)
class Request:
    """What is trained again.

    Attributes:
        protocol: the number of this protocol.
        run: the run directory whose snapshot it is.
        until: how many iterations are trained.
        root: the folder of runs in which the new run directory is made.
        name: the last part of the new run directory's name.
        workplace: an existing folder that is removed afterwards.
        config_dirs: the user's config folders, restored.
        projects: the user's projects, restored.
        source_roots: the folders, beside the package's own, whose source the new run keeps.
        moved: the restored folder of each recorded one.
        command: the command line.
        facts: what the new run's manifest says besides; what is found out here is added to its ``replay``.
    """

    protocol: int
    run: str
    until: int
    root: str
    name: str
    workplace: str
    config_dirs: list[str]
    projects: list[str]
    source_roots: list[str]
    moved: dict[str, str]
    command: list[str]
    facts: dict[str, Any]

    def line(self) -> bytes:
        """Return the request as one line."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def read(cls, line: bytes) -> Request:
        """Return the request of a line; what is not known here is left out.

        Raises:
            WheellegError: it is of another protocol.
        """
        told = json.loads(line)
        if told.get("protocol") != PROTOCOL:
            raise WheellegError(f"replay protocol {told.get('protocol')!r} is not known", expected=str(PROTOCOL))
        return cls(**{field.name: told[field.name] for field in fields(cls)})


class ReplayEvents(Events):
    """Sends events, and asks for a stop when enough iterations are done.

    Args:
        descriptor: where they go.
        stop: asked when it is time.
    """

    def __init__(self, descriptor: int, stop: StopRequest) -> None:
        super().__init__(descriptor)
        self._stop = stop
        self.until: int | None = None
        self.warnings_only = False
        self.found: dict[str, Any] = {}

    def tell(self, event: str, **facts: Any) -> None:
        """Send what was found out, and remember it for the manifest."""
        self.found[event] = facts
        self.send(event, **facts)

    def note(self, text: str) -> None:
        """Send one line for people; what a training says of its source is of no use here."""
        if not self.warnings_only or text.startswith("warning"):
            super().note(text)

    def iteration(self, iteration: Iteration, total: int) -> None:
        """Send that an iteration is done; behind the last one that is wanted, training stops with a checkpoint."""
        until = total if self.until is None else min(self.until, total)
        super().iteration(iteration, until)
        if until < total and iteration.index + 1 >= until and not self._stop.requested:
            self.reached = True
            self._stop.requested = True


def main() -> int:
    """Train what the first line of standard input asks for, and return the exit status."""
    return serve(ReplayEvents, _train)


def _train(events: ReplayEvents, line: bytes, stop: StopRequest) -> None:
    import wheelleg_exp
    from wheelleg_exp.packages import join, read_project
    from wheelleg_exp.run.run_directory import RunDirectory

    request = Request.read(line)

    events.send("began", protocol=PROTOCOL, package=str(Path(wheelleg_exp.__file__).parent))
    for folder in request.projects:
        project = read_project(Path(folder))
        if project is not None:
            join(project)
    run = RunDirectory.open(request.run, request.root)
    config = _config(run, request)
    events.tell("composed", **_composed_again(run, request))
    stop.check()
    ready = _start(run, config, request, events)
    events.send("run", path=str(ready.directory.path))

    from wheelleg_exp.jobs.train import run_training

    stop.check()
    events.until = request.until
    run_training.run(ready, events, stop)


def _config(run: RunDirectory, request: Request) -> dict[str, Any]:
    """Return the snapshot's config, with the new run's place; a replay makes no films and sends nothing."""
    from wheelleg_exp.run.run_config import load_params, recorded_config

    env, agent = load_params(run)
    config: dict[str, Any] = {"env": env, "agent": agent, **recorded_config(run, os.environ)}
    config["run"] = {**config["run"], "root": request.root, "name": request.name}
    config["recording"] = {**config["recording"], "video_every": 0}
    agent["logger"] = agent.get("logger") and "tensorboard"
    # A resume may have gone on beyond the number that the config names.
    agent["max_iterations"] = max(int(agent["max_iterations"]), request.until)
    return config


def _start(run: RunDirectory, config: dict[str, Any], request: Request, events: ReplayEvents) -> Training:
    from wheelleg_exp.jobs.train import run_training
    from wheelleg_exp.paths import configs_dir

    recipe = run_training.Recipe(
        config=config,
        hydra_files={path.name: path.read_text(encoding="utf-8") for path in sorted(run.hydra.glob("*.yaml"))},
        source_roots=[configs_dir().parent, *(Path(folder) for folder in request.source_roots)],
        asset=_asset(run, config, request, events),
        config_dirs=[Path(folder) for folder in request.config_dirs],
    )
    events.warnings_only = True
    ready = run_training.start(recipe, request.command, events)
    events.warnings_only = False
    ready.manifest.record(**{**request.facts, "replay": {**request.facts.get("replay", {}), **events.found}})
    return ready


# --- the robot ---


def _asset(run: RunDirectory, config: Mapping[str, Any], request: Request, events: ReplayEvents) -> CachedConversion:
    """Convert the robot again from its restored source, or take the one that the run has kept."""
    from wheelleg_exp.jobs.saved_robot import copy_saved_robot, saved_mjcf

    workplace = Path(request.workplace)
    made, why = _converted_again(run, config["env"], request, workplace / "assets")
    kept = saved_mjcf(run).read_text(encoding="utf-8")
    if made is not None and made.output.read_text(encoding="utf-8") == kept:
        events.tell("asset", converted=True, note=None)
        return made
    why = why or "its source converts to another MJCF than the run's; the libraries differ"
    events.tell("asset", converted=False, note=f"{why}: the run's kept MJCF is simulated")
    return copy_saved_robot(run, workplace / "kept")


def _converted_again(
    run: RunDirectory, env: Mapping[str, Any], request: Request, cache: Path
) -> tuple[CachedConversion | None, str | None]:
    """Return the conversion, or None and why there is none."""
    from wheelleg_exp.asset.conversion_cache import convert_cached, find_beside, source_digest
    from wheelleg_exp.jobs.saved_robot import saved_networks, saved_sources
    from wheelleg_exp.paths import find_asset

    folders = [Path(folder) for folder in request.config_dirs]
    robot, roots = env["robot"], [root for folder in folders for root in (folder.parent / "assets", folder.parent)]
    try:
        source = find_asset(_moved(str(robot["asset"]), request.moved), roots, key="env.robot.asset")
        beside = find_beside(env, roots) | saved_networks(run)
        if source_digest(source, beside=beside) != saved_sources(run):
            return None, f"'{source.name}' or a file that it uses is not the recorded one"
        return convert_cached(source, base=robot["base"], cache_dir=cache, beside=beside), None
    except WheellegError as error:
        return None, f"the robot cannot be converted again ({error})"


def _moved(name: str, moved: Mapping[str, str]) -> str:
    """Return where an absolute path is now, when it lies in a restored folder."""
    for before, after in moved.items():
        if Path(name).is_relative_to(before):
            return str(Path(after) / Path(name).relative_to(before))
    return name


# --- the configs ---


def _composed_again(run: RunDirectory, request: Request) -> dict[str, Any]:
    """Compose the recorded overrides with the restored configs and hold the result against the snapshot's."""
    from wheelleg_exp.config.composing.compose import compose
    from wheelleg_exp.files import read_yaml
    from wheelleg_exp.run.run_config import load_params, recorded_overrides

    try:
        composed = compose(
            recorded_overrides(run),
            config_dirs=[Path(folder) for folder in request.config_dirs],
        )
    except ConfigError as error:
        return {"equal": False, "difference": str(error)}
    env, agent = load_params(run)
    for key, kept in (("env", env), ("agent", agent)):
        difference = _first_difference(kept, composed.config.get(key), key)
        if difference is not None:
            return {"equal": False, "difference": difference}
    if composed.hydra_files()["config.yaml"] != (run.hydra / "config.yaml").read_text(encoding="utf-8"):
        return {
            "equal": False,
            "difference": _first_difference(read_yaml(run.hydra / "config.yaml"), composed.raw_tree, ""),
        }
    return {"equal": True, "difference": None}


def _first_difference(kept: Any, now: Any, path: str) -> str | None:
    """Return the first leaf in which two trees differ, order of keys included."""
    if isinstance(kept, Mapping) and isinstance(now, Mapping):
        for key in [*kept, *(k for k in now if k not in kept)]:
            below = f"{path}.{key}" if path else str(key)
            if (key in kept) != (key in now):
                return f"{below} is only in the {'snapshot' if key in kept else 'composed config'}"
            difference = _first_difference(kept[key], now[key], below)
            if difference is not None:
                return difference
        return None if list(kept) == list(now) else f"{path or 'the config'} has its keys in another order"
    return None if kept == now and type(kept) is type(now) else f"{path} was {kept!r} and composes to {now!r}"


if __name__ == "__main__":
    sys.exit(main())
