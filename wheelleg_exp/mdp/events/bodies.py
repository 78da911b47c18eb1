"""Masses, inertias and centres of mass."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

import torch

from wheelleg_exp.constraints import Broken, Interval, Length, Positive, relation
from wheelleg_exp.managers import Env, SceneEntityCfg, bounds
from wheelleg_exp.mdp.events.draws import Distribution, Operation, Pair, all_ids, draw, operate, ranges
from wheelleg_exp.sim import rotation

_ROBOT = SceneEntityCfg("robot")


def _masses_are_masses(given: Mapping[str, Any]) -> Iterator[Broken]:
    """Hold the range against what it is drawn by; what is drawn below ``min_mass`` is cut to it."""
    name = "mass_distribution_params"
    first, second = given[name]
    gaussian = given["distribution"] == "gaussian"
    positive = given["operation"] != "add" or given["distribution"] == "log_uniform"
    expected = "[mean, standard deviation]" if gaussian else "[low, high]"
    wrong = second < 0 if gaussian else first > second
    if wrong or (positive and first <= 0):
        of = {"add": "", "scale": ", factors above 0", "abs": ", masses above 0"}[given["operation"]]
        yield Broken(name, f"{given[name]!r} is out of range", expected + (of or ", above 0" * positive))


@relation(_masses_are_masses)
def randomize_rigid_body_mass(
    env: Env,
    env_ids: torch.Tensor | None,
    mass_distribution_params: Annotated[Sequence[float], Length(2)],
    operation: Operation,
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
    distribution: Distribution = "uniform",
    recompute_inertia: bool = True,
    min_mass: Positive = 1e-6,
) -> None:
    """Change masses (kg) from their defaults; inertias follow in proportion, centres of mass stay."""
    robot = env.scene[asset_cfg.name]
    chosen = all_ids(env, env_ids)
    ids, bodies, sim = chosen.unsqueeze(1), robot.body_ids[asset_cfg.body_ids], env.scene.sim
    default = sim.constant("body_mass")[bodies]
    drawn = draw(
        mass_distribution_params[0], mass_distribution_params[1], (len(ids), len(bodies)), distribution, generator
    ).to(env.scene.sim.dtype)
    mass = operate(default, drawn, operation).clamp(min=min_mass)
    sim.expand("body_mass")[ids, bodies] = mass
    if recompute_inertia:
        inertia = sim.constant("body_inertia")[bodies]
        sim.expand("body_inertia")[ids, bodies] = inertia * (mass / default).unsqueeze(2)
    sim.set_const()
    robot.mark_written(chosen)


@relation(ranges(above_0=["inertia_distribution_params"]))
def randomize_rigid_body_inertia(
    env: Env,
    env_ids: torch.Tensor | None,
    inertia_distribution_params: Pair,
    operation: Operation,
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
    distribution: Distribution = "uniform",
    min_inertia: Positive = 1e-9,
) -> None:
    """Change the principal moments of inertia (kg·m^2) from their defaults, each by itself; masses stay.

    A moment is at least ``min_inertia``, and at most the sum of the other two: no body has more. Like
    ``randomize_rigid_body_mass``, which scales them with the mass, it starts from the model's: of both on one body
    the later counts.
    """
    robot, sim = env.scene[asset_cfg.name], env.scene.sim
    ids, bodies = all_ids(env, env_ids), robot.body_ids[asset_cfg.body_ids]
    default = sim.constant("body_inertia")[bodies]
    first, second = inertia_distribution_params
    drawn = draw(first, second, (len(ids), *default.shape), distribution, generator)
    moments = operate(default, drawn.to(sim.dtype), operation).clamp(min=min_inertia)
    others = moments.sum(dim=2, keepdim=True) - moments
    sim.expand("body_inertia")[ids.unsqueeze(1), bodies] = torch.minimum(moments, others)
    sim.set_const()
    robot.mark_written(ids)


def randomize_rigid_body_com_cumulative(
    env: Env,
    env_ids: torch.Tensor | None,
    com_range: Mapping[Literal["x", "y", "z"], Interval],
    generator: torch.Generator,
    asset_cfg: SceneEntityCfg = _ROBOT,
) -> None:
    """Add one offset (m, link axes) per environment to the present centres of mass; repeats add up."""
    ids = all_ids(env, env_ids)
    robot = env.scene[asset_cfg.name]
    bodies = robot.body_ids[asset_cfg.body_ids]
    low, high = bounds(com_range, ("x", "y", "z"), "com_range", env.device)
    offset = rotation.uniform(low, high, len(ids), generator).to(env.scene.sim.dtype)
    ipos = env.scene.sim.expand("body_ipos")
    ipos[ids.unsqueeze(1), bodies] += offset.unsqueeze(1)
    env.scene.sim.set_const()
    robot.data.com_b.copy_(ipos[:, robot.body_ids[0]])
    robot.mark_written(ids)


randomize_rigid_body_com = randomize_rigid_body_com_cumulative
