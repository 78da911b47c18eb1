"""rsl_rl's mirror loss, without the passes of a network that nothing is learned from."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torch import nn

from wheelleg_exp.rl.symmetry.mirror import left_right


def lighten(algorithm: Any) -> None:
    """Let an algorithm's mirror loss be ours, where it is that of plain networks and of our images."""
    symmetry = getattr(algorithm, "symmetry", None)
    if symmetry is None or symmetry.use_data_augmentation or symmetry.data_augmentation_func is not left_right:
        return
    if not algorithm.actor.is_recurrent:
        symmetry.compute_loss = partial(mirror_loss, symmetry)


def mirror_loss(symmetry: Any, actor: Any, batch: Any, original_batch_size: int) -> torch.Tensor:
    """Return how far the policy's means for images are from the images of its means, squared, over B samples.

    The same as ``Symmetry.compute_loss`` of rsl_rl 5.5, and with the same gradient. That one asks the policy for its
    means once more, and sends a gradient of 0 back through them; here they are those that it has just answered with.
    """
    wanted = symmetry.env.mirror.actions(actor.output_mean[:original_batch_size].detach())
    with torch.set_grad_enabled(symmetry.use_mirror_loss):
        return nn.functional.mse_loss(actor(symmetry.env.mirror.observations(batch.observations)), wanted)
