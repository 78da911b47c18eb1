"""Write a small stock config tree, a user config tree, and a module of targets into a folder."""

import textwrap
from pathlib import Path
from typing import Any

from wheelleg_exp.config.composing.provenance import Provenance
from wheelleg_exp.terms.key_syntax import Keys, split_path

TARGETS = '''
"""Targets of the tests."""

from wheelleg_exp.constraints import Interval
from wheelleg_exp.managers import ActionTerm

class Effort(ActionTerm):
    """An effort action."""

    def __init__(self, env, joint_names: list[str], gain: float = 1.0):
        pass

def alive(env):
    """One while the robot is up."""

def height(env, target_height: float, sensor=None):
    """Squared distance from a height."""

def smooth(env, order: int = 1):
    """Change of the action."""

def takes_weight(env, weight: float):
    """A target that uses the manager's name."""

def fell(env, limit: float):
    """True when the robot has fallen."""

def push(env, env_ids, generator, velocity_range: Interval):
    """Push the robot."""

def speed(env):
    """Speed of the base, m/s."""

def joints(env, entity: object = None):
    """Joint positions, rad."""

class Noise:
    """Uniform noise."""

    def __init__(self, low: float, high: float):
        pass

NOT_CALLABLE = 3
'''

STOCK = {
    "train.yaml": """
        defaults:
          - task: stand
          - run: default
          - override hydra/job_logging: none
          - override hydra/hydra_logging: none
          - _self_
        seed: 1
        recording: {}
    """,
    "play.yaml": "defaults:\n  - train\n  - _self_\nseed: 7\n",
    "task/stand.yaml": """
        # @package _global_
        # Stand still.
        defaults:
          - /robot: article
          - /sim: mujoco
          - /agent: ppo
          - /action@env.actions: [effort]
          - /observation@env.observations.policy.terms: [speed, joints]
          - /observation@env.observations.critic.terms: [joints, speed]
          - /event@env.events: [push]
          - /reward@env.rewards: [alive, height]
          - /termination@env.terminations: [fell]
          - _self_
        task:
          name: stand
        env:
          num_envs: 8
          episode_length_s: 5.0
          decimation: 2
          scene: {spacing: 2.0}
          rewards:
            height:
              weight: -50.0
          observations:
            policy: {enable_corruption: true, history_length: 5}
    """,
    "task/walk.yaml": """
        # @package _global_
        # Walk along.
        defaults:
          - stand
          - /reward@env.rewards: [smooth]
          - _self_
        task:
          name: walk
        env:
          num_envs: ${seed}
          rewards:
            alive: null
    """,
    "robot/article.yaml": """
        # @package env.robot
        asset: robot.usda
        joint_pos:
          ".*_hip": 0.1
          wheel: 0.0
        order: [a, b]
        length: ${env.sim.dt}
    """,
    "robot/physical.yaml": "# @package env.robot\nasset: real.usda\n",
    "sim/mujoco.yaml": "# @package env.sim\ndt: 0.01\nsolver: newton\n",
    "agent/ppo.yaml": """
        # @package agent
        num_steps_per_env: 24
        max_iterations: 10
        save_interval: 5
        device: cpu
        torch_threads: 1
        obs_groups: {actor: [policy], critic: [critic]}
        algorithm: {class_name: PPO, gamma: 0.99}
        actor: {class_name: MLPModel, distribution_cfg: {class_name: GaussianDistribution}}
        critic: {class_name: MLPModel}
    """,
    "run/default.yaml": "# @package run\nroot: runs\nname: null\n",
    "action/effort.yaml": "effort:\n  _target_: shelf_terms.Effort\n  joint_names: [a]\n",
    "observation/speed.yaml": """
        speed:
          _target_: shelf_terms.speed
          noise: {_target_: shelf_terms.Noise, low: -0.1, high: 0.1}
    """,
    "observation/joints.yaml": "joints:\n  _target_: shelf_terms.joints\n",
    "event/push.yaml": """
        push:
          _target_: shelf_terms.push
          mode: interval
          interval_range_s: [1.0, 2.0]
          velocity_range: [-0.5, 0.5]
    """,
    "reward/alive.yaml": "alive:\n  _target_: shelf_terms.alive\n  weight: 1.0\n",
    "reward/height.yaml": """
        # Keep the base at a height.
        height:
          _target_: shelf_terms.height
          weight: 1.0
          target_height: 0.07
    """,
    "reward/smooth.yaml": "smooth:\n  _target_: shelf_terms.smooth\n  weight: -0.1\n",
    "termination/fell.yaml": "fell:\n  _target_: shelf_terms.fell\n  limit: 0.5\n",
}

USER = {
    "task/hop.yaml": """
        # @package _global_
        # Hop, in a folder of the user's own.
        defaults:
          - stand
          - override /reward@env.rewards: [alive, bounce]
          - _self_
        task:
          name: hop
        env:
          rewards:
            height: null
    """,
    "reward/bounce.yaml": "bounce:\n  _target_: shelf_terms.height\n  weight: 3.0\n  target_height: 0.2\n",
}


def replayed(places: Provenance) -> dict[str, Any]:
    """Return the raw values of all sources as a nested mapping, in the order of the sources."""
    return build({split_path(path): source.value for path, source in places.items()})


def write(folder: Path, files: dict[str, str]) -> Path:
    """Write dedented texts to files below ``folder``, and return ``folder``."""
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text).lstrip("\n"), encoding="utf-8")
    return folder


def build(entries: dict[Keys, Any]) -> dict[str, Any]:
    """Return the nested mapping that has given values at given key paths."""
    tree: dict[str, Any] = {}
    for keys, value in entries.items():
        node = tree
        for key in keys[:-1]:
            node = node.setdefault(key, {})
        node[keys[-1]] = value
    return tree
