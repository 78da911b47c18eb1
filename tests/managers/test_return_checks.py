"""Wrong return values of terms: the error names the term's key, its line, and the code to write instead."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from managers import spies
from wheelleg_exp.errors import ConfigError, SimulationFailure, WheellegError
from wheelleg_exp.managers import ActionTerm, CommandTerm, Env
from wheelleg_exp.mdp.modifiers import Modifier

HERE = "managers.test_return_checks."
N = 4
STILL = torch.zeros(N, 4)


def raw(env: Env) -> Any:
    return spies.VALUES["raw"](env)


def raw_of(env: Env, env_ids: torch.Tensor | None) -> Any:
    return spies.VALUES["raw"](env)


class RawCommand(CommandTerm):
    def __init__(self, env: Env, generator: torch.Generator) -> None:
        super().__init__(env, (1.0, 2.0), ["far", "fast"], generator)

    @property
    def command(self) -> torch.Tensor:
        return spies.VALUES["raw"](self._env)

    def errors(self) -> torch.Tensor:
        return spies.VALUES["errors"](self._env)

    def draw(self, env_ids: torch.Tensor) -> None:
        pass


class RawAction(ActionTerm):
    def __init__(self, env: Env) -> None:
        self.raw_actions, self.processed_actions = torch.zeros(env.num_envs, 2), torch.zeros(env.num_envs, 2)
        vars(self).update(spies.VALUES["raw"](env))

    def process_actions(self, actions: torch.Tensor) -> None:
        raise KeyError("wheels")


class RawNoise:
    def __call__(self, value: torch.Tensor, generator: torch.Generator) -> Any:
        return spies.VALUES["raw"](value)


class RawModifier(Modifier):
    def __call__(self, value: torch.Tensor) -> Any:
        return spies.VALUES["raw"](value)


def observed(**fields: Any) -> dict[str, Any]:
    node = {"_target_": "wheelleg_exp.mdp.observations.base_ang_vel", **fields}
    return {"observations": {"policy": {"enable_corruption": True, "terms": {"t": node}}}}


ROW = {"_target_": HERE + "raw"}
TERM = "env.observations.policy.terms.t"
SECTIONS = {
    "rewards": ({"rewards": {"t": {**ROW, "weight": 1.0}}}, "env.rewards.t"),
    "terminations": ({"terminations": {"t": ROW}}, "env.terminations.t"),
    "observations": ({"observations": {"policy": {"terms": {"t": ROW}}}}, TERM),
    "events": ({"events": {"t": {"_target_": HERE + "raw_of", "mode": "reset"}}}, "env.events.t"),
    "curriculum": ({"curriculum": {"t": {"_target_": HERE + "raw_of"}}}, "env.curriculum.t"),
    "commands": ({"commands": {"t": {"_target_": HERE + "RawCommand"}}}, "env.commands.t"),
    "actions": ({"actions": {"t": {"_target_": HERE + "RawAction"}}}, "env.actions.t"),
    "noise": (observed(noise={"_target_": HERE + "RawNoise"}), f"{TERM}.noise"),
    "modifiers": (observed(modifiers=[{"_target_": HERE + "RawModifier"}]), f"{TERM}.modifiers[0]"),
}  # fmt: skip
NUMBERS = "a real tensor of shape (4,), a number for each environment"
FLAGS = "a bool tensor of shape (4,), a true or false for each environment"
ROWS = "a float32 tensor of shape (4, width), a row of numbers for each environment"
THREE = "a float32 tensor of shape (4, 3), a row of numbers for each environment"

# The section and the name of a case: the return value, the message, and the expected value.
WRONG: dict[tuple[str, str], tuple[Any, str, str]] = {
    ("rewards", "a number"): (lambda _: 1.5, "returns float 1.5", f"{NUMBERS}: torch.full((env.num_envs,), value)"),
    ("rewards", "nothing"): (lambda _: None, "returns nothing", f"{NUMBERS}: a return statement may be missing"),
    ("rewards", "a list"): (lambda _: [1] * N, "returns list [1, 1, 1, 1]", f"{NUMBERS}: torch.tensor(value)"),
    ("rewards", "an array"): (lambda _: np.ones(N), "a numpy array", f"{NUMBERS}: torch.from_numpy(value)"),
    ("rewards", "two"): (lambda _: (torch.ones(N), torch.ones(N)), "returns a tuple", NUMBERS),
    ("rewards", "a column"): (lambda _: torch.ones(N, 1), "returns shape (4, 1)", f"{NUMBERS}: value.squeeze(1)"),
    ("rewards", "one"): (lambda _: torch.tensor(1.0), "returns shape ()", f"{NUMBERS}: value.expand(env.num_envs)"),
    ("rewards", "too few"): (lambda _: torch.ones(3), "returns shape (3,)", NUMBERS),
    ("rewards", "complex"): (lambda _: torch.ones(N) * 1j, "complex64 numbers", f"{NUMBERS}: value.real"),
    ("rewards", "elsewhere"): (lambda _: torch.ones(N, device="meta"), "on meta", f"{NUMBERS}: value.to('cpu')"),
    ("rewards", "a gradient"): (lambda _: torch.ones(N, requires_grad=True), "gradient", f"{NUMBERS}: value.detach()"),
    ("terminations", "numbers"): (lambda _: torch.ones(N), "float32 numbers", f"{FLAGS}: a comparison, such as"),
    ("observations", "one a robot"): (lambda _: torch.ones(N), "shape (4,)", f"{ROWS}: value.unsqueeze(1)"),
    ("observations", "no column"): (lambda _: torch.ones(N, 0), "shape (4, 0)", ROWS),
    ("observations", "doubles"): (lambda _: torch.ones(N, 2).double(), "float64 numbers", f"{ROWS}: value.float()"),
    ("observations", "flags"): (lambda _: torch.ones(N, 2).bool(), "bool numbers", f"{ROWS}: value.float()"),
    ("events", "a tensor"): (lambda _: torch.ones(N), "but must return nothing", "no return value"),
    ("curriculum", "text"): (lambda _: "easy", "returns str 'easy'", "a number, numbers by name, or None"),
    ("curriculum", "a vector"): (lambda _: torch.ones(N), "a tensor of shape (4,)", "a number, numbers by name"),
    ("curriculum", "text by name"): (lambda _: {"a": "x"}, "returns str 'x' in a mapping", "a number, numbers by name"),
    ("commands", "one a robot"): (lambda _: torch.ones(N), "the command of", f"{ROWS}: value.unsqueeze(1)"),
    ("actions", "no width"): (lambda _: {}, "action_dim of", "a whole number of at least 1"),
    ("actions", "a width of 0"): (lambda _: {"action_dim": 0}, "is 0", "a whole number of at least 1"),
    ("actions", "a float"): (lambda _: {"action_dim": 2.0}, "is 2.0", "a whole number of at least 1"),
    ("actions", "no actions"): (lambda _: {"action_dim": 2, "raw_actions": None}, "raw_actions of", ROWS),
    ("noise", "a number"): (lambda _: 0.1, "returns float 0.1", THREE),
    ("noise", "one column"): (lambda value: value[:, :1], "returns shape (4, 1)", THREE),
    ("modifiers", "nothing"): (lambda _: None, "returns nothing", THREE),
}  # fmt: skip


def _run(start_env, section):
    sections, key = SECTIONS[section]
    env = start_env(**sections)
    if section == "commands":
        env.command_manager.get_command("t")
    env.step(torch.zeros(N, env.action_manager.total_action_dim))
    return key


def _error_of(start_env, section) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        _run(start_env, section)
    error = caught.value
    assert error.key == SECTIONS[section][1]
    assert error.where is not None
    assert error.where.split(":")[0].endswith("managers/test_return_checks.py")
    return error


@pytest.mark.parametrize("returned", WRONG, ids=" returns ".join)
def test_a_wrong_return_value_is_reported_with_the_code_to_write(returned, start_env):
    value, words, expected = WRONG[returned]
    spies.VALUES.update(raw=value, errors=lambda _: torch.zeros(2, N))
    error = _error_of(start_env, returned[0])
    assert words in error.message
    assert expected in str(error.expected)


@pytest.mark.parametrize(
    ("section", "value"),
    [
        ("rewards", lambda _: torch.ones(N, dtype=torch.bool)),
        ("rewards", lambda _: torch.ones(N, dtype=torch.float64)),
        ("terminations", lambda _: torch.zeros(N, dtype=torch.bool)),
        ("observations", lambda _: torch.ones(N, 7)),
        ("events", lambda _: None),
        ("curriculum", lambda _: None),
        ("curriculum", lambda _: {"a": 1, "b": torch.tensor(2.0), "c": np.float32(1.0)}),
        ("commands", lambda _: torch.ones(N, 2)),
        ("noise", lambda value: value + 1.0),
        ("modifiers", lambda value: value * 2.0),
    ],
)
def test_usable_return_values_are_accepted(section, value, start_env):
    spies.VALUES.update(raw=value, errors=lambda _: torch.zeros(2, N))
    _run(start_env, section)


def test_a_shape_that_changes_later_is_rejected(start_env):
    spies.VALUES.update(raw=lambda env: torch.ones(N, 2 + env.common_step_counter))
    assert _error_of(start_env, "observations").message.endswith("returns shape (4, 3), and (4, 2) before")


@pytest.mark.parametrize("errors", [0.0, torch.zeros(N), torch.zeros(3, N)])
def test_errors_of_a_command_have_a_row_for_each_metric(errors, start_env):
    spies.VALUES.update(raw=lambda _: torch.zeros(N, 2), errors=lambda _: errors)
    with pytest.raises(ConfigError) as caught:
        _run(start_env, "commands")
    assert caught.value.key == "env.commands.t"
    assert "a tensor of shape (2, 4), a row for each of far, fast" in str(caught.value.expected)


@pytest.mark.parametrize("section", [name for name in SECTIONS if name != "commands"])
def test_an_error_in_a_terms_code_is_reported_with_its_key_and_line(section, start_env):
    spies.VALUES.update(raw=lambda _: {"action_dim": 2} if section == "actions" else {}["missing"])
    assert (
        f"raises KeyError: '{'wheels' if section == 'actions' else 'missing'}'" in _error_of(start_env, section).message
    )


def test_a_term_that_raises_after_it_has_worked_is_a_failed_run(start_env):
    spies.VALUES.update(raw=lambda _: torch.ones(N))
    env = start_env(**SECTIONS["rewards"][0])
    env.step(STILL)
    spies.VALUES.update(raw=lambda _: 1 // 0)
    with pytest.raises(SimulationFailure, match="ZeroDivisionError") as caught:
        env.step(STILL)
    assert caught.value.key == "env.rewards.t"


def test_a_class_that_cannot_be_constructed_is_reported_with_its_key(start_env):
    spies.VALUES.update(raw=lambda env: env.nothing)
    with pytest.raises(WheellegError, match="AttributeError") as caught:
        start_env(**SECTIONS["actions"][0])
    assert caught.value.key == "env.actions.t"
