"""Convert the terms of Isaac Lab's ``env.yaml``: commands, actions, observations, events, rewards, and so on."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import import_module
from types import ModuleType

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.isaaclab import OF_VERSION_3
from wheelleg_exp.isaaclab_import.import_report import (
    ASSUMED,
    CODE,
    DROPPED,
    NAME,
    RULE,
    ImportReport,
    Row,
    Section,
    shown,
)
from wheelleg_exp.jobs.export.isaaclab_run import MODIFIERS, NOISES, OWN_TERMS, Tree
from wheelleg_exp.terms.term_binding import RESERVED, resolve_target, signature_parameters

_STOCK = re.compile(
    r"(omni\.isaac\.lab|isaaclab|wheelleg_exp\.mdp)\.|"
    r"(omni\.isaac\.lab_tasks|isaaclab_tasks)\.(manager_based\.locomotion|core|contrib)\.velocity\.mdp\b"
)
# Settings of commands that only change the log and what is drawn.
_SHOWN = re.compile(r"debug_vis|marker_pos_offset|.*success_threshold")
_WITH_QUATERNIONS = ("root_quat_w", "body_pose_w", "imu_orientation")
_NOISE_KEYS = ("noise", "noise_cfg", "bias_noise_cfg")
_OWN = "wheelleg_exp."

# Returns the target of a function of the author, given its path and the names of its parameters.
UserTarget = Callable[[str, Iterable[str]], str | None]


class TermMapping:
    """Converts terms of the run's robot ``robot_name``; ``lost`` has the row of one that a group lacks."""

    def __init__(
        self, env: Tree, robot_name: str, user_target: UserTarget, report: ImportReport, *, xyzw: bool
    ) -> None:
        self._env, self._robot_name, self._user_target, self._report = env, robot_name, user_target, report
        self._xyzw = xyzw
        self.lost: dict[str, Row] = {}

    def section(self, kind: str, part: Section) -> Tree:
        """Return the config of all terms of one kind, or of all observation groups."""
        if kind == "observations":
            return {name: self._group(group, name) for name, group in self._nodes(part)}
        terms = {name: self._term(kind, node) for name, node in self._nodes(part)}
        return {name: term for name, term in terms.items() if term is not None}

    def _nodes(self, part: Section) -> Iterator[tuple[str, Section]]:
        """Yield and remove the mappings of a section; report its other values."""
        for name, node in part.items():
            key = f"{part.key}.{name}"
            if isinstance(node, Mapping):
                yield name, Section(node, key, self._report)
            else:
                self._report.add(key, DROPPED, f"{shown(node)}: not a term")

    def _group(self, part: Section, name: str) -> Tree:
        group: Tree = {"terms": {}, "concatenate_terms": True, "enable_corruption": False}
        group |= {"history_length": 0, "flatten_history_dim": True}
        no_history = part.left.get("history_length") == 0  # null leaves each term its own history
        group |= part.take_if_known((*[key for key in group if key != "terms"], "concatenate_dim", "history_order"))
        if group.get("concatenate_dim") == -1:
            del group["concatenate_dim"]
        for term, node in self._nodes(part):
            made = self._term("observations", node)
            if made is None:
                self.lost.setdefault(name, self._report.rows[-1])
            else:
                group["terms"][term] = made
                if no_history or not made.get("history_length"):
                    _remove(made, "history_length", "flatten_history_dim")
        if not group["history_length"]:
            _remove(group, "history_length", "flatten_history_dim")
        return group

    def _term(self, kind: str, part: Section) -> Tree | None:
        """Return the config of a term; None if its function does not exist here."""
        func, class_type, params = part.take("func"), part.take("class_type"), part.left.get("params")
        source = str(func or class_type or "")
        target = self._target(kind, source, params if isinstance(params, Mapping) else ())
        if target is None:
            reason = getattr(_module(kind), "ABSENT", {}).get(last_name(source))
            text = f"{source} {shown(part.left, 160)}" if reason is None else f"{source}: {reason}"
            self._report.add(part.key, CODE if reason is None else DROPPED, text)
            return None
        if self._xyzw and kind == "observations" and self._has_quaternion(target, params):
            text = f"{source}: its quaternion is (x, y, z, w) in Isaac Lab 3.0, and (w, x, y, z) here"
            self._report.add(part.key, DROPPED, text)
            return None
        node: Tree = {"_target_": target}
        node |= {key: self._value(key, value) for key, value in part.take_if_known(RESERVED[kind]).items()}
        if kind == "observations":
            node |= self._delay(part)
        if kind == "events" and node.get("mode") != "interval":
            _remove(node, "interval_range_s", "is_global_time")
            _remove(part.left, "resample_interval_on_reset")
        elif kind == "events" and part.take("resample_interval_on_reset", True) is False:
            self._report.add(part.key, DROPPED, "resample_interval_on_reset: timers restart with each episode here")
        if kind == "events" and node.get("mode") != "reset":
            _remove(node, "min_step_count_between_reset")
        parameters = part.section("params")
        if kind in ("actions", "commands", "recorders"):
            parameters = part
            self._change_period(part)
            _remove(part.left, *filter(_SHOWN.fullmatch, part.left))
        node |= self._parameters(parameters, target)
        if kind == "actions" and not node.get("preserve_order") and "joint_names" in node:
            node["joint_names"] = _one_expression(node["joint_names"])
        part.finish()
        if not source.startswith(_OWN) and target.startswith(_OWN) and last_name(source) in OWN_TERMS:
            summary = str(resolve_target(target, part.key).__doc__).partition("\n")[0]
            self._report.add(part.key, ASSUMED, f"{last_name(source)} is that of this project: {summary}")
        elif target.startswith(_OWN):
            self._report.add(part.key, NAME, last_name(source))
        else:
            self._report.add(part.key, RULE, f"{source} became {target}")
        return node

    def _delay(self, part: Section) -> Tree:
        """Return the delay of an observation, which Isaac Lab 3.0 counts in control steps."""
        lags = [part.take("delay_min_lag", 0), part.take("delay_max_lag", 0)]
        hold = part.take("delay_hold_prob", 1.0)
        if not all(isinstance(lag, int) for lag in lags):
            message = f"the lags {lags} are not whole numbers"
            raise ConfigError(message, key=f"{part.key}.delay_max_lag", expected="control steps")
        if not lags[1]:
            return {}
        if hold != 1.0:
            self._report.add(f"{part.key}.delay_hold_prob", DROPPED, f"{hold}: the lag is constant in an episode here")
        delay = [lag * self._env["decimation"] for lag in lags]
        self._report.add(f"{part.key}.delay_max_lag", RULE, f"{lags} control steps became {delay} physics steps")
        return {"delay": delay}

    def _change_period(self, part: Section) -> None:
        """Replace a period of 0 s between draws of a command by the control step, which has the same effect."""
        period = part.left.get("resampling_time_range")
        if isinstance(period, list) and 0.0 in period:
            step = self._env["sim"]["dt"] * self._env["decimation"]
            part.left["resampling_time_range"] = [max(time, step) for time in period]
            text = f"{period}: a new draw in each control step"
            self._report.add(f"{part.key}.resampling_time_range", RULE, text)

    def _parameters(self, part: Section, target: str) -> Tree:
        """Return those parameters of a term that exist here. The author's functions have all parameters."""
        found: Tree = {}
        accepted = parameters_of(target, part.key) if target.startswith(_OWN) else list(part.left)
        for key, value in part.items():
            if key == "asset_name" and value == self._robot_name:
                continue
            if key in accepted:
                found[key] = self._value(key, value)
            else:
                text = f"{shown(value)}: '{last_name(target)}' has no such parameter here"
                self._report.add(f"{part.key}.{key}", DROPPED, text)
        return found

    def _has_quaternion(self, target: str, params: object) -> bool:
        """Return whether an observation contains a quaternion, itself or in its command."""
        command = params.get("command_name") if isinstance(params, Mapping) else None
        node = self._env["commands"].get(command) or {}
        return last_name(target) in _WITH_QUATERNIONS or last_name(node.get("_target_")) == "UniformPoseCommand"

    def _target(self, kind: str, source: str, params: Iterable[str]) -> str | None:
        module, name = _module(kind), last_name(source)
        name = OF_VERSION_3.get(name, name)
        if _STOCK.match(source) and callable(getattr(module, name, None)):
            return f"{module.__name__}.{name}"
        return self._user_target(source, params)

    def _value(self, key: str, value: object) -> object:
        """Return a parameter, in which the nodes of entities, noises, and modifiers have targets of this package."""
        if isinstance(value, list) and key == "modifiers":
            return [_modifier(item) for item in value]
        if not isinstance(value, dict):
            return value
        if value.keys() >= {"name", "joint_names", "body_names"}:
            return self._entity(key, value)
        kind = last_name(value.get("func") or value.get("class_type"))
        if key not in _NOISE_KEYS or not kind:
            return {name: self._value(name, item) for name, item in value.items()}
        kind = "NoiseModelWithAdditiveBias" if "bias_noise_cfg" in value else NOISES.get(kind, kind)
        settings = {name: self._value(name, item) for name, item in value.items() if name not in ("func", "class_type")}
        return {"_target_": f"wheelleg_exp.mdp.noise.{kind}", **settings}

    def _entity(self, key: str, value: Tree) -> Tree:
        """Return the node of joints or bodies of an entity, which the run chooses by names or by numbers."""
        ordered = value.get("preserve_order")
        chosen: Tree = {}
        for part in ("joint", "body"):
            names, ids = value[f"{part}_names"], value.get(f"{part}_ids")
            if names is not None:
                chosen[f"{part}_names"] = names if ordered else _one_expression(names)
            elif ids is not None:
                if not all(isinstance(number, int) for number in ids):
                    message = f"{shown(ids)} is not a list of numbers"
                    raise ConfigError(message, key=f"{key}.{part}_ids", expected=f"names in {part}_names")
                chosen[f"{part}_ids"] = ids
        if ordered:
            chosen["preserve_order"] = True
        return entity("robot" if value["name"] == self._robot_name else value["name"], **chosen)


def _module(kind: str) -> ModuleType:
    """Return the module of this package's terms of a kind; ``mdp.curriculums`` has the terms of ``curriculum``."""
    return import_module(f"wheelleg_exp.mdp.{kind.removesuffix('s')}s")


def _modifier(node: Tree) -> Tree:
    kind = last_name(node.get("func"))
    settings = {name: setting for name, setting in node.items() if name not in ("func", "params")}
    settings |= node.get("params") or {}
    return {"_target_": f"wheelleg_exp.mdp.modifiers.{MODIFIERS.get(kind, kind)}", **settings}


def _one_expression(names: object) -> object:
    """Return several expressions as one, because their order has no effect."""
    return ["|".join(names)] if isinstance(names, list) and len(names) > 1 else names


def _remove(node: Tree, *keys: str) -> None:
    for key in keys:
        node.pop(key, None)


def last_name(path: object) -> str:
    """Return the name after the module of a path such as ``isaaclab.envs.mdp.rewards:is_alive``."""
    return re.split(r"[.:]", str(path or ""))[-1]


def parameters_of(target: str, key: str) -> Mapping[str, object]:
    """Return the parameters of a function or class of this package by name; errors name ``key``."""
    return signature_parameters(resolve_target(target, key))


def entity(name: str, **chosen: object) -> Tree:
    """Return the node of chosen joints or bodies of the entity ``name``."""
    return {"_target_": "wheelleg_exp.managers.SceneEntityCfg", "name": name, **chosen}
