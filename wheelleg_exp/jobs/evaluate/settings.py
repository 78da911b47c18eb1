"""What an evaluation reads: the env and agent that a run has kept, and a composed protocol."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wheelleg_exp.config import schema
from wheelleg_exp.config.checking.check import check_tree
from wheelleg_exp.config.composing.amend import amend, placing, require_read
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.config.problems import raise_all
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.evaluation.options import Protocol
from wheelleg_exp.evaluation.task import evaluation_cfg, rewarded_height
from wheelleg_exp.run.directory import RunDirectory
from wheelleg_exp.run.params import OF_A_POLICY, load_params, on_reference_engine, present_form
from wheelleg_exp.terms.sections import read_section

_INSTEAD = {
    "env.num_envs": "the episodes of a test, such as protocol.stand.episodes",
    "env.episode_length_s": "the length of a test, such as protocol.stand.horizon_s",
    "env.scene.terrain": "protocol.ground=own, which evaluates on the task's own ground",
    "env.rewards": "a key that an evaluation reads: rewards are not computed",
    "agent.device": "env.sim.engine and env.sim.device: the policy runs where the simulation does",
    "agent": "agent.torch_threads, agent.clip_actions, or a key of the policy's network",
    "": "a key of what is evaluated: robot, scene, actions, observations, failures, events at startup and reset",
}


def settings(run: RunDirectory, overrides: Sequence[str], config_dirs: Sequence[Path] = ()) -> dict[str, Any]:
    """Return ``env``, ``agent``, ``protocol`` and ``seed``, plain: the run's own but for the overrides.

    Args:
        run: the run.
        overrides: those of ``protocol`` and ``seed`` choose and change the protocol, all others the run's parameters.
        config_dirs: folders of the user's own protocols.

    Raises:
        WheellegError: an override, the run or the protocol is wrong.
    """
    mine = [text for text in overrides if _is_of_protocol(text)]
    others = of_the_run(overrides)
    composed = compose(mine, primary="evaluate", config_dirs=config_dirs)
    env, agent = load_params(run)
    kept = {"env": on_reference_engine(present_form(env)), "agent": agent}
    tree = {**amend(kept, others), **{key: composed.config[key] for key in ("seed", "protocol")}}
    with composed.placing(), placing(others):
        if errors := check_tree(tree, schema.EvaluateRoot):
            raise_all(errors)
        for key in ("asset", "base"):
            if tree["env"]["robot"][key] != kept["env"]["robot"][key]:
                raise ConfigError(
                    "a policy is evaluated on the robot that it was trained on",
                    key=f"env.robot.{key}",
                    expected="the run's own value; another robot needs a new run",
                )
        protocol = read_section(Protocol, tree["protocol"], "protocol")
        require_read(kept, others, lambda changed: _read(changed, protocol), _INSTEAD)
    return tree


def _read(tree: Mapping[str, Any], protocol: Protocol) -> Any:
    """Return what an evaluation reads of ``env`` and ``agent``."""
    env = tree["env"]
    height = rewarded_height(env) if protocol.target_height is None else None
    agent = {key: value for key, value in tree["agent"].items() if key in OF_A_POLICY}
    return evaluation_cfg(env, protocol, 1, 1.0, protocol.ground), height, agent


def of_the_run(overrides: Sequence[str]) -> list[str]:
    """Return the overrides that change the run's parameters, and not the protocol."""
    return [text for text in overrides if not _is_of_protocol(text)]


def _is_of_protocol(override: str) -> bool:
    key = override.lstrip("+~").partition("=")[0]
    return key.split(".")[0].split("@")[0] in ("protocol", "seed")
