"""Events: randomisation and disturbances, by the time at which they run."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import torch

from wheelleg_exp.errors import nearest_name
from wheelleg_exp.managers.manager_base import ManagerBase, Term, instantiate_term, table
from wheelleg_exp.managers.non_finite import require_finite_writes
from wheelleg_exp.managers.return_checks import NoForm
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.sim.ids import ids_where
from wheelleg_exp.sim.timers import may_be_due
from wheelleg_exp.terms.term_binding import EVENT_MODES


class EventManager(ManagerBase):
    """Runs terms by mode: ``prestartup``, ``startup``, ``reset``, ``interval``, ``step``, or a user-defined mode.

    The manager is built before the scene is compiled, so that ``prestartup`` terms can edit ``env.scene.spec``.
    """

    kind = "events"

    def __init__(self, nodes: Mapping[str, Any] | None, env: Env) -> None:
        super().__init__(nodes, env, instantiate=False)
        self._modes: dict[str, dict[str, Term]] = {}
        self._time_left: dict[str, torch.Tensor] = {}
        self._last_step: dict[str, torch.Tensor] = {}
        self._fired_once: dict[str, torch.Tensor] = {}
        self.fired: dict[str, torch.Tensor] = {}
        self._asked: dict[str, set[str]] = {name: set() for name in self._terms}
        for name, term in self._terms.items():
            mode = term.fields["mode"]
            term.form = NoForm()
            self._modes.setdefault(mode, {})[name] = term
            if mode == "prestartup":
                instantiate_term(term, env)
            if mode == "interval":
                self._start_timer(name, term)
            elif mode == "reset":
                self._start_counter(name)

    def play(self) -> None:
        """Make the term objects, once the simulations run."""
        for name, term in self._terms.items():
            instantiate_term(term, self._env)
            self._note_asked(name)

    @property
    def active_terms(self) -> dict[str, list[str]]:  # type: ignore[override]  # as in Isaac Lab
        """Names of the terms by mode, in declaration order."""
        return {mode: list(terms) for mode, terms in self._modes.items()}

    @property
    def available_modes(self) -> list[str]:
        """Modes of the terms."""
        return list(self._modes)

    def apply(self, mode: str, env_ids: torch.Tensor | None = None, global_env_step_count: int | None = None) -> None:
        """Run the terms of ``prestartup``, ``startup``, ``reset``, or a user-defined mode.

        Args:
            mode: the mode. A user-defined mode without terms causes a warning.
            env_ids: environments, or None for all.
            global_env_step_count: control steps so far; required for ``reset``.

        Raises:
            ValueError: the mode is ``interval`` (see ``apply_interval``), or ``reset`` without a step count.
            SimulationFailure: a term wrote NaN or inf.
        """
        if mode == "interval":
            raise ValueError("interval events are applied by apply_interval(dt)")
        if mode not in (*EVENT_MODES, *self._modes):
            nearest = nearest_name(mode, self._modes)
            hint = f"; did you mean '{nearest}'?" if nearest else ""
            warnings.warn(f"no event has the mode '{mode}'{hint}", stacklevel=2)
        for name, term in self._modes.get(mode, {}).items():
            ids = env_ids
            if mode == "reset":
                if global_env_step_count is None:
                    raise ValueError("reset events need global_env_step_count")
                ids = self._due(name, term, self._all_ids(env_ids), global_env_step_count)
                if not len(ids):
                    continue
            if mode == "prestartup":  # there is no simulation yet
                term(self._env, ids)
            else:
                self._run(name, term, ids)

    def apply_interval(self, dt: float) -> None:
        """Advance the timers by ``dt`` seconds, run the terms whose time is up, then the terms of mode ``step``."""
        self.advance_timers(dt)
        self.apply_due(dt)

    def advance_timers(self, dt: float) -> None:
        """Subtract ``dt`` seconds from the timers. ``fired`` then holds the environments whose time is up."""
        for name in self._modes.get("interval", {}):
            time_left = self._time_left[name]
            time_left -= dt
            self.fired[name] = time_left < 1e-6

    def apply_due(self, dt: float) -> bool:
        """Run the terms whose time is up, then the terms of mode ``step``; return whether any term ran.

        Args:
            dt: seconds that were subtracted from the timers last.
        """
        ran = False
        for name, term in self._modes.get("interval", {}).items():
            if not may_be_due(self._time_left[name], float(term.fields["interval_range_s"][0]), dt):
                continue
            ids = ids_where(self.fired[name])
            if not len(ids):
                continue
            if term.fields.get("is_global_time", False):
                self._draw_timer(name, term, torch.zeros(1, dtype=torch.long, device=self._env.device))
                self._run(name, term, None)
            else:
                self._draw_timer(name, term, ids)
                self._run(name, term, ids)
            ran = True
        for name, term in self._modes.get("step", {}).items():
            self._run(name, term, None)
            ran = True
        return ran

    def _run(self, name: str, term: Term, ids: torch.Tensor | None) -> None:
        """Run a term, and check that the numbers it wrote are finite."""
        term(self._env, ids)
        self._env.scene.robot.data.invalidate()  # the term may have written to any quantity
        self._note_asked(name)
        require_finite_writes(self._env, term.path, self._asked[name], ids)

    def _note_asked(self, name: str) -> None:
        """Note which quantities a term requested for writing. It may write to them again in a later run."""
        asked = self._env.scene.sim.asked
        if asked:
            self._asked[name] |= asked
            asked.clear()

    def reset(self, env_ids: torch.Tensor) -> dict[str, Any]:
        """Draw new timers for ``env_ids``, and reset all terms except those of ``prestartup``."""
        for name, term in self._modes.get("interval", {}).items():
            if not term.fields.get("is_global_time", False):
                self._draw_timer(name, term, env_ids)
        self._reset_terms(env_ids, but=self._modes.get("prestartup", {}))
        return {}

    def state_dict(self) -> dict[str, Any]:
        """Return timers, counters, and the states of the terms."""
        return {
            **super().state_dict(),
            "time_left": {k: v.clone() for k, v in self._time_left.items()},
            "last_step": {k: v.clone() for k, v in self._last_step.items()},
            "fired_once": {k: v.clone() for k, v in self._fired_once.items()},
            "fired": {k: v.clone() for k, v in self.fired.items()},
        }

    def load_state_dict(self, saved: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        super().load_state_dict(saved)
        for own, values in (
            (self._time_left, saved["time_left"]),
            (self._last_step, saved["last_step"]),
            (self._fired_once, saved["fired_once"]),
        ):
            for name, value in values.items():
                own[name].copy_(value)
        self.fired = {name: value.clone() for name, value in saved["fired"].items()}

    def _all_ids(self, env_ids: torch.Tensor | None) -> torch.Tensor:
        return torch.arange(self._num_envs, device=self._env.device) if env_ids is None else env_ids

    def _start_timer(self, name: str, term: Term) -> None:
        count = 1 if term.fields.get("is_global_time", False) else self._num_envs
        self._time_left[name] = torch.zeros(count, device=self._env.device)
        self._draw_timer(name, term, torch.arange(count, device=self._env.device))

    def _draw_timer(self, name: str, term: Term, ids: torch.Tensor) -> None:
        low, high = term.fields["interval_range_s"]
        generator = self._env.streams.get(f"{term.path}.interval")
        self._time_left[name][ids] = low + (high - low) * torch.rand(
            ids.shape[0], generator=generator, device=ids.device
        )

    def _start_counter(self, name: str) -> None:
        self._last_step[name] = torch.zeros(self._num_envs, dtype=torch.long, device=self._env.device)
        self._fired_once[name] = torch.zeros(self._num_envs, dtype=torch.bool, device=self._env.device)

    def _due(self, name: str, term: Term, ids: torch.Tensor, step: int) -> torch.Tensor:
        """Return the environments of ``ids`` for which enough steps have passed since the term last ran."""
        wait = term.fields.get("min_step_count_between_reset", 0)
        if wait == 0:
            return ids
        last, once = self._last_step[name], self._fired_once[name]
        ids = ids[(step - last[ids] >= wait) | ~once[ids]]
        last[ids] = step
        once[ids] = True
        return ids

    def __str__(self) -> str:
        rows = [
            (mode, name, term.fields.get("interval_range_s", "-"), term.target.rsplit(".", 1)[-1])
            for mode, terms in self._modes.items()
            for name, term in terms.items()
        ]
        return table(f"Events: {len(rows)}", ("mode", "name", "interval (s)", "term"), rows)
