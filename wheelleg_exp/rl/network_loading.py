"""Load networks from a checkpoint: to start a training, to teach a student, or to play."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rsl_rl.algorithms import PPO, Distillation
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from wheelleg_exp.env import ManagerBasedRLEnv as Env
from wheelleg_exp.errors import ConfigError, RunDirectoryError, not_one_of
from wheelleg_exp.rl import checkpoint
from wheelleg_exp.rl.algorithm import build_algorithm
from wheelleg_exp.rl.options import InitialKl, Learning
from wheelleg_exp.rl.vec_env import RslRlVecEnv

# The tensors whose columns are a network's inputs, and the value that a new input has.
_INPUTS = {"mlp.0.weight": 0.0, "obs_normalizer._mean": 0.0, "obs_normalizer._var": 1.0, "obs_normalizer._std": 1.0}
_LAST_ACTION = "wheelleg_exp.mdp.observations.last_action"


@dataclass(frozen=True)
class Initial:
    """Networks from a checkpoint, with which a training starts instead of random networks."""

    state: Mapping[str, Any]  # the checkpoint
    parts: tuple[str, ...]  # the parts of the checkpoint to load: ``actor``, ``critic``, ``optimizer``
    facts: Mapping[str, Any]  # the checkpoint's origin


def load_teacher(algorithm: Distillation, state: Mapping[str, object]) -> None:
    """Load the policy of a checkpoint into the teacher network of a distillation."""
    try:
        algorithm.load({"actor_state_dict": checkpoint.policy_state(state)}, {"teacher": True}, True)
    except RuntimeError as error:
        message = "the teacher's network does not fit the networks of this checkpoint"
        expected = "agent.teacher and agent.obs_groups.teacher as the actor and its groups that were trained"
        raise ConfigError(message, key="agent.teacher_checkpoint", expected=expected) from error


def load_initial(algorithm: PPO, initial: Initial, env: RslRlVecEnv, obs_groups: Mapping[str, Sequence[str]]) -> None:
    """Load a checkpoint's networks without a random draw; new terms at the end of the inputs get weights of 0."""
    whose = initial.facts.get("named") or initial.facts.get("checkpoint")
    wrong, state = [], dict(initial.state)
    for role in (part for part in initial.parts if part in checkpoint.ROLES):
        own = getattr(algorithm, role).state_dict()
        if further := initial.facts.get("further", {}).get(role):
            slices = env.env.observation_manager.term_slices(obs_groups[role][-1])
            more = sum(slices[name].stop - slices[name].start for name in further)
            network, pad = state[f"{role}_state_dict"], torch.nn.functional.pad
            wide = {n: pad(network[n], (0, more), value=value) for n, value in _INPUTS.items() if n in network}
            state[f"{role}_state_dict"] = {**network, **wide}
        if scales := initial.facts.get("scales"):
            network, eps = state[f"{role}_state_dict"], getattr(getattr(algorithm, role).obs_normalizer, "eps", 0.0)
            state[f"{role}_state_dict"] = _rescaled(network, role, scales, env.env, obs_groups[role], eps)
        has = {name: list(value.shape) for name, value in state[f"{role}_state_dict"].items()}
        needs = {name: list(value.shape) for name, value in own.items()}
        name = next((name for name in dict.fromkeys([*needs, *has]) if needs.get(name) != has.get(name)), None)
        if name is not None:
            wrong.append(f"the {role}'s {name} is {has.get(name, 'absent')} there and {needs.get(name, 'absent')} here")
    if wrong:
        key, expected = "init_from", "the observations, actions and networks that it was trained with, or null"
        raise ConfigError(f"networks of '{whose}' have wrong shapes: {'; '.join(wrong)}", key=key, expected=expected)
    try:
        algorithm.load(state, dict.fromkeys(initial.parts, True), True)
    except (RuntimeError, LookupError, ValueError, TypeError) as error:
        message = f"the {', '.join(initial.parts)} of '{whose}' cannot be loaded: {' '.join(str(error).split())[:200]}"
        expected = "networks, or the algorithm and the optimiser that it was trained with"
        raise ConfigError(message, key="init_from_what", expected=expected) from error


def _rescaled(
    network: Mapping[str, torch.Tensor],
    role: str,
    scales: Mapping[str, float],
    env: Env,
    groups: Sequence[str],
    eps: float,
) -> dict[str, torch.Tensor]:
    """Return a network that moves the robot as before after the scales of actions have changed.

    ``scales`` maps action terms to their former over their present scale. Observations of the last action change
    likewise. ``eps`` is what rsl_rl adds to their standard deviation. The exploration noise keeps its size in units of
    the action.
    """
    actions, observations, inputs = env.action_manager, env.observation_manager, []
    each = {n: torch.full((actions.get_term(n).action_dim,), scales.get(n, 1.0)) for n in actions.active_terms}
    ratio = torch.cat([*each.values()])
    for group in groups:
        parts = observations.term_parts(group)
        column = torch.ones(max(part.stop for found in parts.values() for part in found))
        for name, observed in observations.terms(group).items():
            if observed.term.target == _LAST_ACTION:
                one = observed.term.params.get("action_name")
                own = ratio if one is None else each[one]
                for part in parts[name]:
                    column[part] = own.repeat((part.stop - part.start) // len(own))
        inputs.append(column)
    factor, made = torch.cat(inputs), dict(network)
    if made["mlp.0.weight"].shape[1] != len(factor):
        expected = f"the scales with which '{role}' was trained"
        raise ConfigError("only MLPs can be converted to other scales of actions", key="env.actions", expected=expected)
    layer = made["mlp.0.weight"] / factor
    if (deviation := made.get("obs_normalizer._std")) is not None:
        for name, power in (("_mean", 1), ("_std", 1), ("_var", 2)):
            made[f"obs_normalizer.{name}"] = made[f"obs_normalizer.{name}"] * factor**power
        layer *= (factor * deviation + eps) / (deviation + eps)
    made["mlp.0.weight"] = layer
    if role == "actor":
        last = [name for name in made if name.startswith("mlp.")][-2:]  # the weight and the bias of the last layer
        made |= {name: torch.einsum("i,i...->i...", ratio, made[name]) for name in last}
    return made


class InitialPolicy:
    """A copy of the policy of ``algorithm``, and the loss ``agent.initial_kl`` that keeps the policy near the copy."""

    def __init__(self, algorithm: PPO, options: InitialKl, env: RslRlVecEnv) -> None:
        self._actor = copy.deepcopy(algorithm.actor).requires_grad_(False).eval()
        self.weight, self._excepted = options.weight, list[tuple[str, slice]]()
        if options.except_while is not None:
            manager = env.env.observation_manager
            # If both networks see the observation, use that of the actor, which is the last one.
            groups = [*algorithm.critic.obs_groups, *algorithm.actor.obs_groups]
            parts = {name: (group, found) for group in groups for name, found in manager.term_parts(group).items()}
            if options.except_while not in parts:
                key, message = "agent.initial_kl.except_while", "no network sees such an observation"
                raise not_one_of(message, options.except_while, parts, key=key)
            group, slices = parts[options.except_while]
            self._excepted = [(group, part) for part in slices]

    def loss(self, actor: MLPModel, observations: TensorDict) -> torch.Tensor:
        """Return the mean KL(policy || initial policy) of samples (B, ...) after a forward pass of the policy."""
        with torch.no_grad():
            self._actor.distribution.update(self._actor.mlp(self._actor.get_latent(observations)))
        now, first = actor.output_distribution_params, self._actor.output_distribution_params
        divergence: torch.Tensor = actor.get_kl_divergence(now, first)
        for group, part in self._excepted:
            divergence = divergence * (observations[group][:, part] == 0.0).all(dim=1)
        return divergence.mean()


def load_policy(path: Path, env: RslRlVecEnv, agent: Learning) -> MLPModel:
    """Return a checkpoint's policy without exploration noise; raise RunDirectoryError if it does not fit ``env``."""
    state = checkpoint.load(path)
    policy = build_algorithm(env, replace(agent, device=str(env.env.device))).get_policy()
    try:
        policy.load_state_dict(checkpoint.policy_state(state))
    except (RuntimeError, TypeError, AttributeError) as error:
        message = "the policy does not fit this environment's observations and actions"
        expected = "the observations, actions and networks that it was trained with"
        raise RunDirectoryError(message, key=str(path), expected=expected) from error
    policy.eval()
    return policy
