"""Add the errors of a real robot to a task, or remove them: noise and delays of sensors, delays of actions, and events.

The section ``env.realism`` names functions of observations instead of terms, so that one variant fits every task.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from wheelleg_exp.constraints import Node
from wheelleg_exp.sim.options import EnvOptions
from wheelleg_exp.terms.config_sections import ActionRealism, Realism, SensorRealism


def with_realism(env: EnvOptions) -> EnvOptions:
    """Return the options of an environment with the errors of ``env.realism`` in its terms."""
    realism = env.realism
    if realism == Realism():
        return env
    # The variant's events change the values that the task's events set, so they run last.
    events = {name: env.events[name] for name in realism.events if name in env.events}
    moved = {*events, *realism.replaces}
    env = replace(env, events={name: node for name, node in env.events.items() if name not in moved} | events)
    return with_action_delay(with_sensor_errors(env, realism.sensors, realism.groups), realism.actions)


def without_errors(env: EnvOptions) -> tuple[int, int]:
    """Return how many of the first robots have exact sensors and bodies, and how many have actions without delay."""
    shares = env.realism.exact_share, env.realism.actions.prompt_share
    return round(shares[0] * env.num_envs), round(shares[1] * env.num_envs)


def without_realism(env: EnvOptions) -> EnvOptions:
    """Return the options of the same task with ``realism=none``."""
    events = {name: node for name, node in env.events.items() if name not in env.realism.events}
    curriculum = {name: node for name, node in env.curriculum.items() if name not in env.realism.curriculum}
    return replace(env, events=events, curriculum=curriculum, realism=Realism())


def without_pushes(env: EnvOptions) -> EnvOptions:
    """Return the options of an environment without events during an episode, such as pushes and kicks."""
    return replace(env, events={n: e for n, e in env.events.items() if e.get("mode") not in ("interval", "step")})


def without_disturbances(env: EnvOptions) -> EnvOptions:
    """Return the options of an environment without pushes, random forces, noise, and curricula of removed events."""
    events = without_pushes(env).events
    events = {name: node for name, node in events.items() if not {"force_range", "torque_range"} & node.keys()}
    of_lost = re.compile(rf"events\.({'|'.join(map(re.escape, env.events.keys() - events.keys())) or '(?!)'})\b")
    curriculum = {n: node for n, node in env.curriculum.items() if not of_lost.match(str(node.get("address")))}
    groups = {
        name: replace(group, enable_corruption=False, terms={n: {**t, "noise": None} for n, t in group.terms.items()})
        for name, group in env.observations.items()
    }
    sensors = {name: replace(errors, noise=None) for name, errors in env.realism.sensors.items()}
    realism = replace(env.realism, sensors=sensors)
    return replace(env, events=events, curriculum=curriculum, observations=groups, realism=realism)


def with_action_delay(env: EnvOptions, errors: ActionRealism) -> EnvOptions:
    """Return the options of an environment with a delay of all actions."""
    return replace(env, actions={name: _delayed(node, errors, env.sim.dt) for name, node in env.actions.items()})


def with_sensor_errors(env: EnvOptions, sensors: Mapping[str, SensorRealism], groups: Sequence[str]) -> EnvOptions:
    """Return an environment's options with sensor errors, by function, in the terms of the observation ``groups``."""
    changed = dict(env.observations)
    for name in groups:
        if (group := changed.get(name)) is not None:
            terms = {n: _sensed(node, sensors, group.enable_corruption, env.sim.dt) for n, node in group.terms.items()}
            changed[name] = replace(group, enable_corruption=True, terms=terms)
    return replace(env, observations=changed)


def _sensed(node: Node, sensors: Mapping[str, SensorRealism], is_noisy: bool, dt: float) -> Node:
    errors = sensors.get(str(node["_target_"]).rpartition(".")[2])
    if errors is not None:
        node = _delayed(node, errors, dt)
    if not is_noisy or (errors is not None and errors.noise is not None):
        # A group without noise in the task must get no noise but that of the sensor.
        node = {**node, "noise": None if errors is None else errors.noise}
    return node


def _delayed(node: Node, errors: SensorRealism | ActionRealism, dt: float) -> Node:
    low, high = (round(delay / dt) for delay in errors.delay_s)
    jitter = round(errors.jitter_s / dt)
    return node if high + jitter == 0 else {**node, "delay": [low, high], "delay_jitter": jitter}
