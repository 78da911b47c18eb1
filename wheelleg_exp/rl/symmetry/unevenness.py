"""How far a policy is from its own mirror image, read off what an update has worked out anyway."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.extensions.symmetry import Symmetry
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution, HeteroscedasticGaussianDistribution

_MEANS = (GaussianDistribution, HeteroscedasticGaussianDistribution)  # whose mean is what the policy does


def read_off(algorithm: Any) -> None:
    """Let rsl_rl's symmetry extension read the number for its log off the policy's answers to the batch.

    It asks the policy for each batch twice: to learn from it, and to tell, or to reduce, how uneven it is. Where that
    is only told and images are learned from, the first answers are the second ones, and no second pass is needed.
    Algorithms, networks and distributions that are not rsl_rl's own are left as they are.

    Args:
        algorithm: as built.
    """
    if type(algorithm) is not PPO or type(algorithm.symmetry) is not Symmetry:
        return
    symmetry, actor = algorithm.symmetry, algorithm.get_policy()
    if symmetry.use_mirror_loss or not symmetry.use_data_augmentation:
        return
    if type(actor) is not MLPModel or type(actor.distribution) not in _MEANS:
        return
    own = symmetry.compute_loss

    def compute_loss(_actor: Any, batch: Any, size: int) -> torch.Tensor:
        return own(lambda _: actor.output_mean.detach(), batch, size)

    symmetry.compute_loss = compute_loss
