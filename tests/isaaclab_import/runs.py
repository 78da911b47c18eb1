"""Write run folders in the form of Isaac Lab, for the stock robot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import yaml

ROBOT = Path(__file__).parents[2] / "assets/wheelleg/wheelleg.usda"
LEGS, WHEELS = ["l01", "r01", "l02", "r02"], ["l03", "r03"]

PARAMS = Path(__file__).with_name("params")
ENV, AGENT = ((PARAMS / name).read_text(encoding="utf-8") for name in ("env.yaml", "agent.yaml"))
TERMS = """
from __future__ import annotations

import torch
from isaaclab.managers import SceneEntityCfg
from isaaclab_tasks.manager_based.locomotion.velocity import mdp
from .helpers import squared as power_two
from typing import TYPE_CHECKING
import pandas

if TYPE_CHECKING:
    from isaaclab.envs import ManagerBasedRLEnv

FACTOR = 0.5


def tilt_cost(env: ManagerBasedRLEnv, power: float, asset_cfg: SceneEntityCfg = SceneEntityCfg("robot")):
    return FACTOR * power * power_two(env.scene[asset_cfg.name].data.projected_gravity_b[:, :2]).sum(1)


def failing(env):
    return undefined_name + env.num_envs


def unused(env):
    return pandas.DataFrame()
"""
HELPERS = "import torch\n\n\ndef squared(x):\n    return torch.square(x)\n"


def network(inputs: int, hidden: list[int], outputs: int) -> torch.nn.Sequential:
    """Return a multilayer perceptron as rsl_rl builds it."""
    layers: list[torch.nn.Module] = []
    for a, b in zip([inputs, *hidden], [*hidden, outputs], strict=True):
        layers += [torch.nn.Linear(a, b), torch.nn.ELU()]
    return torch.nn.Sequential(*layers[:-1])


class ActorCritic(torch.nn.Module):
    """The networks of rsl_rl 2 and 3, with their names."""

    def __init__(self, inputs: int = 25, actions: int = 6) -> None:
        super().__init__()
        self.actor, self.critic = network(inputs, [32, 16], actions), network(inputs, [24, 16], 1)
        self.std = torch.nn.Parameter(torch.full((actions,), 0.3))


class Exported(torch.nn.Module):
    """A policy as Isaac Lab exports it."""

    def __init__(self, actor: torch.nn.Module, normalizer: torch.nn.Module) -> None:
        super().__init__()
        self.actor, self.normalizer = actor, normalizer

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.actor(self.normalizer(x))


class Normalizer(torch.nn.Module):
    """rsl_rl's normalization of observations."""

    def __init__(self, inputs: int = 25) -> None:
        super().__init__()
        self.register_buffer("_mean", torch.randn(1, inputs))
        self.register_buffer("_var", torch.rand(1, inputs) + 0.5)
        self.register_buffer("_std", self._var.sqrt())
        self.register_buffer("count", torch.tensor(5000))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (x - self._mean) / (self._std + 1e-2)


def checkpoint(policy: ActorCritic, iteration: int = 700) -> dict[str, Any]:
    """Return a checkpoint of rsl_rl 2."""
    optimizer = torch.optim.Adam(policy.parameters(), lr=0.001)
    policy.critic(policy.actor[0].weight.new_ones(1, 25)).sum().backward()
    policy.actor(torch.ones(1, 25)).sum().backward()
    policy.std.grad = torch.ones(6)
    optimizer.step()
    states = {"model_state_dict": policy.state_dict(), "optimizer_state_dict": optimizer.state_dict()}
    return {**states, "iter": iteration, "infos": None}


def write_run(folder: Path, env: str = ENV, agent: str | None = AGENT) -> tuple[Path, ActorCritic]:
    """Write an Isaac Lab run with a checkpoint, and return its folder and its networks."""
    torch.manual_seed(3)
    (folder / "params").mkdir(parents=True)
    (folder / "params/env.yaml").write_text(env)
    if agent is not None:
        (folder / "params/agent.yaml").write_text(agent)
    policy = ActorCritic()
    torch.save(checkpoint(policy), folder / "model_700.pt")
    return folder, policy


def write_terms(folder: Path) -> Path:
    """Write the author's Python code."""
    place = folder / "source/my_lab/tasks/mdp"
    place.mkdir(parents=True)
    (place / "rewards.py").write_text(TERMS)
    (place / "helpers.py").write_text(HELPERS)
    (place / "broken.py").write_text("def (")
    return folder


def changed(text: str, key: str, value: Any) -> str:
    """Return ``ENV`` with another value at a dotted key; Python's tags are kept as lists."""
    from wheelleg_exp.plain_data import tagged_yaml_value

    tree = tagged_yaml_value(text)
    *parents, last = key.split(".")
    node = tree
    for parent in parents:
        node = node[parent]
    if value is None:
        del node[last]
    else:
        node[last] = value
    return yaml.safe_dump(tree, sort_keys=False)
