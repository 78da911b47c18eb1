"""Test that configs that exceed the machine's memory are rejected by their key before the allocation."""

from __future__ import annotations

import pytest

from wheelleg_exp import machine
from wheelleg_exp.errors import ConfigError

SENSORS = "wheelleg_exp.sim.sensors"
EYES = f"+env.scene.sensors.eyes={{_target_: {SENSORS}.RayCaster, body_name: base_link, pattern: {{_target_: {SENSORS}."
TOO_MUCH = {
    "env.num_envs=1000000000000": ("env.num_envs", "1,000,000,000,000 environments take"),
    "env.num_envs=100000000000000000000": ("env.num_envs", "environments take"),
    "agent.num_steps_per_env=1000000000": ("agent.num_steps_per_env", "times 1000000000 steps take"),
    "agent.actor.hidden_dims=[10000000,10000000]": ("agent.actor.hidden_dims", "weights and what trains them take"),
    "agent.critic.hidden_dims=[3000000,1000000]": ("agent.critic.hidden_dims", "weights and what trains them take"),
    "env.observations.policy.history_length=1000000000": (
        "env.observations.policy.history_length",
        "histories of 1000000000 steps",
    ),
    "env.scene.sensors.contact_forces.history_length=1000000000": (
        "env.scene.sensors.contact_forces.history_length",
        "numbers of past forces take",
    ),
    "env.scene.sensors.contact_forces.max_contacts=1000000000": (
        "env.scene.sensors.contact_forces.max_contacts",
        "readings of contacts take",
    ),
    EYES + "GridPattern, resolution: 1e-5, size: [2, 2]}}": ("env.scene.sensors.eyes.pattern", "rays take"),
    EYES + "PinholePattern, width: 1000000, height: 1000000}}": ("env.scene.sensors.eyes.pattern", "rays take"),
}


@pytest.mark.parametrize("override", TOO_MUCH)
def test_what_cannot_fit_names_its_key_and_both_sizes(override, make_trainer):
    key, told = TOO_MUCH[override]
    with pytest.raises(ConfigError) as caught:
        make_trainer(override)
    assert caught.value.key == key
    assert told in caught.value.message
    assert caught.value.message.endswith(" of memory at least")
    assert "of this machine" in str(caught.value.expected)


@pytest.mark.parametrize(("there", "fits"), [(999, False), (1000, True)])
def test_the_need_is_held_against_what_is_there(there, fits, monkeypatch):
    monkeypatch.setattr(machine, "machine_memory", lambda: there)
    if fits:
        machine.require_memory(1000, "a.key", "ten things")
        return
    with pytest.raises(ConfigError, match=r"a\.key: ten things take 0\.001 MB of memory at least"):
        machine.require_memory(1000, "a.key", "ten things")


def test_a_containers_limit_counts(monkeypatch, tmp_path):
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(machine, "_LIMIT", limit)
    whole = machine.machine_memory()
    assert whole > 1e8
    limit.write_text("max\n")
    assert machine.machine_memory() == whole
    limit.write_text("1000000\n")
    assert machine.machine_memory() == 1_000_000
