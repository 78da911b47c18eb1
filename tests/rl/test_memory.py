"""Test that configs that exceed the machine's memory are rejected by their key before the allocation."""

import pytest

from wheelleg_exp import machine
from wheelleg_exp.errors import ConfigError

SENSORS = "wheelleg_exp.sim.sensors"
EYES = f"+env.scene.sensors.eyes={{_target_: {SENSORS}.RayCaster, body_name: base_link, pattern: {{_target_: {SENSORS}."
PATTERNS = ("GridPattern, resolution: 1e-5, size: [2, 2]}}", "PinholePattern, width: 1000000, height: 1000000}}")
CONTACTS = "env.scene.sensors.contact_forces"
TOO_MUCH = {
    "env.num_envs=1000000000000": "1,000,000,000,000 environments take",
    "env.num_envs=100000000000000000000": "environments take",
    "agent.num_steps_per_env=1000000000": "times 1000000000 steps take",
    "agent.actor.hidden_dims=[10000000,10000000]": "weights and what trains them take",
    "agent.critic.hidden_dims=[3000000,1000000]": "weights and what trains them take",
    "env.observations.policy.history_length=1000000000": "histories of 1000000000 steps",
    f"{CONTACTS}.history_length=1000000000": "numbers of past forces take",
    f"{CONTACTS}.max_contacts=1000000000": "readings of contacts take",
}
CASES = [(override, override.partition("=")[0], said) for override, said in TOO_MUCH.items()]
CASES += [(EYES + pattern, "env.scene.sensors.eyes.pattern", "rays take") for pattern in PATTERNS]


@pytest.mark.parametrize(("override", "key", "said"), CASES)
def test_a_config_that_exceeds_the_memory_names_its_key_and_both_sizes(override, key, said, make_trainer):
    with pytest.raises(ConfigError) as caught:
        make_trainer(override)
    assert caught.value.key == key
    assert said in caught.value.message
    assert caught.value.message.endswith(" of memory at least")
    assert "of this machine" in str(caught.value.expected)


def test_the_need_is_compared_with_the_memory_of_the_machine(monkeypatch):
    monkeypatch.setattr(machine, "machine_memory", lambda: 1000)
    machine.require_memory(1000, "a.key", "ten things")
    monkeypatch.setattr(machine, "machine_memory", lambda: 999)
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
