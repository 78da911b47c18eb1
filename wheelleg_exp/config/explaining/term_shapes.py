"""Describe the layout of a policy's observations and actions, term by term, without a simulation."""

from __future__ import annotations

from dataclasses import dataclass

from wheelleg_exp.config.composing.compose import Composed


@dataclass(frozen=True)
class TermShape:
    """One term of an observation group, or one action term.

    ``width`` is the number of components in one control step. ``history`` is the number of stored steps; 0 means only
    the present one. ``start:stop`` is the slice of the observation or action vector, or None. ``joints`` contains the
    joints that an action term drives, in the order of its components.
    """

    name: str
    target: str
    width: int
    history: int
    shape: tuple[int, ...]
    start: int | None
    stop: int | None
    joints: tuple[str, ...] = ()


@dataclass(frozen=True)
class GroupShape:
    """The layout of an observation group, or of all actions.

    ``shape`` is the shape of the concatenated terms without the environment dimension; None without concatenation.
    """

    terms: tuple[TermShape, ...]
    shape: tuple[int, ...] | None


@dataclass(frozen=True)
class Shapes:
    """The layout of a policy's inputs and outputs; ``joints`` contains the joint names in the robot's default order."""

    joints: tuple[str, ...]
    observations: dict[str, GroupShape]
    actions: GroupShape


def shapes(composed: Composed) -> Shapes:
    """Return the layout of the observations and actions that a config describes."""
    from wheelleg_exp.build import build_env

    config = {**composed.config, "env": {**composed.config["env"], "num_envs": 1}}
    with composed.placing():
        env = build_env(config, composed.asset_roots)
    groups, observations = {}, env.observation_manager
    for group in observations.active_terms:
        dims, terms = observations.group_obs_dim[group], []
        parts = observations.term_parts(group) if isinstance(dims, tuple) else {}
        for name, term in observations.terms(group).items():
            places = parts.get(name, ())
            begin, end = (places[0].start, places[0].stop) if len(places) == 1 else (None, None)
            shape = TermShape(name, term.term.target, term.width, term.history_length, tuple(term.shape), begin, end)
            terms.append(shape)
        groups[group] = GroupShape(tuple(terms), dims if isinstance(dims, tuple) else None)
    manager = env.action_manager
    made, start = [], 0
    for name, width in zip(manager.active_terms, manager.action_term_dim, strict=True):
        target = manager.get_term_cfg(name).target
        joints = tuple(getattr(manager.get_term(name), "joint_names", ()))
        made.append(TermShape(name, target, width, 0, (width,), start, start + width, joints))
        start += width
    return Shapes(tuple(env.scene.robot.joint_names), groups, GroupShape(tuple(made), (manager.total_action_dim,)))
