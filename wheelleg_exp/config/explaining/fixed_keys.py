"""What the keys mean that no docstring of a target describes: the fixed part of the tree and the managers' fields."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Any

# The managers' own fields of a term, with what stands there when a config says nothing.
FIELDS: dict[str, tuple[str, Any]] = {
    "weight": ("factor on the term; a step adds weight times value times the control step to the return", ...),
    "time_out": (
        "whether it only cuts the episode off, which then has not failed",
        False,
    ),
    "mode": ("when it runs: prestartup and startup once, reset at each reset, interval after random waits", ...),
    "interval_range_s": ("shortest and longest wait between two runs of mode interval, s", None),
    "is_global_time": ("whether one timer serves all environments", False),
    "min_step_count_between_reset": ("fewest control steps between two runs of mode reset", 0),
    "modifiers": ("functions of the observation, in order, before noise", None),
    "noise": ("noise on the observation, where the group has enable_corruption", None),
    "clip": ("bounds of the observation before scaling", None),
    "scale": ("factor on the observation, or one for each component", None),
    "history_length": ("control steps kept, 0: only the present; the group's own setting comes first", 0),
    "delay": ("shortest and longest delay, physics steps, drawn at each reset; null for none", None),
    "flatten_history_dim": ("whether the history is one vector, oldest first", True),
}

# Keys of the fixed part; * stands for one key.
KEYS: dict[str, str] = {
    "seed": "seed of every random stream of the run",
    "init_from": "run (path, id, `latest`) or checkpoint whose networks the training begins with; null draws them",
    "init_from_what": "what is taken over: networks (policy and critic), policy, or learning (the optimiser as well)",
    "task": "what is trained",
    "task.name": "name of the task; its run directories stand below <run.root>/<name>",
    "check": "findings of the check that are known and accepted",
    "check.silence": "the reason for each silenced rule of `wheelleg check --physics`, by the rule's name",
    "env": "the environments: size, pace, scene and terms",
    "env.num_envs": "environments simulated side by side",
    "env.episode_length_s": "longest episode, s",
    "env.decimation": "physics steps of one control step",
    "env.sim": "the solver",
    "env.scene": "ground and sensors",
    "env.robot": "the robot: its file, its start and its drives",
    "env.commands": "what the robot is asked to do, by term",
    "env.actions": "what the policy's output means; the order of terms is the layout of the action vector",
    "env.observations": "what networks see, by group",
    "env.observations.*": "one observation: its terms, joined in their order",
    "env.observations.*.terms": "the terms; their order is the layout of the observation",
    "env.observations.*.concatenate_terms": "whether the terms are joined to one vector",
    "env.observations.*.enable_corruption": "whether the noise of the terms acts",
    "env.observations.*.history_length": "control steps kept of each term, in place of the terms' own setting",
    "env.observations.*.flatten_history_dim": "whether histories are flattened, oldest first",
    "env.observations.*.concatenate_dim": "dimension along which terms are joined: -1 the last, 0 the first",
    "env.observations.*.history_order": "how flattened histories stand: term by term, or time step by time step",
    "env.events": "what happens to the simulation at start, at resets and in between; terms run in their order",
    "env.rewards": "what is rewarded: each step adds weight times value times the control step of each term",
    "env.terminations": "what ends an episode",
    "env.curriculum": "what changes as training goes on; terms run in their order",
    "env.recorders": "what of each episode is written to the run's dataset; they change nothing",
    "env.is_finite_horizon": "whether time-outs are ends like any other, after which no value is added",
    "env.dataset": "which of the episodes that recorders note are written",
    "pipeline": "tasks one after the other, with gates between",
    "protocol": "fixed scenarios of `wheelleg evaluate`, and how they are judged",
    "agent": "the learning algorithm and its networks, in rsl_rl's own terms",
    "agent.algorithm": "the algorithm: a class of rsl_rl and its parameters",
    "agent.actor": "the policy's network: a class of rsl_rl and its parameters",
    "agent.critic": "the value network: a class of rsl_rl and its parameters",
    "agent.student": "the network that learns: a class of rsl_rl and its parameters",
    "agent.teacher": "the network that is learned from, as it was trained: a class of rsl_rl and its parameters",
    "agent.*.class_name": "class, of rsl_rl or of an allowed package (module:Class)",
    "agent.*.distribution_cfg.class_name": "class of the distribution of actions",
    "agent.obs_groups": "which observation groups each network sees, in order",
    "agent.obs_groups.*": "observation groups that this network sees, in order",
    "agent.num_steps_per_env": "control steps of one rollout in each environment",
    "agent.max_iterations": "iterations in total",
    "agent.save_interval": "iterations between checkpoints",
    "agent.logger": "tensorboard; wandb also sends scalars and config to Weights & Biases; null for no event files",
    "agent.device": "device of the networks",
    "agent.torch_threads": "threads of torch; recorded in the run",
    "agent.matmul": "in what the update multiplies: float32, bfloat16 or tf32; auto: what there are units for",
    "agent.graph_update": "on a GPU, whether PPO's acting and update are CUDA graphs",
    "agent.average_iterations": "iterations over which the policy's weights are averaged to what is played; 0 is none",
    "agent.clip_actions": "bound of the raw actions, null for none",
    "agent.max_non_finite": "episodes that may end in one iteration because a number was not finite, per environment",
    "agent.symmetry": "how the robot is mirrored left to right, null where it is not",
    "agent.torch_compile_mode": "mode of torch.compile, null for none",
    "recording": "what is recorded",
    "run": "where the run goes",
    "play": "how figures are taken",
    "drive": "how a robot is driven by hand, or by a script",
    "*._target_": "the function or class that is called",
}


def meaning_of(keys: tuple[str, ...]) -> str:
    """Return what a key of the fixed part means, or nothing."""
    path = ".".join(keys)
    for pattern, text in KEYS.items():
        if pattern == path or (len(pattern.split(".")) == len(keys) and fnmatchcase(path, pattern)):
            return text
    return KEYS["*._target_"] if keys and keys[-1] == "_target_" else ""
