"""Draw random commands, such as target velocities that the robot must follow, and draw new commands at random times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import torch

from wheelleg_exp.constraints import PositiveInterval, Terms
from wheelleg_exp.errors import ConfigError
from wheelleg_exp.managers.manager_base import ManagerBase, Term, TermBase
from wheelleg_exp.managers.return_checks import require_form, row_form
from wheelleg_exp.managers.term_interface import Env
from wheelleg_exp.sim.ids import ids_where
from wheelleg_exp.sim.timers import may_be_due
from wheelleg_exp.terms.term_errors import described


class CommandTerm(TermBase):
    """Base class of command terms, with a resampling timer and metrics of the command's tracking error.

    A metric is the sum of ``tracking error * dt`` over an episode, divided by the longest resampling time.

    Args:
        resampling_time_range: shortest and longest time between two draws, s.
        metric_names: names of the M metrics.
    """

    logs_last_error: ClassVar[bool] = False  # whether a metric is only the tracking error at the end of an episode

    def __init__(
        self, env: Env, resampling_time_range: PositiveInterval, metric_names: Sequence[str], generator: torch.Generator
    ) -> None:
        n, device = env.num_envs, env.device
        self._env = env
        self._generator = generator
        self._time_range = (float(resampling_time_range[0]), float(resampling_time_range[1]))
        self.metric_names = list(metric_names)
        self.metrics = self.buffer("metrics", torch.zeros(len(self.metric_names), n, device=device))
        self.error_sums = self.buffer("error_sums", torch.zeros(len(self.metric_names), n, device=device))
        self.steps = self.buffer("steps", torch.zeros(n, device=device))
        self.time_left = self.buffer("time_left", torch.zeros(n, device=device))
        self.command_counter = self.buffer("command_counter", torch.zeros(n, dtype=torch.long, device=device))
        self.draws = self.number("draws", True, saved=False)  # whether a timer can expire in this control step

    @property
    def command(self) -> torch.Tensor:
        """The current command, (N, k)."""
        raise NotImplementedError

    def errors(self) -> torch.Tensor:
        """Return the command's tracking errors in this control step, (M, N), for M metrics and N environments."""
        raise NotImplementedError

    def draw(self, env_ids: torch.Tensor) -> None:
        """Draw new commands for ``env_ids``."""
        raise NotImplementedError

    def post_process(self) -> None:
        """Compute the present command from the drawn values, for example a yaw rate from a target heading."""

    def compute(self, dt: float) -> torch.Tensor:
        """Update the command's metrics, draw commands whose timer expired, and return the tracking errors."""
        errors = self.errors()
        shape = self.error_sums.shape
        if getattr(errors, "shape", None) != shape:
            expected = f"a tensor of shape {tuple(shape)}, a row for each of {', '.join(self.metric_names)}"
            raise ConfigError(f"errors() returns {described(errors)}", expected=expected)
        self.error_sums += errors
        if self.logs_last_error:
            self.metrics.copy_(errors)
        else:
            self.metrics += errors * (dt / self._time_range[1])
        self.steps += 1
        self.time_left -= dt
        if self.draws:
            expired = ids_where(self.time_left <= 0.0)
            if len(expired):
                self._resample(expired)
        self.post_process()
        return errors

    def load_state_dict(self, saved: Mapping[str, object]) -> None:
        super().load_state_dict(saved)
        self.read_settings()

    def read_settings(self) -> None:
        """Read the command's settings again; change tensors in place, because CUDA graphs read fixed addresses."""

    def may_expire(self, dt: float) -> bool:
        """Return whether any environment's resampling timer may expire within ``dt`` seconds; do not wait for a GPU."""
        return may_be_due(self.time_left, self._time_range[0], dt)

    def finish_episode(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the means of the command's metrics over ``env_ids``, clear the metrics, and draw new commands."""
        steps = self.steps.index_select(0, env_ids).clamp(min=1)
        means = self.metrics.index_select(1, env_ids).mean(dim=1)
        per_step = (self.error_sums.index_select(1, env_ids) / steps).mean(dim=1)
        self.metrics.index_fill_(1, env_ids, 0.0)
        self.error_sums.index_fill_(1, env_ids, 0.0)
        self.steps.index_fill_(0, env_ids, 0.0)
        self.command_counter.index_fill_(0, env_ids, 0)
        self._resample(env_ids)
        log = dict(zip(self.metric_names, means.unbind(), strict=True))
        return log | {f"{n}_per_step": v for n, v in zip(self.metric_names, per_step.unbind(), strict=True)}

    def _resample(self, env_ids: torch.Tensor) -> None:
        low, high = self._time_range
        draw = torch.rand(env_ids.shape[0], generator=self._generator, device=self.time_left.device)
        self.time_left.index_copy_(0, env_ids, low + (high - low) * draw)
        self.draw(env_ids)
        self.command_counter[env_ids] += 1


class CommandManager(ManagerBase):
    """Advances command terms, and logs their metrics; ``step_errors`` has the last tracking errors (M, N) by term."""

    kind = "commands"
    columns = ("shape",)

    def __init__(self, nodes: Terms, env: Env) -> None:
        super().__init__(nodes, env)
        self._command_terms: dict[str, CommandTerm] = {}
        self.step_errors: dict[str, torch.Tensor] = self.buffer("step_errors", {}, saved=False)
        for name, term in self._terms.items():
            if not isinstance(term.func, CommandTerm):
                message = f"'{term.target}' is not the class of a command term"
                raise ConfigError(message, key=term.path, expected="a command term")
            self._command_terms[name] = term.func
            term.form = row_form(self._num_envs, env.device)

    def get_command(self, name: str) -> torch.Tensor:
        """Return the present command of a command term, (N, k)."""
        term = self.get_term_cfg(name)
        with term.blamed():
            command = self._command_terms[name].command
        if term.form is not None:
            require_form(term.form, command, f"the command of '{term.target}'", term.path, term.func)
        return command

    def get_term(self, name: str) -> CommandTerm:
        """Return a command term by name."""
        self.get_term_cfg(name)
        return self._command_terms[name]

    def get_active_iterable_terms(self, env_idx: int) -> list[tuple[str, list[float]]]:
        """Return the commands of one environment by the name of the command term."""
        return [(name, term.command[env_idx].tolist()) for name, term in self._command_terms.items()]

    def read_settings(self) -> None:
        """Re-read the settings of all command terms, because a curriculum may have changed a setting."""
        for name, term in self._command_terms.items():
            with self._terms[name].blamed():
                term.read_settings()

    def may_draw(self, dt: float) -> bool:
        """Return whether a new command may be drawn in the next ``dt`` seconds, without waiting for a GPU."""
        # Build a list, because each term's ``may_expire`` must run, but `any` stops a generator at the first True.
        return any([term.may_expire(dt) for term in self._command_terms.values()])

    def compute(self, dt: float, draws: bool = True) -> None:
        """Advance every command term by a step of ``dt`` seconds; if ``draws`` is False, no timer can expire."""
        for name, term in self._command_terms.items():
            with self._terms[name].blamed():
                term.draws = draws
                self.step_errors[name] = term.compute(dt)

    def reset(self, env_ids: torch.Tensor) -> dict[str, torch.Tensor]:
        """Draw new commands, and return the commands' metrics over the episodes that ended."""
        log = {}
        for name, term in self._command_terms.items():
            with self._terms[name].blamed():
                means = term.finish_episode(env_ids)
            for metric, value in means.items():
                group = "Episode_Metrics" if metric.endswith("_per_step") else "Metrics"
                log[f"{group}/{name}/{metric}"] = value
        return log

    def _cells(self, term: Term) -> tuple[object, ...]:
        return (tuple(self._command_terms[term.name].command.shape[1:]),)
