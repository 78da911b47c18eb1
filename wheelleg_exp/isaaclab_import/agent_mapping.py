"""Convert Isaac Lab's ``agent.yaml`` (rsl_rl's runner) to the config section ``agent`` of this project."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.isaaclab_import.import_report import ASSUMED, NAME, RULE, ImportReport, Section
from wheelleg_exp.isaaclab_import.policy_weights import PolicyWeights
from wheelleg_exp.jobs.export.isaaclab_run import PPO, RUNNER, Tree

_NOT_LEARNING = (
    *("seed", "device", "experiment_name", "run_name", "logger", "neptune_project", "wandb_project", "resume"),
    *("load_run", "load_checkpoint", "class_name", "upload_model", "torch_compile_mode", "check_for_nan"),
)
_MODEL_SKIPPED = ("stochastic", "init_noise_std", "noise_std_type", "distribution_cfg", "state_dependent_std")
_LIBRARIES = ("agent", "models", "trainer", "params", "seed")  # skrl, rl_games, stable-baselines3


def convert_agent(
    tree: Mapping[str, object] | None, groups: Sequence[str], weights: PolicyWeights | None, report: ImportReport
) -> Tree:
    """Return the section ``agent`` for observation ``groups``; where settings and ``weights`` differ, weights win."""
    part = Section(tree or {}, "agent.yaml", report)
    # The networks observe the groups of the runner if the environment has them.
    given, top = part.take("obs_groups", {}), "policy" if "policy" in groups else groups[0]
    chosen = {"actor": [top], "critic": ["critic" if "critic" in groups else top]}
    runner = {"actor": given.get("actor") or given.get("policy"), "critic": given.get("critic")}
    chosen |= {role: list(names) for role, names in runner.items() if names and set(names) <= set(groups)}
    agent: Tree = {"algorithm": {}, "obs_groups": chosen, **part.take_if_known(RUNNER)}
    algorithm = part.section("algorithm")
    _require_class(algorithm, "PPO")
    agent["algorithm"] = algorithm.take_if_known(PPO)
    algorithm.drop(("rnd_cfg", "symmetry_cfg"), "set this in the config of the agent; it does not change a policy")
    algorithm.finish()
    policy = part.section("policy")
    actor, critic = part.section("actor"), part.section("critic")  # rsl_rl since 4.0
    normalized = part.take("empirical_normalization", False)
    activation = policy.take("activation", "elu")
    of_networks = None if weights is None else weights.activation
    agent["actor"] = _model("actor", actor, policy, activation, normalized)
    agent["actor"]["distribution_cfg"] = _distribution(policy, actor, weights)
    agent["critic"] = _model("critic", critic, policy, of_networks or activation, normalized)
    if weights is not None:
        _adopt(agent, weights, report if tree is not None else ImportReport())
    if tree is not None:
        report.add("agent.yaml", NAME, "rsl_rl's PPO")
        report.add("agent.yaml.policy", RULE, "became agent.actor and agent.critic")
    else:
        if weights is not None and of_networks is None:
            report.add("agent.yaml.policy.activation", ASSUMED, f"{activation}: the policy file does not name it")
        report.add("agent.yaml", ASSUMED, "missing: the stock settings of PPO, with the networks of the policy")
    actor.finish(skip=_MODEL_SKIPPED)
    critic.finish(skip=_MODEL_SKIPPED)
    policy.finish(skip=["class_name"])
    part.finish(skip=_NOT_LEARNING)
    return agent


def is_runner(tree: Mapping[str, object]) -> bool:
    """Return whether an ``agent.yaml`` has the settings of rsl_rl, not of another library."""
    return "num_steps_per_env" in tree or not any(name in tree for name in _LIBRARIES)


def _model(role: str, own: Section, policy: Section, activation: str, normalized: bool) -> Tree:
    """Return a network's settings, from its own section or from the section ``policy`` of older versions of rsl_rl."""
    hidden = policy.take(f"{role}_hidden_dims") or own.take("hidden_dims") or [256, 256, 256]
    _require_class(own, "MLPModel")
    flag = own.take("obs_normalization", policy.take(f"{role}_obs_normalization", normalized))
    model = {"class_name": "MLPModel", "hidden_dims": list(hidden), "activation": own.take("activation", activation)}
    return model | {"obs_normalization": bool(flag)}


def _distribution(policy: Section, actor: Section, weights: PolicyWeights | None) -> Tree:
    if policy.take("state_dependent_std") or actor.take("state_dependent_std"):
        key, expected = "agent.yaml: state_dependent_std", "a standard deviation that is the same in all states"
        raise ConfigError("the deviation of the actions depends on the state", key=key, expected=expected)
    given = actor.section("distribution_cfg")
    _require_class(given, "GaussianDistribution")
    std = given.take("init_std", policy.take("init_noise_std", 1.0))
    std_type = policy.take("noise_std_type", "scalar")
    if weights is not None and weights.std is not None:
        std_type = "log" if weights.log_std else "scalar"
    std_type = given.take("std_type", std_type)
    given.finish()
    made = {"class_name": "GaussianDistribution", "init_std": float(std)}
    return made if std_type == "scalar" else made | {"std_type": std_type}


def _require_class(part: Section, known: str) -> None:
    name = part.take("class_name", known)
    if name != known:
        raise ConfigError(f"'{name}' does not exist here", key=f"{part.key}.class_name", expected=known)


def _adopt(agent: Tree, weights: PolicyWeights, report: ImportReport) -> None:
    """Replace the settings of the networks by those of the policy file, and report the differences."""
    for role, network in (("actor", weights.actor), ("critic", weights.critic)):
        model = agent[role]
        if network is not None:
            if network.hidden != model["hidden_dims"]:
                text = f"{network.hidden}, as in the networks, not {model['hidden_dims']}"
                report.add(f"agent.yaml.policy.{role}_hidden_dims", ASSUMED, text)
            model["hidden_dims"], model["obs_normalization"] = network.hidden, network.mean is not None
        if role == "actor" and weights.activation not in (None, model["activation"]):
            report.add("agent.yaml.actor.activation", ASSUMED, f"{weights.activation}, as in the networks")
            model["activation"] = weights.activation
