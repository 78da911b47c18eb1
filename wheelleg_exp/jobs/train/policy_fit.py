"""Whether a policy that was trained in one task can begin in another: what it sees, what it does, its networks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wheelleg_exp.config.changes import ABSENT, Change, changes, same
from wheelleg_exp.errors import ConfigError

# Of an observation group: what its vector's layout follows from, beside its terms.
_LAYOUT = ("history_length", "flatten_history_dim", "history_order", "concatenate_terms", "concatenate_dim")
_TERM = ("_target_", "history_length", "flatten_history_dim")  # of a term: what is another term, or another width
_FREE = ("noise",)  # of an observation term: what a policy may meet anew
_SHOWN = 60


@dataclass(frozen=True)
class Fit:
    """How what a policy was trained with differs from what it is to begin with.

    Attributes:
        mistakes: why it cannot begin there.
        suspects: other joints, bodies or sensors of a term, which may or may not change its width.
        notes: what keeps its place in the vectors and means something else; the suspects in words among them.
    """

    mistakes: list[ConfigError]
    suspects: list[ConfigError]
    notes: list[str]


def fit(
    was: tuple[Mapping[str, Any], Mapping[str, Any]],
    now: tuple[Mapping[str, Any], Mapping[str, Any]],
    roles: Sequence[str],
    of: str,
) -> Fit:
    """Hold the settings of a policy's training against those of another.

    Whether a changed parameter of a term changes its width, such as other joints, is told by the networks alone: it is
    among the notes, which explain a network that does not fit.

    Args:
        was: the ``env`` and ``agent`` sections that it was trained with, plain.
        now: those that it is to begin with.
        roles: which networks are taken over, of ``actor`` and ``critic``.
        of: whose policy it is, for the messages.
    """
    found = Fit([], [], [])
    (old_env, old_agent), (env, agent) = was, now
    for role in roles:
        _compare_networks(found, old_agent.get(role), agent.get(role), f"agent.{role}", of)
        groups = [list((part.get("obs_groups") or {}).get(role) or []) for part in (old_agent, agent)]
        if groups[0] != groups[1]:
            _refuse(found, f"agent.obs_groups.{role}", f"{of} has {groups[0]} and this has {groups[1]}")
        for name in (name for name in groups[1] if name in groups[0]):
            pair = [(part.get("observations") or {}).get(name) or {} for part in (old_env, env)]
            _compare_group(found, pair[0], pair[1], f"env.observations.{name}", of)
    pair = [part.get("actions") or {} for part in (old_env, env)]
    _compare_terms(found, pair[0], pair[1], "env.actions", of, ("_target_",), ())
    orders = [(part.get("robot") or {}).get("joint_order") for part in (old_env, env)]
    if orders[0] != orders[1]:
        _refuse(found, "env.robot.joint_order", f"{of} has {orders[0]} and this has {orders[1]}")
    if old_env.get("decimation") != env.get("decimation"):
        found.notes.append(_told("env.decimation", old_env.get("decimation"), env.get("decimation")))
    mistakes = {(error.key, error.message): error for error in found.mistakes}
    return Fit(list(mistakes.values()), found.suspects, list(dict.fromkeys(found.notes)))


def _compare_networks(found: Fit, was: Any, now: Any, key: str, of: str) -> None:
    for change in _changes(was or {}, now or {}):
        if change.keys != ("distribution_cfg", "init_std"):  # what has been learned stands in its place
            _refuse(found, f"{key}.{'.'.join(change.keys)}", f"{of} has {_brief(change.a)} and this {_brief(change.b)}")


def _compare_group(found: Fit, was: Mapping[str, Any], now: Mapping[str, Any], key: str, of: str) -> None:
    for name in _LAYOUT:
        if was.get(name) != now.get(name):
            _refuse(found, f"{key}.{name}", f"{of} has {was.get(name)} and this {now.get(name)}")
    _compare_terms(found, was.get("terms") or {}, now.get("terms") or {}, f"{key}.terms", of, _TERM, _FREE)


def _compare_terms(
    found: Fit,
    was: Mapping[str, Any],
    now: Mapping[str, Any],
    key: str,
    of: str,
    fixed: Sequence[str],
    free: Sequence[str],
) -> None:
    for name in now:
        if name not in was:
            _refuse(found, f"{key}.{name}", f"is new: {of} does not have it")
    for name in was:
        if name not in now:
            _refuse(found, f"{key}.{name}", f"is missing: {of} has it")
    if set(was) == set(now) and list(was) != list(now):
        _refuse(found, key, f"{of} has them in the order {', '.join(was)}")
    for name in (name for name in now if name in was):
        for change in _changes(was[name] or {}, now[name] or {}):
            path = f"{key}.{name}.{'.'.join(change.keys)}"
            if change.keys[0] in fixed:
                _refuse(found, path, f"{of} has {_brief(change.a)} and this {_brief(change.b)}")
            elif change.keys[0] not in free:
                if change.keys[0].endswith("_cfg") or change.keys[0] == "joint_names":
                    found.suspects.append(_error(path, f"{of} has {_brief(change.a)} and this {_brief(change.b)}"))
                found.notes.append(_told(path, change.a, change.b))


def _refuse(found: Fit, key: str, message: str) -> None:
    found.mistakes.append(_error(key, message))


def _error(key: str, message: str) -> ConfigError:
    expected = "the observations, actions and networks that it was trained with, or init_from=null"
    return ConfigError(message, key=key, expected=expected)


def _changes(was: Any, now: Any) -> Iterator[Change]:
    return changes(was, now, same)


def _told(key: str, was: Any, now: Any) -> str:
    return f"{key} was {_brief(was)} and is {_brief(now)}"


def _brief(value: Any) -> str:
    text = "nothing" if value is ABSENT else str(value)
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."
