"""rsl_rl's mirror loss, without the passes of a network that nothing is learned from."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.extensions import Symmetry
from torch import nn

from wheelleg_exp.rl.symmetry.mirror import left_right


def is_a_loss_alone(symmetry: Any) -> bool:
    """Return whether a symmetry is rsl_rl's own, of our images, and adds no samples: ``mirror_loss`` is its loss."""
    ours = type(symmetry) is Symmetry and symmetry.data_augmentation_func is left_right
    return ours and not symmetry.use_data_augmentation


def lighten(algorithm: Any) -> None:
    """Let the mirror loss of rsl_rl's PPO be ours; what is a user's own, or recurrent, keeps its own."""
    if type(algorithm) is not PPO or algorithm.actor.is_recurrent or not is_a_loss_alone(algorithm.symmetry):
        return
    symmetry = algorithm.symmetry
    symmetry.compute_loss = lambda actor, batch, _: mirror_loss(symmetry, actor, batch.observations)


def mirror_loss(symmetry: Symmetry, actor: Any, observations: Any) -> torch.Tensor:
    """Return how far the policy's means for images are from the images of its means, squared.

    The same as ``Symmetry.compute_loss`` of rsl_rl 5.5, and with the same gradient. That one asks the policy for its
    means once more, and sends a gradient of 0 back through them; here they are those that it has just answered with.

    Args:
        symmetry: the extension.
        actor: the policy; it has answered to these observations.
        observations: of B samples, by group.
    """
    mirror = symmetry.env.mirror
    wanted = mirror.actions(actor.output_mean.detach())
    with torch.set_grad_enabled(symmetry.use_mirror_loss):
        return nn.functional.mse_loss(actor(mirror.observations(observations)), wanted)
