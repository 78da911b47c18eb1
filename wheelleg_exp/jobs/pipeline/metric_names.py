"""Whether the gates of a pipeline ask for metrics that there are, told before the first phase is trained."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from wheelleg_exp.build import prepare_asset
from wheelleg_exp.config.composing.compose import Composed
from wheelleg_exp.config.problems import parts, raise_all
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.evaluation.options import Protocol
from wheelleg_exp.evaluation.protocol import evaluate
from wheelleg_exp.jobs.pipeline.options import Gate, Phase
from wheelleg_exp.jobs.pipeline.settings import PRIMARY, compose_gate, in_phase, of_gate
from wheelleg_exp.terms.sections import read_section

_TESTS = ("stand", "walk", "steps", "push", "terrain", "strip", "robust")


def require_metrics(phases: Mapping[str, Phase], composed: Mapping[str, Composed], folders: Sequence[Path]) -> None:
    """Hold the gates of phases against what their protocols measure of the robots of these phases.

    The names are those of an evaluation of actions that are no numbers: every episode is over after its first step.

    Args:
        phases: the phases by name.
        composed: the config of each.
        folders: the user's config folders.

    Raises:
        ConfigError: a gate asks for a metric that its protocol does not have, or the protocol is wrong.
    """
    mistakes: list[ConfigError] = []
    for name, phase in phases.items():
        if phase.gate is not None:
            try:
                mistakes += _unknown(
                    f"{PRIMARY}.phases.{name}.gate", phase.gate, _names(phase.gate, composed[name], folders)
                )
            except ConfigError as error:
                mistakes += [in_phase(of_gate(part, name, phase.gate), name) for part in parts(error)]
    if mistakes:
        raise_all(mistakes)


def _unknown(key: str, gate: Gate, names: Sequence[str]) -> Iterator[ConfigError]:
    for bound, asked in (("at_least", gate.at_least), ("at_most", gate.at_most)):
        for name in asked:
            if name not in names:
                yield ConfigError(
                    f"protocol '{gate.protocol}' has no such metric",
                    key=f"{key}.{bound}.{name}",
                    expected="a metric of its evaluations, such as " + ", ".join(names[:3]),
                    nearest=nearest_name(name, names),
                )


def _names(gate: Gate, composed: Composed, folders: Sequence[Path]) -> list[str]:
    whole = compose_gate(gate, folders)
    protocol: dict[str, Any] = whole.config["protocol"]
    with whole.placing():
        read_section(Protocol, protocol, "protocol")  # as it will be; what follows only makes it short
    protocol["resamples"] = 1
    for test in _TESTS:
        if protocol.get(test) is not None:
            protocol[test] = {**protocol[test], "episodes": 1}
    config = composed.config
    env = {**config["env"], "sim": {**config["env"]["sim"], "engine": "mujoco", "device": "cpu"}}
    asset = prepare_asset(config, composed.asset_roots)
    return list(evaluate(env, asset.output, _no_numbers, protocol).metrics)


def _no_numbers(env: ManagerBasedRLEnv) -> Callable[[Mapping[str, Any]], torch.Tensor]:
    actions = torch.full((env.num_envs, env.action_manager.total_action_dim), torch.nan, device=env.device)
    return lambda _: actions
