"""Masses, inertias and centres of mass."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal

import torch

from wheelleg_exp.constraints import Broken, Interval, Length, Positive, relation
from wheelleg_exp.managers import Env, SceneEntityCfg, bounds
from wheelleg_exp.mdp.events.draws import Distribution, Operation, all_ids, draw, operate
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
