"""Convert Isaac Lab's ``agent.yaml`` (rsl_rl's runner) to the config section ``agent`` of this project."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.isaaclab_import.import_report import ASSUMED, NAME, RULE, ImportReport, Section
from wheelleg_exp.isaaclab_import.policy_weights import PolicyWeights

RUNNER = ("num_steps_per_env", "max_iterations", "save_interval", "clip_actions")
PPO = (
    *("num_learning_epochs", "num_mini_batches", "clip_param", "gamma", "lam", "value_loss_coef", "entropy_coef"),
    *("learning_rate", "max_grad_norm", "use_clipped_value_loss", "schedule", "desired_kl"),
    *("normalize_advantage_per_mini_batch", "optimizer"),
)
_NOT_LEARNING = (
    *("seed", "device", "experiment_name", "run_name", "logger", "neptune_project", "wandb_project", "resume"),
    *("load_run", "load_checkpoint", "class_name", "upload_model", "torch_compile_mode", "check_for_nan"),
)
_LIBRARIES = ("agent", "models", "trainer", "params", "seed")  # skrl, rl_games, stable-baselines3


def convert_agent(
    tree: Mapping[str, Any] | None, groups: Sequence[str], weights: PolicyWeights | None, report: ImportReport
) -> dict[str, Any]:
    """Return the config section ``agent`` for a runner's settings, or for networks without settings.

    ``groups`` are the observation groups of the environment. Where settings and ``weights`` differ, the weights win.
    """
    top = "policy" if "policy" in groups else next(iter(groups))
    obs_groups = {"actor": [top], "critic": ["critic" if "critic" in groups else top]}
    agent: dict[str, Any] = {"algorithm": {}, "obs_groups": obs_groups}
    part = Section(tree or {}, "agent.yaml", report)
    agent |= part.take_if_known(RUNNER)
    given = part.take("obs_groups", {})
    for role, names in (("actor", ("actor", "policy")), ("critic", ("critic",))):
        found = next((given[name] for name in names if given.get(name)), None)
        if found and set(found) <= set(groups):
            obs_groups[role] = list(found)
    algorithm = part.section("algorithm")
    agent["algorithm"] |= algorithm.take_if_known(PPO)
    algorithm.take("class_name")
    algorithm.drop(("rnd_cfg", "symmetry_cfg"), "set this in the config of the agent; it does not change a policy")
    algorithm.finish()
    policy = part.section("policy")
    normalized = bool(part.take("empirical_normalization"))
    if policy.take("state_dependent_std"):
        key, expected = "agent.yaml: policy.state_dependent_std", "a standard deviation that is the same in all states"
        raise ConfigError("the deviation of the actions depends on the state", key=key, expected=expected)
    std, std_type = policy.take("init_noise_std", 1.0), policy.take("noise_std_type", "scalar")
    if weights is not None and weights.std is not None:
        std_type = "log" if weights.log_std else "scalar"
    default = policy.take("activation", "elu")
    for role in ("actor", "critic"):
        own = part.section(role)  # rsl_rl since 4.0
        hidden = policy.take(f"{role}_hidden_dims") or own.take("hidden_dims") or [256, 256, 256]
        flag = own.take("obs_normalization", policy.take(f"{role}_obs_normalization", normalized))
        network = None if weights is None else getattr(weights, role)
        if network is not None:
            if tree is not None and network.hidden != list(hidden):
                text = f"{network.hidden}, as in the networks, not {list(hidden)}"
                report.add(f"agent.yaml.policy.{role}_hidden_dims", ASSUMED, text)
            hidden, flag = network.hidden, network.mean is not None
        agent[role] = {
            "class_name": "MLPModel",
            "hidden_dims": list(hidden),
            "activation": own.take("activation", default),
        }
        activation = None if weights is None or role == "critic" else weights.activation
        if activation not in (None, agent[role]["activation"]):
            if tree is not None:
                report.add(f"agent.yaml.{role}.activation", ASSUMED, f"{activation}, as in the networks")
            default = agent[role]["activation"] = activation
        agent[role]["obs_normalization"] = bool(flag)
        given_std = own.take("distribution_cfg", {})
        if role == "actor":
            std, std_type = given_std.get("init_std", std), given_std.get("std_type", std_type)
        own.skip("class_name", "stochastic", "init_noise_std", "noise_std_type")
        own.finish()
    agent["actor"]["distribution_cfg"] = {"class_name": "GaussianDistribution", "init_std": float(std)}
    agent["actor"]["distribution_cfg"] |= {"std_type": std_type} if std_type != "scalar" else {}
    if tree is None and weights is not None and weights.activation is None:
        report.add("agent.yaml.policy.activation", ASSUMED, f"{default}: the policy file does not name it")
    if tree is None:
        report.add("agent.yaml", ASSUMED, "there is none: the stock settings of PPO, with the networks of the policy")
    else:
        report.add("agent.yaml", NAME, "rsl_rl's PPO")
        report.add("agent.yaml.policy", RULE, "became agent.actor and agent.critic")
    policy.skip("class_name")
    policy.finish()
    part.skip(*_NOT_LEARNING)
    part.finish()
    return agent


def is_runner(tree: Mapping[str, Any]) -> bool:
    """Return whether an ``agent.yaml`` has the settings of rsl_rl, not of another library."""
    return "num_steps_per_env" in tree or not any(name in tree for name in _LIBRARIES)
