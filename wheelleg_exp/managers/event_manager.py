"""Events: randomisation and disturbances, by the time at which they run."""

from __future__ import annotations

import warnings

import torch

from wheelleg_exp.constraints import Terms
from wheelleg_exp.errors import nearest_name
from wheelleg_exp.managers.manager_base import ManagerBase, Term, instantiate_term, table
from wheelleg_exp.managers.non_finite import require_finite_writes
from wheelleg_exp.managers.return_checks import NoForm
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.sim.ids import ids_where
from wheelleg_exp.sim.timers import may_be_due
from wheelleg_exp.terms.term_binding import EVENT_MODES


class EventManager(ManagerBase):
    """Runs event terms by mode (``prestartup``, ``startup``, ``reset``, ``interval``, ``step``, or user-defined modes).

    The event manager is built before the scene is compiled, so that ``prestartup`` terms can edit ``env.scene.spec``.
    """

    kind = "events"

    def __init__(self, nodes: Terms, env: Env) -> None:
        super().__init__(nodes, env, instantiate=False)
        self._modes: dict[str, dict[str, Term]] = {}
        self._time_left: dict[str, torch.Tensor] = self.buffer("_time_left", {})
        self._last_step: dict[str, torch.Tensor] = self.buffer("_last_step", {})
        self._fired_once: dict[str, torch.Tensor] = self.buffer("_fired_once", {})
        self.fired: dict[str, torch.Tensor] = self.buffer("fired", {})
        self._realistic = {*env.options.realism.events} if env.exact_envs else set()
        # the model fields that each event term has asked for, in order to write to them
        self._written_fields: dict[str, set[str]] = {name: set() for name in self._terms}
        for name, term in self._terms.items():
            mode = term.fields["mode"]
            term.form = NoForm()
            self._modes.setdefault(mode, {})[name] = term
            if mode == "prestartup":
                instantiate_term(term, env)
            if mode == "interval":
                count = 1 if term.fields.get("is_global_time", False) else self._num_envs
                self._time_left[name] = torch.zeros(count, device=env.device)
                self._draw_timer(name, term, torch.arange(count, device=env.device))
            elif mode == "reset":
                self._last_step[name] = torch.zeros(self._num_envs, dtype=torch.long, device=env.device)
                self._fired_once[name] = torch.zeros(self._num_envs, dtype=torch.bool, device=env.device)

    def play(self) -> None:
        """Create the objects of event terms after the simulation has been built."""
        for name, term in self._terms.items():
            instantiate_term(term, self._env)
            self._note_written_fields(name)

    @property
    def active_terms(self) -> dict[str, list[str]]:  # type: ignore[override]  # Isaac Lab's return type
        """Names of the event terms by mode, in the order of the config."""
        return {mode: list(terms) for mode, terms in self._modes.items()}

    @property
    def available_modes(self) -> list[str]:
        """Modes of the terms."""
        return list(self._modes)

    def apply(
        self,
        mode: str,
        env_ids: torch.Tensor | None = None,
        global_env_step_count: int | None = None,
        with_errors: torch.Tensor | None = None,
    ) -> None:
        """Run the events of ``prestartup``, ``startup``, ``reset``, or a user-defined mode in some or all environments.

        Events of the mode ``reset`` need ``global_env_step_count``, the environment's number of control steps so far. A
        user-defined event mode without event terms causes a warning. If some robots are exact, the events of
        ``env.realism`` run only in the environments ``with_errors``.
        """
        if mode == "interval":
            message = "apply() cannot run events of the mode 'interval', which step() runs when their timers expire"
            raise ValueError(message)
        if mode not in (*EVENT_MODES, *self._modes):
            nearest = nearest_name(mode, self._modes)
            hint = f"; did you mean '{nearest}'?" if nearest else ""
            warnings.warn(f"no event has the mode '{mode}'{hint}", stacklevel=2)
        for name, term in self._modes.get(mode, {}).items():
            ids = env_ids if with_errors is None or name not in self._realistic else with_errors
            if mode == "reset":
                if global_env_step_count is None:
                    raise ValueError("reset events need global_env_step_count")
                ids = torch.arange(self._num_envs, device=self._env.device) if ids is None else ids
                ids = self._due(name, term, ids, global_env_step_count)
            if ids is not None and not len(ids):
                continue
            if mode == "prestartup":  # ``prestartup`` events run before the simulation is built.
                term(self._env, ids)
            else:
                self._run(name, term, ids)

    def advance_timers(self, dt: float) -> None:
        """Subtract ``dt`` seconds from the event timers, and store masks of expired timers in ``fired``."""
        for name in self._modes.get("interval", {}):
            time_left = self._time_left[name]
            time_left -= dt
            self.fired[name] = time_left < 1e-6

    def apply_due(self, dt: float) -> bool:
        """Run the events with expired timers and those of mode ``step`` in a step of ``dt`` s; return if any ran."""
        ran = False
        for name, term in self._modes.get("interval", {}).items():
            if not may_be_due(self._time_left[name], float(term.fields["interval_range_s"][0]), dt):
                continue
            ids = ids_where(self.fired[name])
            if not len(ids):
                continue
            # If ``is_global_time`` is True, all environments share one timer, and ``ids`` is only [0].
            self._draw_timer(name, term, ids)
            self._run(name, term, None if term.fields.get("is_global_time", False) else ids)
            ran = True
        for name, term in self._modes.get("step", {}).items():
            self._run(name, term, None)
            ran = True
        return ran

    def _run(self, name: str, term: Term, ids: torch.Tensor | None) -> None:
        term(self._env, ids)
        self._env.scene.robot.data.invalidate()  # Clear cached robot data, because an event can change the robot.
        self._note_written_fields(name)
        require_finite_writes(self._env, term.path, self._written_fields[name], ids)

    def _note_written_fields(self, name: str) -> None:
        asked = self._env.scene.sim.asked
        if asked:
            self._written_fields[name] |= asked
            asked.clear()

    def reset(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Draw new event timers for ``env_ids``, and reset all event terms except ``prestartup`` terms."""
        for name, term in self._modes.get("interval", {}).items():
            if not term.fields.get("is_global_time", False):
                self._draw_timer(name, term, env_ids)
        self._reset_terms(env_ids, but=self._modes.get("prestartup", {}))
        return {}

    def _draw_timer(self, name: str, term: Term, ids: torch.Tensor) -> None:
        low, high = term.fields["interval_range_s"]
        generator = self._env.streams.get(f"{term.path}.interval")
        drawn = torch.rand(ids.shape[0], generator=generator, device=ids.device)
        self._time_left[name][ids] = low + (high - low) * drawn

    def _due(self, name: str, term: Term, ids: torch.Tensor, step: int) -> torch.Tensor:
        wait = term.fields.get("min_step_count_between_reset", 0)
        if wait == 0:
            return ids
        last, once = self._last_step[name], self._fired_once[name]
        ids = ids[(step - last[ids] >= wait) | ~once[ids]]
        last[ids] = step
        once[ids] = True
        return ids

    def __str__(self) -> str:
        terms = [(mode, name, term) for mode, terms in self._modes.items() for name, term in terms.items()]
        last = [(t.fields.get("interval_range_s", "-"), t.target.rsplit(".", 1)[-1]) for _, _, t in terms]
        rows = [(mode, name, *cells) for (mode, name, _), cells in zip(terms, last, strict=True)]
        return table(f"Events: {len(rows)}", ("mode", "name", "interval (s)", "term"), rows)
