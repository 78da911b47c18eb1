"""Curricula that change nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from wheelleg_exp.lint.case import Case, largest
from wheelleg_exp.lint.findings import Finding, above, rule


@rule
def noop_curriculum(case: Case) -> Iterator[Finding]:
    """A change of a reward's weight that changes nothing, or that training never reaches.

    The weight changes once the counter of control steps has passed ``num_steps``; a training takes
    max_iterations · num_steps_per_env of them. Source: Isaac Lab 2.3.2, ``isaaclab/envs/mdp/curriculums.py``.
    """
    total = int(case.agent["max_iterations"]) * int(case.agent["num_steps_per_env"])
    for term in case.terms("curriculum", "curriculums.modify_reward_weight"):
        reward, weight, start = term.node["term_name"], float(term.node["weight"]), int(term.node["num_steps"])
        before = float(case.env["rewards"][reward]["weight"])
        if weight == before:
            yield Finding(
                f"{term.path}.weight",
                f"'{reward}' has the weight {before:g} from the start: the change to {weight:g} changes nothing",
                "another weight, here or there, or no curriculum",
                {"before": before, "after": weight},
            )
        if start >= total:
            yield Finding(
                f"{term.path}.num_steps",
                f"training takes {total} control steps, and the weight changes after {start}",
                f"num_steps below {total}, or more iterations",
                {"num_steps": start, "total_steps": total},
                ({f"{term.path}.num_steps": total - 1},),
            )


@rule
def levels_out_of_reach(case: Case) -> Iterator[Finding]:
    """Levels of ground that no robot ever climbs to.

    A robot goes a level up when it ends an episode further than half a tile from its beginning. In a longest episode
    at the largest command it comes v T far. Source: Isaac Lab 2.3.2,
    ``isaaclab_tasks/manager_based/locomotion/velocity/mdp/curriculums.py``, ``terrain_levels_vel``.
    """
    for term in case.terms("curriculum", "curriculums.terrain_levels_vel"):
        size = case.env["scene"]["terrain"].get("size")
        if size is None:
            message = "the ground has no tiles: no level ever changes"
            yield Finding(term.path, message, "scene=rough, another ground of tiles, or no such curriculum")
            continue
        command = case.env["commands"].get(term.node.get("command_name", "base_velocity"), {})
        ranges = command.get("ranges")
        if not isinstance(ranges, Mapping):
            continue
        speed = math.hypot(*(largest(ranges.get(axis)) for axis in ("lin_vel_x", "lin_vel_y")))
        far, half = speed * case.episode_s, float(size[0]) / 2
        if far > half:
            continue
        key, longer = "env.episode_length_s", above(half / speed) if speed else math.inf
        yield Finding(
            "env.scene.terrain.size",
            f"at {speed:g} m/s a robot comes {far:.3g} m far in an episode of {case.episode_s:g} s, "
            f"and goes a level up beyond {half:g} m, half a tile",
            f"episodes of {longer:g} s, smaller tiles or faster commands" if speed else "commands that are not zero",
            {"speed_m_s": speed, "way_m": far, "half_tile_m": half},
            ({key: longer},) if speed else (),
        )
