"""How far a policy is from its own mirror image, read off what an update has worked out anyway."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution


def read_off(algorithm: Any) -> None:
    """Let rsl_rl's symmetry extension read the number for its log off the policy's answers to the batch.

    It asks the policy for each batch twice: to learn from it, and to tell, or to reduce, how uneven it is. Where that
    is only told and images are learned from, the first answers are the second ones, to the bit. A pass of the policy
    in six of the update's is saved.

    Args:
        algorithm: rsl_rl's, as built.
    """
    symmetry = getattr(algorithm, "symmetry", None)
    if symmetry is None or symmetry.use_mirror_loss or not symmetry.use_data_augmentation:
        return
    actor = algorithm.get_policy()
    if type(actor) is not MLPModel or not isinstance(actor.distribution, GaussianDistribution):
        return
    own = symmetry.compute_loss

    def compute_loss(_actor: Any, batch: Any, size: int) -> torch.Tensor:
        return own(lambda _: actor.output_mean.detach(), batch, size)

    symmetry.compute_loss = compute_loss
