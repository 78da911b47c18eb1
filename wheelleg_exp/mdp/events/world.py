"""What acts on everything: gravity."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

import torch

from wheelleg_exp.constraints import Broken, Length, relation
from wheelleg_exp.managers import Env
from wheelleg_exp.mdp.events.draws import Distribution, Operation, all_ids, draw, operate, pair_error

Vector = Annotated[Sequence[float], Length(3)]
_PARAMS = "gravity_distribution_params"


def _components_fit(given: Mapping[str, Any]) -> Iterator[Broken]:
    for pair in zip(*given[_PARAMS], strict=True):
        if expected := pair_error(pair, given["operation"], given["distribution"]):
            yield Broken(_PARAMS, f"{pair!r} is out of range", f"two lists of x, y, z, of each axis {expected}")
            return


@relation(_components_fit)
def randomize_physics_scene_gravity(
    env: Env,
    env_ids: torch.Tensor | None,
    gravity_distribution_params: tuple[Vector, Vector],
    operation: Operation,
    generator: torch.Generator,
    distribution: Distribution = "uniform",
    per_env: bool = False,
) -> None:
    """Change gravity (m/s^2, world axes) from ``env.sim.gravity``, one draw for each axis.

    As in Isaac Lab, one value holds for all environments, whichever are reset; with ``per_env`` each of those that
    the event is for gets its own. ``projected_gravity`` keeps the direction of the config's gravity.
    """
    sim = env.scene.sim
    default = torch.tensor(env.scene.model.opt.gravity, dtype=torch.float32, device=env.device)
    ids = all_ids(env, env_ids if per_env else None)
    first, second = torch.tensor(gravity_distribution_params, dtype=torch.float32, device=env.device)
    drawn = draw(first, second, (len(ids) if per_env else 1, 3), distribution, generator)
    sim.expand("opt.gravity")[ids] = operate(default, drawn, operation).to(sim.dtype).expand(len(ids), 3)
    sim.set_const()
