"""Settings that change while a policy learns, by their address and a function that says how."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch

from wheelleg_exp.errors import ConfigError, nearest_name
from wheelleg_exp.managers import Env, TermBase
from wheelleg_exp.mdp.curriculums.address import Part, look_up, parse, passes_a_term, require_writable, write
from wheelleg_exp.terms.binding import resolve_target

_NO_CHANGE = object()
_MANAGERS = {
    "commands": "command_manager",
    "actions": "action_manager",
    "observations": "observation_manager",
    "events": "event_manager",
    "rewards": "reward_manager",
    "terminations": "termination_manager",
}


class modify_env_param(TermBase):
    """Let a function change whatever stands at an address below the environment; a number is returned, and logged.

    The address is dotted, with ``[i]`` for lists: ``event_manager.cfg.push_robot.params.velocity_range.x[1]``. What
    it changes is saved and restored with the environment.

    Args:
        env: the environment.
        address: where the value stands.
        modify_fn: dotted name of the function, or a node that builds it. It is called with the environment, the ids of
            the environments that reset, the present value and ``modify_params``, and returns the value from then on,
            or ``modify_env_param.NO_CHANGE``. ``wheelleg_exp.mdp.schedules`` has some.
        modify_params: further arguments of the function, by name.
    """

    NO_CHANGE: ClassVar[Any] = _NO_CHANGE

    def __init__(
        self,
        env: Env,
        address: str,
        modify_fn: str | Callable[..., Any],
        modify_params: Mapping[str, Any] | None = None,
    ) -> None:
        self._env = env
        self._parts = self.parts_of(address)
        self._modify = _function(modify_fn)
        self._params = dict(modify_params or {})
        _require_arguments(self._modify, env, self._params)
        require_writable(env, self._parts)
        # Within a term it is saved there.
        self._is_saved = passes_a_term(env, self._parts)
        self._first = None if self._is_saved else copy.deepcopy(look_up(env, self._parts))
        self._has_written, self._value = False, None

    def parts_of(self, address: str) -> tuple[Part, ...]:
        """Return the parts of an address below the environment."""
        return parse(address)

    def __call__(self, env: Env, env_ids: torch.Tensor) -> float | None:
        """Ask the function, and write what it returns."""
        present = look_up(env, self._parts)
        value = self._modify(env, env_ids, present, **self._params)
        if value is not _NO_CHANGE:
            # What belongs to the parameters stays theirs: two owners of one list could not be made again.
            write(env, self._parts, value if value is present else copy.deepcopy(value))
            self._has_written = True
        present = look_up(env, self._parts)
        return float(present) if isinstance(present, (int, float)) else None

    def state_dict(self) -> dict[str, Any]:
        """Return what has been written where nobody else saves it."""
        saves = self._has_written and not self._is_saved
        self._value = copy.deepcopy(look_up(self._env, self._parts)) if saves else None
        return super().state_dict()

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        super().load_state_dict(saved)
        if not self._is_saved:
            write(self._env, self._parts, copy.deepcopy(self._value if self._has_written else self._first))


class modify_term_cfg(modify_env_param):
    """Let a function change a setting of a term; see ``modify_env_param``.

    The address begins with the section: ``rewards.alive.weight``, ``commands.base_velocity.ranges.lin_vel_x``,
    ``observations.policy.base_ang_vel.noise.n_max``. Parameters may stand below ``params``, as in Isaac Lab.
    """

    def parts_of(self, address: str) -> tuple[Part, ...]:
        """Return the parts of an address below the environment."""
        section, *rest = parse(address)
        if section not in _MANAGERS:
            raise ConfigError(
                f"'{section}' is no section of terms",
                key="address",
                expected="one of " + ", ".join(_MANAGERS),
                nearest=nearest_name(str(section), _MANAGERS),
            )
        return (_MANAGERS[str(section)], *rest)


def _function(given: str | Callable[..., Any]) -> Callable[..., Any]:
    found = resolve_target(given, "modify_fn") if isinstance(given, str) else given
    if not callable(found):
        raise ConfigError(f"{given!r} cannot be called", key="modify_fn", expected="the dotted name of a function")
    return found


def _require_arguments(function: Callable[..., Any], env: Env, params: Mapping[str, Any]) -> None:
    try:
        inspect.signature(function).bind(env, None, None, **params)
    except TypeError as error:
        name = getattr(function, "__name__", type(function).__name__)
        raise ConfigError(f"'{name}': {error}", key="modify_params", expected="the arguments of modify_fn") from None
