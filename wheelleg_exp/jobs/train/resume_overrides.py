"""Overrides of a resume: which settings can change while a run continues, and which snapshot files they rewrite."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import OmegaConf

from wheelleg_exp.config import schema
from wheelleg_exp.config.checking.find_mistakes import check_tree
from wheelleg_exp.config.composing.compose import apply_overrides, placing
from wheelleg_exp.config.config_errors import raise_all
from wheelleg_exp.config.explaining.config_diff import ABSENT, Change, changes
from wheelleg_exp.config.tree_lookup import at, section_at
from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.plain_data import dump_yaml
from wheelleg_exp.run import run_config
from wheelleg_exp.run.run_directory import RunDirectory
from wheelleg_exp.terms.key_syntax import Keys
from wheelleg_exp.terms.term_binding import RESERVED
from wheelleg_exp.verify.run_differences import decides

_SHAPE = "the checkpoint holds networks of this shape"
# ``_FIXED`` maps each setting that a resume cannot change to the reason.
_FIXED: dict[Keys, str] = {
    ("seed",): "the random streams continue from their saved state",
    ("task",): "the run belongs to its task",
    **dict.fromkeys((("init_from",), ("init_from_what",)), "the run started with these networks"),
    ("run",): "the run directory exists already",
    ("env", "num_envs"): "the saved state has a row for each environment",
    ("env", "decimation"): "all saved times count in its steps",
    **dict.fromkeys((("env", "sim"), ("env", "scene")), "it is part of the simulated model"),
    ("env", "robot"): "the saved state is that of the run's robot",
    ("env", "realism"): "the saved state is that of robots with these errors",
    ("env", "actions"): "the networks were trained with these actions",
    **{("agent", key): _SHAPE for key in ("actor", "critic", "student", "teacher", "obs_groups")},
    ("agent", "teacher_checkpoint"): "the run learns from one teacher",
    ("agent", "algorithm", "class_name"): "the checkpoint holds this algorithm's state",
    ("agent", "algorithm", "optimizer"): "the checkpoint holds this optimiser's state",
    ("agent", "algorithm", "rnd_cfg"): _SHAPE,
}
_CHANGEABLE = (("env", "sim", "graph_step"),)  # A resume can switch CUDA graphs (``env.sim.graph_step``) on or off.
_NEW_KEYS = ("init_from", "init_from_what")  # Configs of old runs lack ``init_from`` and ``init_from_what``.
_OBSERVATION_CHANGEABLE = ("noise", "clip", "scale", "enable_corruption")


def recorded_tree(run: RunDirectory, variables: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return the composed config of a run from the run's snapshot."""
    env, agent = run_config.load_params(run)
    tree = run_config.recorded_config(run, variables or {})
    for key, kind in (("seed", int), ("task", dict), ("recording", dict), ("run", dict)):
        if not isinstance(tree[key], kind):
            message = f"'{key}' is missing or wrong"
            raise RunDirectoryError(message, key=str(run.path / run_config.CONFIG), expected="the config of the run")
    earlier = {key: value for key, value in tree.items() if value is not None or key not in _NEW_KEYS}
    return {**earlier, "env": run_config.upgrade_env_params(env), "agent": agent}


def change_settings(recorded: Mapping[str, object], overrides: Sequence[str]) -> tuple[dict[str, Any], list[Change]]:
    """Apply the overrides of a resume; return the new config and its changes, or raise ConfigError for a fixed key."""
    tree = apply_overrides(recorded, overrides)
    run_config.require_resolved({part: tree.get(part) for part in run_config.PARTS})
    found = list(changes(recorded, tree, lambda was, now: type(was) is type(now) and bool(was == now)))
    with placing(overrides):
        for change in found:
            _require_changeable(change, recorded, tree)
        errors = check_tree(tree, schema.Experiment)
        if errors:
            raise_all(errors)
    return tree, found


def change_entry(change: Change) -> dict[str, object]:
    """Return a config change for the manifest; a missing key has the value None."""
    was, now = (None if value is ABSENT else value for value in (change.a, change.b))
    return {"key": change.key, "was": was, "now": now}


def _require_changeable(change: Change, recorded: Mapping[str, object], tree: Mapping[str, object]) -> None:
    if not decides(change.keys) or change.keys in _CHANGEABLE:
        return
    for prefix, why in _FIXED.items():
        if change.keys[: len(prefix)] == prefix or prefix[: len(change.keys)] == change.keys:
            raise _refusal(change, why)
    if change.keys[:2] == ("env", "observations") and not set(change.keys[3:]) & set(_OBSERVATION_CHANGEABLE):
        raise _refusal(change, "the networks were trained with this observation")
    section = change.keys[1] if change.keys[0] == "env" and len(change.keys) > 1 else ""
    if section in RESERVED and section != "observations":
        now = at(tree, ("env", section))
        if not isinstance(now, Mapping) or list(now) != list(section_at(recorded, ("env", section))):
            why = "the saved state has a place for each term of the run; a weight of 0 turns a reward off"
            raise _refusal(change, why)
        if change.keys[3:] in ((), ("_target_",), ("mode",)):
            raise _refusal(change, "the saved state is that of the run's own terms")


def _refusal(change: Change, why: str) -> ConfigError:
    message = f"cannot change in a resume: {why}"
    other = "a new run can have another value and, with init_from=RUN, start from this run's networks if they fit"
    return ConfigError(message, key=change.key, expected=f"the run's own value; {other}")


def rewritten_files(
    run: RunDirectory, tree: Mapping[str, object], found: Sequence[Change], overrides: Sequence[str]
) -> dict[str, str]:
    """Return the run's config files with the changed settings as ``{path: text}``, or {} without a change."""
    if not found:
        return {}
    config = run_config.load_config(run)
    for change in found:
        _apply(config, change, tree)
    # The overrides of a resume replace overrides of the run with the same keys.
    words = {_key(word): word for word in (*run_config.recorded_overrides(run), *overrides)}
    return {
        "params/env.yaml": dump_yaml(tree["env"]),
        "params/agent.yaml": dump_yaml(tree["agent"]),
        run_config.CONFIG: OmegaConf.to_yaml(OmegaConf.create(config)),
        run_config.OVERRIDES: OmegaConf.to_yaml(OmegaConf.create(list(words.values()))),
    }


def _apply(config: dict[str, object], change: Change, tree: Mapping[str, object]) -> None:
    """Change a key in the run's config; if an interpolation stands for a parent of the key, resolve it first."""
    node: Any = config
    for key in change.keys[:-1]:
        tree = section_at(tree, (key,))
        if isinstance(node.get(key), str):
            node[key] = copy.deepcopy(dict(tree))
        elif node.get(key) is None:
            node[key] = {}
        node = node[key]
    if change.b is ABSENT:
        node.pop(change.keys[-1], None)
    else:
        node[change.keys[-1]] = change.b


def _key(word: str) -> str:
    try:
        override = OverridesParser.create().parse_override(word)
    except (HydraException, RecursionError):  # If Hydra cannot parse an override, its whole text is the key.
        return word
    return f"{override.key_or_group}@{override.package or ''}"
