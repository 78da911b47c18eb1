"""Build rsl_rl's algorithm and networks from the config section ``agent``, and reject invalid config values."""

from __future__ import annotations

import copy
import io
import itertools
import re
from contextlib import redirect_stdout

import torch
from rsl_rl.algorithms import PPO, Distillation
from rsl_rl.utils import resolve_callable
from tensordict import TensorDict

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.machine import require_memory
from wheelleg_exp.packages import make_classes_importable
from wheelleg_exp.rl.options import Agent, Learning, SymmetryOptions, require_agent
from wheelleg_exp.rl.ranks import ALONE, Ranks
from wheelleg_exp.rl.symmetry import Mirror, MirroredHalf, joint_pairs, replace_mirror_loss
from wheelleg_exp.rl.vec_env import RslRlVecEnv
from wheelleg_exp.terms.config_sections import plain_section
from wheelleg_exp.user_exceptions import ending_as, in_words

# The keys of the config section `agent` that rsl_rl reads, in addition to those of the networks.
_KEYS = ("algorithm", "num_steps_per_env", "obs_groups", "torch_compile_mode")


def build_algorithm(env: RslRlVecEnv, agent: Learning, ranks: Ranks = ALONE) -> PPO | Distillation:
    """Build rsl_rl's algorithm from the options of the agent. Raise ConfigError for an invalid config value."""
    observations = env.get_observations()
    for role, groups in agent.obs_groups.items():
        for group in groups:
            if group not in observations:
                expected = "some of " + ", ".join(observations.keys())
                message, nearest = f"there is no observation group '{group}'", nearest_name(group, observations.keys())
                raise ConfigError(message, key=f"agent.obs_groups.{role}", expected=expected, nearest=nearest)
            found = observations[group]
            if not isinstance(found, torch.Tensor) or found.ndim != 2:
                name = "flatten_history_dim" if isinstance(found, torch.Tensor) else "concatenate_terms"
                message, key = "a network takes one flat vector a group", f"env.observations.{group}.{name}"
                raise ConfigError(message, key=key, expected=f"{name}: true")
    if env.num_actions == 0:
        message = "the environment has no actions to learn"
        raise ConfigError(message, key="env.actions", expected="at least one action term")
    _require_device(agent.device)
    require_agent(agent, env.num_envs)
    if torch.device(agent.device).type == "cpu":
        _require_memory(env, observations, agent)
    options = _symmetry_of(env, agent)
    groups = [] if options is None else _seen(agent, observations, options)
    env.mirror = None if options is None else Mirror(env.env, options, groups, agent.device)
    # Copy the options, because rsl_rl changes them. Redirect stdout, because rsl_rl prints the networks.
    config = copy.deepcopy({key: value for key, value in plain_section(agent).items() if key in (*_KEYS, *agent.roles)})
    if isinstance(agent, Agent) and agent.symmetry is not None and options is None:
        config["algorithm"].pop("symmetry_cfg", None)
    of_rank = {"global_rank": ranks.rank, "local_rank": ranks.local, "world_size": ranks.size}
    config["multi_gpu"] = of_rank if ranks.together else None
    make_classes_importable(config)
    try:
        with redirect_stdout(io.StringIO()), ending_as(ConfigError):
            kind = resolve_callable(config["algorithm"]["class_name"])
            algorithm = kind.construct_algorithm(observations, env, config, agent.device)
    except Exception as error:  # A user-defined network class can raise any exception.
        message = f"rsl_rl rejects the agent section: {in_words(error).splitlines()[0]}"
        raise ConfigError(message, key="agent", expected="rsl_rl's own configuration") from error
    replace_mirror_loss(algorithm)
    return algorithm


def _symmetry_of(env: RslRlVecEnv, agent: Learning) -> SymmetryOptions | None:
    """Return ``agent.symmetry``, or None for a robot that is not symmetric, which has no ``joint_pairs``."""
    options = agent.symmetry if isinstance(agent, Agent) else None
    return options if options is not None and joint_pairs(env.env, options) is not None else None


def mirrored_half(env: RslRlVecEnv, agent: Learning) -> MirroredHalf | None:
    """Return a ``MirroredHalf`` if ``agent.symmetry.mirrored_envs`` is true, otherwise None."""
    options = _symmetry_of(env, agent)
    if options is None or not options.mirrored_envs:
        return None
    if env.num_envs < 2:
        message = "the mirror applies to every second environment, and there is only one"
        expected = "false, or env.num_envs of at least 2"
        raise ConfigError(message, key="agent.symmetry.mirrored_envs", expected=expected)
    groups = _seen(agent, env.get_observations(), options)
    return MirroredHalf(Mirror(env.env, options, groups, env.device), env.num_envs)


def _seen(agent: Learning, observations: TensorDict, options: SymmetryOptions) -> list[str]:
    """Return the observation groups that need mirror images: those of actor, critic, and RND."""
    novel = options.mirrored_envs and agent.algorithm.get("rnd_cfg")
    roles = ("actor", "critic", "rnd_state") if novel else ("actor", "critic")
    sets = {role: [role if role in observations else "policy"] for role in roles} | agent.obs_groups
    return [group for role in roles for group in sets[role]]


def _require_memory(env: RslRlVecEnv, observations: TensorDict, agent: Learning) -> None:
    """Raise ConfigError if the rollout buffer (float32) and the networks do not fit into memory."""
    steps, widths = agent.num_steps_per_env, {g: v.shape[1] for g, v in observations.items()}
    samples = env.num_envs * steps
    numbers = sum(widths.values()) + 3 * env.num_actions + 6
    what = f"rollouts of {env.num_envs} environments times {steps} steps"
    require_memory(4 * samples * numbers, "agent.num_steps_per_env", what)
    for role, network in agent.networks.items():
        hidden = network.get("hidden_dims") or []
        layers = [sum(widths.get(g, 0) for g in agent.obs_groups.get(role, [])), *hidden, env.num_actions]
        weights = sum(a * b for a, b in itertools.pairwise(layers))
        # Training stores 4 numbers of 4 bytes per weight: the weight, its gradient, and two running means in Adam.
        require_memory(16 * weights, f"agent.{role}.hidden_dims", f"{weights:,} weights and what trains them")


def _require_device(name: str) -> None:
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        known = re.match(r"Expected one of (.+) device type", reason)
        message = f"torch cannot use '{name}'" + ("" if known else f": {reason}")
        expected = "cpu, or a device that this torch and this machine have"
        nearest = nearest_name("cuda" if name == "gpu" else name, known.group(1).split(", ")) if known else None
        raise ConfigError(message, key="agent.device", expected=expected, nearest=nearest) from error
