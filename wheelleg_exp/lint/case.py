"""What a rule looks at: the composed config and the facts of its robot."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from wheelleg_exp.config.checking.check_terms import term_nodes
from wheelleg_exp.lint.robot.compiled import CompiledRobot
from wheelleg_exp.lint.robot_facts import Joint, RobotFacts
from wheelleg_exp.sim.names import match_names, values_by_name
from wheelleg_exp.terms.binding import TARGET, resolve_target

_LIBRARY = "wheelleg_exp.mdp."


@dataclass(frozen=True)
class TermView:
    """A term of the config.

    Attributes:
        name: its name.
        path: its key.
        kind: its target below the library's ``mdp``, such as ``rewards.is_alive`` whatever alias the config uses;
            another package's target keeps its full name.
        node: its settings.
    """

    name: str
    path: str
    kind: str
    node: Mapping[str, Any]


@dataclass(frozen=True)
class Case:
    """A config and its robot.

    Attributes:
        config: the composed tree, plain and free of mistakes.
        facts: the robot's facts.
        robot: the robot itself; None where only its facts are at hand.
        trial: the mean of each reward under random actions, by name, per second; None where nobody tried.
    """

    config: Mapping[str, Any]
    facts: RobotFacts
    robot: CompiledRobot | None = None
    trial: Mapping[str, float] | None = None

    @property
    def env(self) -> Mapping[str, Any]:
        """The ``env`` section."""
        section: Mapping[str, Any] = self.config["env"]
        return section

    @property
    def agent(self) -> Mapping[str, Any]:
        """The ``agent`` section."""
        section: Mapping[str, Any] = self.config["agent"]
        return section

    @property
    def physics_dt(self) -> float:
        """Physics step, s."""
        return float(self.env["sim"]["dt"])

    @property
    def step_dt(self) -> float:
        """Control step, s."""
        return self.physics_dt * int(self.env["decimation"])

    @property
    def episode_s(self) -> float:
        """Longest episode, s."""
        return float(self.env["episode_length_s"])

    @property
    def episode_steps(self) -> int:
        """Longest episode, control steps."""
        return math.ceil(round(self.episode_s / self.step_dt, 9))

    def terms(self, section: str, *kinds: str) -> Iterator[TermView]:
        """Yield the terms of a section, of all kinds or of some."""
        for found, path, node in term_nodes(self.config):
            if found != section:
                continue
            view = TermView(path.rsplit(".", 1)[-1], path, kind_of(str(node[TARGET]), path), node)
            if not kinds or view.kind in kinds:
                yield view

    def joints(self, node: Mapping[str, Any], name: str = "asset_cfg") -> dict[str, Joint]:
        """Return the joints that a term looks at: those of its entity, or those of its ``joint_names``, or all."""
        entity = node.get(name)
        expressions = entity.get("joint_names") if isinstance(entity, Mapping) else node.get("joint_names")
        joints = self.facts.joints
        if expressions is None:
            return joints
        found = match_names(expressions, list(joints), key=name, what="joint")[1]
        return {joint: joints[joint] for joint in found}

    def by_joint(self, values: Any, names: Sequence[str], default: Any) -> dict[str, Any]:
        """Spread a number, or a mapping of joint expressions to values, over joints."""
        spread = values_by_name(values, list(names), default, key="values", what="joint")
        return dict(zip(names, spread, strict=True))


def kind_of(target: str, path: str) -> str:
    """Return a target by its own name, whatever alias names it, without the library's prefix and inner modules."""
    found = resolve_target(target, path)
    module, name = inspect.unwrap(found).__module__, getattr(found, "__qualname__", "")
    if module.startswith(_LIBRARY):
        module = module.removeprefix(_LIBRARY).partition(".")[0]
    return f"{module}.{name}"


def largest(pair: Any) -> float:
    """Return the largest size of a number in [low, high]; 0 when there is no range."""
    return max((abs(float(value)) for value in pair), default=0.0) if pair is not None else 0.0
