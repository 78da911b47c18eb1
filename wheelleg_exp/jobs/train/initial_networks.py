"""Networks of another run with which a training starts: the initial policy of ``init_from``, and a teacher.

Each run directory has its own copy of the initial networks, so that a reproduction needs no other run.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from wheelleg_exp.asset import CachedConversion
from wheelleg_exp.config.config_errors import raise_all
from wheelleg_exp.config.explaining.config_diff import ABSENT, Change, changes, same
from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.files import sha256
from wheelleg_exp.jobs.train.source_roots import shorten
from wheelleg_exp.paths import INITIAL, TEACHER
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.network_loading import Initial
from wheelleg_exp.run.file_inventory import MANIFEST_NAME
from wheelleg_exp.run.run_config import load_params, upgrade_env_params
from wheelleg_exp.run.run_directory import CHECKPOINT, RunDirectory, checkpoint_iteration

# ``_LAYOUT_KEYS`` are the config keys of an observation group that decide the layout of the observation vector.
_LAYOUT_KEYS = ("history_length", "flatten_history_dim", "history_order", "concatenate_terms", "concatenate_dim")
# ``_TERM_KEYS`` are the config keys of an observation term that decide its function and its number of values.
_TERM_KEYS = ("_target_", "history_length", "flatten_history_dim")
Tree = Mapping[str, Any]  # a config section or a loaded checkpoint
_IGNORED_KEYS = ("noise",)  # A trained policy still works if the ``noise`` of an observation term changes.


@dataclass(frozen=True)
class Fit:
    """The settings of a new training that differ from the training of its initial policy."""

    mistakes: list[ConfigError]  # ``mistakes`` lists changed settings with which the initial policy cannot work.
    suspects: list[ConfigError]  # ``suspects`` names changed joints and sensors that may change the observation size.
    notes: list[str]  # ``notes`` reports changed settings after which the trained policy may still work.
    further: dict[str, list[str]]  # new observation terms after all others, by network; their weights start at 0
    scales: dict[str, float]  # former over present scale of each action term whose scale is another number


def fit(was: tuple[Tree, Tree], now: tuple[Tree, Tree], roles: Sequence[str], of: str) -> Fit:
    """Compare the ``env`` and ``agent`` configs of a policy's training, ``was``, with those of a new training, ``now``.

    ``of`` names the policy's training in errors. A changed parameter of an observation function gives only a note.
    """
    found = Fit([], [], [], {}, {})
    (old_env, old_agent), (env, agent) = was, now
    for role in roles:
        for change in changes(old_agent.get(role) or {}, agent.get(role) or {}, same):
            # The checkpoint's learned action std replaces init_std.
            if change.keys != ("distribution_cfg", "init_std"):
                _refuse(found, f"agent.{role}.{'.'.join(change.keys)}", _both_values(change, of))
        groups = [list((part.get("obs_groups") or {}).get(role) or []) for part in (old_agent, agent)]
        if groups[0] != groups[1]:
            _refuse(found, f"agent.obs_groups.{role}", f"{of} has {groups[0]}, and this training has {groups[1]}")
        for name in (name for name in groups[1] if name in groups[0]):
            was_group, group = ((part.get("observations") or {}).get(name) or {} for part in (old_env, env))
            for key in _LAYOUT_KEYS:
                if was_group.get(key) != group.get(key):
                    message = f"{of} has {was_group.get(key)}, and this training has {group.get(key)}"
                    _refuse(found, f"env.observations.{name}.{key}", message)
            old, new = was_group.get("terms") or {}, group.get("terms") or {}
            # The inputs of new terms after all old terms of the last group are the last inputs of the network.
            is_last = name == groups[1][-1] and group.get("history_order") != "time"
            further = list(new)[len(old) :] if is_last and list(new)[: len(old)] == list(old) else []
            found.further[role], path = further, f"env.observations.{name}.terms"
            found.notes.extend(f"{path}.{term} was absent and is new (its weights start at 0)" for term in further)
            known = {term: node for term, node in new.items() if term not in further}
            _compare_terms(found, old, known, path, of, _TERM_KEYS, _IGNORED_KEYS)
    pair = [part.get("actions") or {} for part in (old_env, env)]
    _compare_terms(found, pair[0], pair[1], "env.actions", of, ("_target_",), ())
    for name in (name for name in pair[1] if name in pair[0]):
        before, after = (terms[name].get("scale") for terms in pair)
        if {type(before), type(after)} <= {int, float} and before and after and before != after:
            found.scales[name] = before / after
    profiles = [(part.get("robot") or {}).get("profile") for part in (old_env, env)]
    if profiles[0] != profiles[1]:
        found.notes.append(_describe_change("env.robot.profile", *profiles))
    orders = [(part.get("robot") or {}).get("joint_order") for part in (old_env, env)]
    if orders[0] != orders[1]:
        _refuse(found, "env.robot.joint_order", f"{of} has {orders[0]}, and this training has {orders[1]}")
    if old_env.get("decimation") != env.get("decimation"):
        found.notes.append(_describe_change("env.decimation", old_env.get("decimation"), env.get("decimation")))
    mistakes = {(error.key, error.message): error for error in found.mistakes}
    return replace(found, mistakes=list(mistakes.values()), notes=list(dict.fromkeys(found.notes)))


def _compare_terms(
    found: Fit, was: Tree, now: Tree, key: str, of: str, fixed: Sequence[str], free: Sequence[str]
) -> None:
    for name in now:
        if name not in was:
            _refuse(found, f"{key}.{name}", f"is new, and {of} does not have it")
    for name in was:
        if name not in now:
            _refuse(found, f"{key}.{name}", f"is missing: {of} has it")
    if set(was) == set(now) and list(was) != list(now):
        _refuse(found, key, f"{of} has them in the order {', '.join(was)}")
    for name in (name for name in now if name in was):
        for change in changes(was[name] or {}, now[name] or {}, same):
            path = f"{key}.{name}.{'.'.join(change.keys)}"
            if change.keys[0] in fixed:
                _refuse(found, path, _both_values(change, of))
            elif change.keys[0] not in free:
                if change.keys[0].endswith("_cfg") or change.keys[0] == "joint_names":
                    found.suspects.append(_error(path, _both_values(change, of)))
                found.notes.append(_describe_change(path, change.a, change.b))


def _refuse(found: Fit, key: str, message: str) -> None:
    found.mistakes.append(_error(key, message))


def _error(key: str, message: str) -> ConfigError:
    expected = "the observations, actions and networks that it was trained with, or init_from=null"
    return ConfigError(message, key=key, expected=expected)


def _both_values(change: Change, of: str) -> str:
    return f"{of} has {_shorten(change.a)}, and this training has {_shorten(change.b)}"


def _describe_change(key: str, was: object, now: object) -> str:
    return f"{key} was {_shorten(was)} and is {_shorten(now)}"


def _shorten(value: object) -> str:
    return "nothing" if value is ABSENT else shorten(value)


KEY, WHAT = "init_from", "init_from_what"
# ``PARTS`` maps each value of ``init_from_what`` to the checkpoint entries that a new training copies.
PARTS = {"networks": ("actor", "critic"), "policy": ("actor",), "learning": ("actor", "critic", "optimizer")}


@dataclass(frozen=True)
class _Source:
    path: Path
    run: RunDirectory | None

    @property
    def label(self) -> str:
        return str(self.path) if self.run is None else f"{self.run.path.parent.name}/{self.run.id}"


@contextmanager
def initial_file(config: Tree, note: Callable[[str], None]) -> Iterator[tuple[dict[str, Path], dict[str, str]]]:
    """Yield the initial networks' file as ``{INITIAL: path}``, and the id and task of the run that trained them.

    Equal networks have equal files. If ``init_from`` is missing, is damaged, or does not fit, raise ConfigError.
    """
    if config.get(KEY) is None:
        yield {}, {}
        return
    with _at_key(KEY):
        source = _find(str(config[KEY]), config["run"]["root"])
        state = checkpoint.load(source.path)
        # Copy the networks that ``init_from_what`` selects into a new checkpoint, and add the networks' origin.
        what = str(config.get(WHAT) or "networks")
        parts = PARTS[what]
        if "actor" not in config["agent"]:
            raise ConfigError("a distillation must train a new student", key=KEY, expected="null, or another agent")
        absent = [part for part in parts[1:] if f"{part}_state_dict" not in state]
        if absent:
            message = f"'{source.label}' has no {absent[0]} to start with"
            raise ConfigError(message, key=WHAT, expected="policy, which needs only the actor")
        facts = {"checkpoint": source.path.name, "iteration": int(state["iter"]), "sha256": sha256(source.path)}
        facts |= {"what": what, "parts": list(parts)}
        # Every checkpoint has a critic entry, so write an empty dictionary if the critic is not copied.
        networks = {"actor_state_dict": checkpoint.policy_state(state), "critic_state_dict": {}}
        networks |= {f"{part}_state_dict": state[f"{part}_state_dict"] for part in parts[1:]}
        facts |= _require_fit(source, config, parts[:2], note)
        if facts.keys() & {"further", "scales"} and "optimizer" in parts:
            message = f"the optimiser of '{source.label}' does not fit the converted networks"
            raise ConfigError(message, key=WHAT, expected="networks or policy")
        part = {"format_version": checkpoint.FORMAT_VERSION, "iter": int(state["iter"]), **networks, "init_from": facts}
    with tempfile.TemporaryDirectory(prefix="wheelleg-init-") as folder:
        path = Path(folder) / Path(INITIAL).name
        path.write_bytes(checkpoint.serialize(part))
        run = source.run
        yield {INITIAL: path}, {} if run is None else {"run": run.id, "task": str(run.manifest().data["task"])}


def saved_initial(init_from: str | None, asset: CachedConversion) -> Initial | None:
    """Load the initial networks from the run directory; return None if the config has no ``init_from``."""
    if init_from is None:
        return None
    path = asset.output.parent / INITIAL
    if not path.is_file():
        message = f"is missing: the training started with the policy of '{init_from}'"
        expected = "the saved networks; without them the run cannot be trained again from its start"
        raise RunDirectoryError(message, key=str(path), expected=expected)
    state = checkpoint.load(path)
    facts = state.get("init_from")
    if not isinstance(facts, Mapping):
        message = "does not name the run of the initial networks"
        raise RunDirectoryError(message, key=str(path), expected="the file that the run saved")
    parts = [str(part) for part in facts.get("parts") or ()]
    named = {"named": init_from, "kept": INITIAL, "kept_sha256": sha256(path)}
    return Initial(state, tuple(parts), {**facts, **named})


def _find(named: str, root: str) -> _Source:
    path = Path(named)
    run: RunDirectory | None
    if path.is_file():
        folder = path.resolve().parent
        run = RunDirectory.open(folder, root) if (folder / MANIFEST_NAME).is_file() else None
    else:
        if CHECKPOINT.fullmatch(path.name) and (path.parent / MANIFEST_NAME).is_file():
            # For a missing checkpoint, the method ``checkpoint`` raises an error that suggests a similar name.
            RunDirectory.open(path.parent, root).checkpoint(checkpoint_iteration(path))
        run = RunDirectory.open(named, root)
        path = run.latest_checkpoint()
    if run is not None and not run.manifest().matches_record(path):
        expected = "a checkpoint nobody has changed"
        raise RunDirectoryError("the checkpoint file was changed after the training", key=str(path), expected=expected)
    return _Source(path, run)


def _require_fit(source: _Source, config: Tree, roles: Sequence[str], note: Callable[[str], None]) -> dict[str, Tree]:
    """Raise ConfigError if the networks do not fit; return ``Fit.scales`` and ``Fit.further`` without empty values."""
    if source.run is None:
        return {}
    env, agent = load_params(source.run)
    if "actor" not in agent:  # A distillation run has no config section ``actor``, so nothing is compared.
        return {}
    found = fit((upgrade_env_params(env), agent), (config["env"], config["agent"]), roles, f"'{source.label}'")
    if found.mistakes:
        raise_all(found.mistakes)
    for line in found.notes:
        note(f"note: {line}; the policy of '{source.label}' was trained with the former")
    for name in found.scales:
        note(f"note: the initial networks are converted to the new scale of env.actions.{name}")
    further = {role: names for role, names in found.further.items() if names}
    return {name: value for name, value in (("scales", found.scales), ("further", further)) if value}


@contextmanager
def _at_key(key: str) -> Iterator[None]:
    """Replace a RunDirectoryError of the ``with`` block by a ConfigError that names the config key ``key``."""
    try:
        yield
    except RunDirectoryError as error:
        message = error.message if error.key is None else f"'{error.key}': {error.message}"
        raise ConfigError(message, key=key, expected=error.expected, nearest=error.nearest) from error


def find_teacher(config: Tree) -> dict[str, Path]:
    """Return the teacher's checkpoint file as ``{TEACHER: path}``, or {} if the config names no teacher."""
    named = config["agent"].get("teacher_checkpoint")
    if named is None:
        return {}
    with _at_key("agent.teacher_checkpoint"):
        path = Path(named)
        if not path.is_file():
            path = RunDirectory.open(named, config["run"]["root"]).latest_checkpoint()
        checkpoint.load(path)
    return {TEACHER: path}
