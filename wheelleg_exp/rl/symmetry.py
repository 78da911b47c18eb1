"""Mirror observations and actions (exchange left and right) for rsl_rl's symmetry extension and its mirror loss."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import torch
from rsl_rl.algorithms import PPO, Distillation
from rsl_rl.env import VecEnv
from rsl_rl.extensions import Symmetry
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import nn

from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError, not_one_of
from wheelleg_exp.managers.observation_term import ObservationTerm
from wheelleg_exp.rl import mirror_rules
from wheelleg_exp.rl.mirror_pairs import JOINT_PAIRS_KEY, joint_images, joint_signs
from wheelleg_exp.rl.mirror_rules import SignedSources, TermMirror
from wheelleg_exp.rl.options import SymmetryOptions

_MAX_TARGET_ERROR = 1e-4  # rad


def joint_pairs(env: ManagerBasedRLEnv, options: SymmetryOptions) -> dict[str, str | None] | None:
    """Return the pairs of the robot and those of the agent; None for a robot that is not symmetric."""
    pairs = env.options.robot.joint_pairs
    return None if pairs is None and not options.joint_pairs else {**(pairs or {}), **options.joint_pairs}


class Mirror:
    """Mirrors observations and actions of an environment, so that left and right are exchanged.

    An asymmetric robot, or a term of ``groups`` (those that networks read) without a known image, raises ConfigError.
    """

    def __init__(
        self, env: ManagerBasedRLEnv, options: SymmetryOptions, groups: Iterable[str], device: str | torch.device
    ) -> None:
        self._env, self._options, self.device = env, options, device
        manager = self._env.observation_manager
        names = dict.fromkeys(name for group in groups for name in manager.terms(group))
        for name, rule in self._options.terms.items():
            if name not in names:
                message = "no network sees such an observation"
                raise not_one_of(message, name, names, key=f"{mirror_rules.RULES_KEY}.{name}")
            if isinstance(rule, str) and rule not in mirror_rules.RULE_NAMES:
                raise mirror_rules.unknown_rule_error(rule, name)
        robot = env.scene.robot
        self._images = joint_images(robot.joint_names, joint_pairs(env, options) or {})
        self._signs = joint_signs(env.scene.model, robot.body_names[0], robot.joint_names, self._images)
        pose = robot.layout.default_joint_pos.tolist()
        for joint, (image, sign) in enumerate(zip(self._images, self._signs, strict=True)):
            if abs(pose[image] - sign * pose[joint]) > _MAX_TARGET_ERROR:
                names = robot.joint_names
                raise ConfigError(
                    f"'{names[joint]}' starts at {pose[joint]:g}, its mirror joint '{names[image]}' at {pose[image]:g}",
                    key="env.robot.init_state.joint_pos",
                    expected=f"{sign * pose[joint]:g} rad for '{names[image]}'; or other {JOINT_PAIRS_KEY}",
                )
        self._action = self._actions()
        self._turning = TermMirror(env, self._images, self._signs, self._action)
        self._groups = {group: _index_and_sign_tensors(self._group(group), device) for group in dict.fromkeys(groups)}
        self._action_tensors = _index_and_sign_tensors(self._action, device)

    def observations(self, observations: TensorDict) -> TensorDict:
        """Return a batch of observations in which all observation groups that a network reads are mirrored."""
        turned = {**dict(observations.items()), **self.images(observations)}
        return TensorDict(turned, batch_size=observations.batch_size)

    def images(self, observations: TensorDict) -> dict[str, torch.Tensor]:
        """Return the mirror images of the observation groups that networks read."""
        groups = self._groups.items()
        return {name: observations[name].index_select(1, sources) * signs for name, (sources, signs) in groups}

    def actions(self, actions: torch.Tensor) -> torch.Tensor:
        """Return the mirror image of raw actions (B, A)."""
        sources, signs = self._action_tensors
        return actions.index_select(1, sources) * signs

    def _actions(self) -> SignedSources:
        """Return (j, sign) for each action i: the mirrored action i is ``sign`` times the action j."""
        manager = self._env.action_manager
        columns: dict[tuple[str, str, int], int] = {}
        made: list[tuple[str, str, int, float, float]] = []
        for name in manager.active_terms:
            term = manager.get_term(name)
            kind, joints = str(term.drives), list(getattr(term, "joint_names", []))
            path = f"env.actions.{name}"
            if len(joints) != term.action_dim or tuple(term.processed_actions.shape[1:]) != (term.action_dim,):
                expected = "terms with one action for each joint"
                raise ConfigError("an action term cannot be mirrored from left to right", key=path, expected=expected)
            # Find each action's offset and scale by processing the raw actions 0 and 1, then restore the term's state.
            saved, zeros = term.state_dict(), torch.zeros_like(term.raw_actions)
            term.process_actions(zeros)
            offset = term.processed_actions[0].clone()
            term.process_actions(zeros + 1.0)
            scale = term.processed_actions[0] - offset
            term.load_state_dict(saved)
            for joint, o, s in zip(joints, offset.tolist(), scale.tolist(), strict=True):
                earlier = sum(one[:2] == (kind, joint) for one in made)  # terms without ``drives`` can share a joint
                columns[kind, joint, earlier] = len(made)
                made.append((kind, joint, earlier, o, s))
        names, turned = self._env.scene.robot.joint_names, []
        for kind, joint, earlier, offset_, scale_ in made:
            source = names.index(joint)
            image = (kind, names[self._images[source]], earlier)
            sign = self._signs[source]
            if image not in columns:
                message = f"'{joint}' has an action, and its image '{image[1]}' has no action of that kind"
                raise ConfigError(message, key="env.actions", expected="actions for both sides")
            _, _, _, its_offset, its_scale = made[columns[image]]
            if abs(its_scale - scale_) > _MAX_TARGET_ERROR or abs(its_offset - sign * offset_) > _MAX_TARGET_ERROR:
                message = f"an action sets another target for '{joint}' than for its image '{image[1]}'"
                raise ConfigError(message, key="env.actions", expected="one scale, and offsets that are images")
            turned.append((columns[image], sign))
        return turned

    def _group(self, group: str) -> SignedSources:
        manager = self._env.observation_manager
        terms, slices = manager.terms(group), manager.term_slices(group)
        found: dict[int, tuple[int, float]] = {}
        for name, term in terms.items():
            frame = self._frame(group, name, term)
            for first in range(slices[name].start, slices[name].stop, term.width):
                found |= {first + i: (first + source, sign) for i, (source, sign) in enumerate(frame)}
        return [found[i] for i in range(len(found))]

    def _frame(self, group: str, name: str, term: ObservationTerm) -> SignedSources:
        path, (module, _, function) = term.term.path, term.term.target.rpartition(".")
        is_stock = f"{module}.".startswith(f"{mirror_rules.OBSERVATIONS}.")
        rule = self._options.terms.get(name, mirror_rules.TERM_RULES.get(function) if is_stock else None)
        if rule == mirror_rules.COMMAND_RULE:
            rule = self._turning.command(term)
        if rule is None:
            message = f"'{term.term.target}' has no known mirror image (observation '{name}' of '{group}')"
            expected = "one of " + ", ".join(mirror_rules.RULE_NAMES) + ", or a list of a sign for each number"
            raise ConfigError(message, key=f"{mirror_rules.RULES_KEY}.{name}", expected=expected)
        width, turned = term.width, self._turning.frame(rule, term)
        if len(turned) != width:
            shown = rule if isinstance(rule, str) else list(rule)
            message = f"the mirror rule {shown} has {len(turned)} numbers, and the term has {width}"
            raise ConfigError(message, key=path, expected=f"{mirror_rules.RULES_KEY}.{name}: a sign for each number")
        # Mirroring is correct only if a value and its mirror image have the same clip and scale.
        clip, scale = term.term.fields.get("clip"), term.term.fields.get("scale")
        if clip is not None and float(clip[0]) != -float(clip[1]) and any(sign < 0 for _, sign in turned):
            message = "the bounds are not symmetric, and some numbers change their sign in a mirror"
            raise ConfigError(message, key=f"{path}.clip", expected="[-x, x]")
        if isinstance(scale, Sequence) and any(not math.isclose(scale[i], scale[s]) for i, (s, _) in enumerate(turned)):
            message = "the scale differs between numbers that are mirror images"
            raise ConfigError(message, key=f"{path}.scale", expected="one factor for both")
        return turned


class MirroredHalf:
    """Mirrors observations and actions of every second environment."""

    def __init__(self, mirror: Mirror, num_envs: int) -> None:
        self._mirror = mirror
        self._mirrored = (torch.arange(num_envs, device=mirror.device) % 2 == 1).unsqueeze(1)

    def actions(self, actions: torch.Tensor) -> torch.Tensor:
        """Return the policy's raw actions (N, A) with mirrored actions for every second environment."""
        return torch.where(self._mirrored, self._mirror.actions(actions), actions)

    def observations(self, observations: TensorDict) -> TensorDict:
        """Return observations (N, ...), in which groups that networks read are mirrored in every second environment."""
        images = self._mirror.images(observations).items()
        mixed = {group: torch.where(self._mirrored, image, observations[group]) for group, image in images}
        return TensorDict({**dict(observations.items()), **mixed}, batch_size=observations.batch_size)


def left_right(
    env: VecEnv, obs: TensorDict | None = None, actions: torch.Tensor | None = None
) -> tuple[TensorDict | None, torch.Tensor | None]:
    """Return observations and actions (B, A), followed by their mirror images, for rsl_rl's symmetry extension."""
    mirror: Mirror = env.mirror
    both = None if obs is None else torch.cat((obs, mirror.observations(obs)), dim=0)
    return both, None if actions is None else torch.cat((actions, mirror.actions(actions)), dim=0)


def _index_and_sign_tensors(turned: SignedSources, device: str | torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    sources = torch.tensor([source for source, _ in turned], dtype=torch.long, device=device)
    return sources, torch.tensor([sign for _, sign in turned], device=device)


def is_mirror_loss_only(symmetry: Symmetry) -> bool:
    """Return whether ``symmetry`` uses ``left_right`` for the mirror loss, but not for data augmentation."""
    ours = type(symmetry) is Symmetry and symmetry.data_augmentation_func is left_right
    return ours and not symmetry.use_data_augmentation


def replace_mirror_loss(algorithm: PPO | Distillation) -> None:
    """Replace the mirror loss of rsl_rl's PPO by ``mirror_loss``, except for user-defined or recurrent classes."""
    if type(algorithm) is not PPO or algorithm.actor.is_recurrent or not is_mirror_loss_only(algorithm.symmetry):
        return
    symmetry = algorithm.symmetry
    symmetry.compute_loss = lambda actor, batch, _: mirror_loss(symmetry, actor, batch.observations)


def mirror_loss(symmetry: Symmetry, actor: MLPModel, observations: TensorDict) -> torch.Tensor:
    """Return the mean squared difference between the actions for mirrored observations and the mirrored actions.

    Loss and gradient equal those of ``Symmetry.compute_loss`` in rsl_rl 5.5, which evaluates the policy a second time.
    ``mirror_loss`` reuses the actions of the last forward pass, whose input must have been ``observations``.
    """
    mirror = symmetry.env.mirror
    wanted = mirror.actions(actor.output_mean.detach())
    with torch.set_grad_enabled(symmetry.use_mirror_loss):
        return nn.functional.mse_loss(actor(mirror.observations(observations)), wanted)
