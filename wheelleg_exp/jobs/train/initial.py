"""What a training begins with out of another run: found as the config names it, and kept beside the robot.

The run keeps the networks themselves, so that it can be trained again without the run that they are from.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheelleg_exp.asset import CachedConversion
from wheelleg_exp.config.problems import raise_all
from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.files import sha256
from wheelleg_exp.jobs.train.policy_fit import fit
from wheelleg_exp.paths import INITIAL
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.initial import Initial
from wheelleg_exp.run.directory import CHECKPOINT, RunDirectory, checkpoint_iteration
from wheelleg_exp.run.inventory import MANIFEST_NAME
from wheelleg_exp.run.params import load_params, present_form

KEY, WHAT = "init_from", "init_from_what"
# What is taken over, by the value of `init_from_what`: parts of a checkpoint.
PARTS = {
    "networks": ("actor", "critic"),
    "policy": ("actor",),
    "learning": ("actor", "critic", "optimizer"),
}


@dataclass(frozen=True)
class _Source:
    """The checkpoint that a training begins with, and the run that it is of; a file alone has none."""

    path: Path
    run: RunDirectory | None

    @property
    def label(self) -> str:
        return str(self.path) if self.run is None else f"{self.run.path.parent.name}/{self.run.id}"


@contextmanager
def initial_file(
    config: Mapping[str, Any], note: Callable[[str], None]
) -> Iterator[tuple[dict[str, Path], dict[str, Any]]]:
    """Yield the file of what a training begins with by its name beside the robot, and whose it is; both may be empty.

    The file does not say whose it is: the same networks of two runs are one file.

    Args:
        config: the composed tree, plain.
        note: is told what the policy reads otherwise than it was trained to.

    Raises:
        ConfigError: there is no such run or checkpoint, it is damaged, or it does not fit the observations, actions
            and networks of the config; it names those that do not.
    """
    if config.get(KEY) is None:
        yield {}, {}
        return
    with _blamed():
        source = _find(str(config[KEY]), config["run"]["root"])
        state = checkpoint.load(source.path)
        kept = _kept_part(source, state, config)
    _require_fit(source, config, list(PARTS[_what(config)])[:2], note)
    with tempfile.TemporaryDirectory(prefix="wheelleg-init-") as folder:
        path = Path(folder) / Path(INITIAL).name
        path.write_bytes(checkpoint.serialize(kept))
        yield {INITIAL: path}, _whose(source)


def kept_initial(config: Mapping[str, Any], asset: CachedConversion) -> Initial | None:
    """Return what a training begins with, as it lies beside its robot; None where it begins from nothing.

    Raises:
        RunDirectoryError: the config names a run, and nothing is kept of it.
    """
    if config.get(KEY) is None:
        return None
    path = asset.output.parent / INITIAL
    if not path.is_file():
        raise RunDirectoryError(
            f"is missing: the training began with the policy of '{config[KEY]}'",
            key=str(path),
            expected="the networks that the run has kept; without them it cannot be trained again from its beginning",
        )
    state = checkpoint.load(path)
    facts = state.get("init_from")
    if not isinstance(facts, Mapping):
        raise RunDirectoryError("does not say whose it is", key=str(path), expected="the file that the run has kept")
    parts = [str(part) for part in facts.get("parts") or ()]
    return Initial(
        state, tuple(parts), {**facts, "named": str(config[KEY]), "kept": INITIAL, "kept_sha256": sha256(path)}
    )


def _kept_part(source: _Source, state: Mapping[str, Any], config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a checkpoint that is taken over, in the form of a checkpoint, and where it is from."""
    what = _what(config)
    parts = PARTS[what]
    if "actor" not in config["agent"]:
        raise ConfigError("a student learns from its teacher alone", key=KEY, expected="null, or another agent")
    absent = [part for part in parts[1:] if f"{part}_state_dict" not in state]
    if absent:
        raise ConfigError(
            f"'{source.label}' has no {absent[0]} to begin with",
            key=WHAT,
            expected="policy, which takes the actor alone",
        )
    facts = {
        "checkpoint": source.path.name,
        "iteration": int(state["iter"]),
        "sha256": sha256(source.path),
        "what": what,
        "parts": list(parts),
    }
    # A checkpoint has two networks; of the one that is not taken over nothing is read.
    networks = {"actor_state_dict": checkpoint.policy_state(state), "critic_state_dict": {}}
    networks |= {f"{part}_state_dict": state[f"{part}_state_dict"] for part in parts[1:]}
    return {"format_version": checkpoint.FORMAT_VERSION, "iter": int(state["iter"]), **networks, "init_from": facts}


def _whose(source: _Source) -> dict[str, Any]:
    run = source.run
    return {} if run is None else {"run": run.id, "task": str(run.manifest().data["task"])}


def _what(config: Mapping[str, Any]) -> str:
    return str(config.get(WHAT) or "networks")


def _find(named: str, root: str) -> _Source:
    path = Path(named)
    if not path.is_file():
        if CHECKPOINT.fullmatch(path.name) and (path.parent / MANIFEST_NAME).is_file():
            RunDirectory.open(path.parent, root).checkpoint(checkpoint_iteration(path))  # tells the nearest there is
        run = RunDirectory.open(named, root)
        return _recorded(_Source(run.latest_checkpoint(), run))
    folder = path.resolve().parent
    run_there = RunDirectory.open(folder, root) if (folder / MANIFEST_NAME).is_file() else None
    return _recorded(_Source(path, run_there))


def _recorded(source: _Source) -> _Source:
    """Refuse a checkpoint that is not what its run has recorded."""
    if source.run is not None and not source.run.manifest().vouches_for(source.path):
        raise RunDirectoryError(
            "is not what its run recorded", key=str(source.path), expected="a checkpoint nobody has changed"
        )
    return source


def _require_fit(source: _Source, config: Mapping[str, Any], roles: list[str], note: Callable[[str], None]) -> None:
    if source.run is None:
        return
    env, agent = load_params(source.run)
    if "actor" not in agent:  # a student's networks go by other names
        return
    found = fit((present_form(env), agent), (config["env"], config["agent"]), roles, f"'{source.label}'")
    if found.mistakes:
        raise_all(found.mistakes)
    for line in found.notes:
        note(f"note: {line}; the policy of '{source.label}' was trained with the former")


@contextmanager
def _blamed() -> Iterator[None]:
    try:
        yield
    except RunDirectoryError as error:
        message = error.message if error.key is None else f"'{error.key}' {error.message}"
        raise ConfigError(message, key=KEY, expected=error.expected, nearest=error.nearest) from error
