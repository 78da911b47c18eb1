"""Train one job of a sweep in its own process."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.jobs.processes import Events, serve
from wheelleg_exp.stop_request import StopRequest


@dataclass(frozen=True)
class Request:
    """What a job trains.

    Attributes:
        overrides: the job's overrides.
        config_dirs: the user's config folders, as seen from the working folder.
        command: the command line that trains it alone.
        digest: digest of the config that was checked.
    """

    overrides: list[str]
    config_dirs: list[str]
    command: list[str]
    digest: str

    def line(self) -> bytes:
        """Return the request as one line."""
        return json.dumps(asdict(self)).encode() + b"\n"


def main() -> int:
    """Train what the first line of standard input asks for, and return the exit status."""
    return serve(lambda descriptor, _: Events(descriptor), train)


def train(events: Events, line: bytes, stop: StopRequest) -> None:
    """Train what a request asks for."""
    request = Request(**json.loads(line))
    from wheelleg_exp.config.checking.find_mistakes import compose_valid
    from wheelleg_exp.config.composing.compose_sweep import digest_of
    from wheelleg_exp.packages import with_current

    folders = with_current([Path(folder) for folder in request.config_dirs])
    composed = compose_valid(request.overrides, config_dirs=folders)
    if digest_of(composed) != request.digest:
        raise ConfigError(
            "the config files have changed since the sweep was checked",
            expected="files that stay as they are until the last job has begun",
        )

    from wheelleg_exp.jobs.train import run_training
    from wheelleg_exp.lint.physics_check import examine

    stop.check()
    ready = run_training.prepare(composed, request.command, events)
    events.send("run", path=str(ready.directory.path))
    for finding in examine(composed).open:
        events.note(f"warning: {finding.line()}")
    run_training.run(ready, events, stop)


if __name__ == "__main__":
    sys.exit(main())
