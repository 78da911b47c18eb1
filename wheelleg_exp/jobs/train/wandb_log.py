"""Scalars sent to Weights & Biases: the run's name, its composed config and its scalars, and nothing else.

rsl_rl's own writer sends the local path and a git diff besides, takes the account from ``WANDB_USERNAME`` for a team's,
and uploads every film, so it is not used.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any

from wheelleg_exp.errors import ConfigError, WheellegError
from wheelleg_exp.run.directory import RunDirectory

_KEY, _NAME = "agent.logger", "wandb"
_PROJECT = "wheelleg_exp"
# What the library would send of its own accord: the machine, the program, the packages, the console, the source.
_NOTHING_ELSE = {
    "console": "off",
    "disable_code": True,
    "disable_git": True,
    "disable_job_creation": True,
    "host": "",
    "save_code": False,
    "silent": True,
    "x_disable_machine_info": True,
    "x_disable_meta": True,
    "x_disable_stats": True,
    "x_save_requirements": False,
}


def require_wandb(logger: str | None) -> None:
    """Refuse a logger whose package is not installed.

    Raises:
        ConfigError: with how to install it.
    """
    if logger == _NAME and find_spec(_NAME) is None:
        raise ConfigError(
            "the package wandb is not installed", key=_KEY, expected="pip install wheelleg_exp[wandb], or tensorboard"
        )


class WandbLog:
    """Sends an iteration's scalars, from entering to leaving, where wandb's variables say (``WANDB_MODE``, ...).

    A run that is gone on with goes on there as well, under the same id.

    Args:
        directory: the run directory; its name is the run's.
        config: the composed config.
    """

    def __init__(self, directory: RunDirectory, config: Mapping[str, Any]) -> None:
        self._directory, self._config = directory, config

    def __enter__(self) -> WandbLog:
        import wandb

        task, moment = self._directory.path.parent.name, self._directory.manifest().started
        try:
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", _PROJECT),
                name=f"{task}/{self._directory.id}",
                id=f"{task}-{self._directory.id}-{moment:%f}",  # seeds may start in one second on many machines
                resume="allow",
                dir=os.environ.get("WANDB_DIR", str(self._directory.root)),
                config=dict(self._config),
                force=True,  # a question for a key would wait for an answer
                settings=wandb.Settings(**_NOTHING_ELSE),
            )
        except wandb.Error as error:
            raise WheellegError(
                f"Weights & Biases cannot be reached: {str(error).splitlines()[0]}",
                key=_KEY,
                expected="a login ('wandb login'), or WANDB_MODE=offline in the environment",
            ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._run.finish(exit_code=0 if kind is None else 1)

    @property
    def place(self) -> str:
        """Where it goes: the run's page, or the folder that ``wandb sync`` sends later."""
        return str(Path(self._run.dir).parent if self._run.offline else self._run.url)

    def write(self, scalars: Mapping[str, float], iteration: int) -> None:
        """Send one iteration's scalars; an iteration that was sent before stays as it is."""
        self._run.log(dict(scalars), step=iteration)
