"""Check that the return value of a term has the required form.

The first return value of a term is checked for type, shape, and device; later ones only for their shape.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.terms.term_errors import code_place, described


class Form(Protocol):
    """The requirements for a term's return value, such as type, shape, and device."""

    def check(self, value: object, source: str) -> None:
        """Raise ConfigError if a term's return value is invalid; the message names the function ``source``."""


def require_form(form: Form, value: object, source: str, path: str, code: object) -> None:
    """Raise ConfigError (key ``path``, line of ``code``) unless ``value``, which ``source`` returned, fits ``form``."""
    try:
        form.check(value, source)
    except ConfigError as error:
        raise ConfigError(error.message, key=path, where=code_place(code), expected=error.expected) from None


@dataclass
class TensorForm:
    """Requires that a term returns a tensor with one row for each environment."""

    rows: int  # number of environments, N
    device: torch.device
    dtype: torch.dtype | None = None  # type of the elements; None allows any real type
    width: int | None = None  # None for the shape (N,), 0 for (N, width) with any constant width
    what: str = "number"  # description of one row
    deep: bool = False  # whether a row may have further dimensions, as images do
    _shape: torch.Size | None = field(default=None, init=False)

    @property
    def is_known(self) -> bool:
        """Whether the term has already returned a valid tensor; all later tensors must have the same shape."""
        return self._shape is not None

    def check(self, value: object, source: str) -> None:
        if self._shape is not None and getattr(value, "shape", None) == self._shape:
            return
        found, fix = self._mistake(value)
        if found or not isinstance(value, torch.Tensor):
            shape = f"({self.rows},)" if self.width is None else f"({self.rows}, {self.width or 'width'})"
            kind = "real" if self.dtype is None else _dtype_name(self.dtype)
            expected = f"a {kind} tensor of shape {shape}, a {self.what} for each environment"
            raise ConfigError(f"{source} returns {found}", expected=expected + (f": {fix}" if fix else ""))
        self._shape = value.shape

    def _mistake(self, value: object) -> tuple[str, str]:
        if not isinstance(value, torch.Tensor):
            if value is None:
                return "nothing", "a return statement may be missing"
            if isinstance(value, np.ndarray):
                return "a numpy array", "torch.from_numpy(value)"
            if isinstance(value, (bool, int, float, np.generic)):
                return described(value), "torch.full((env.num_envs,), value)"
            return described(value), "torch.tensor(value)" if isinstance(value, list) else ""
        shape = value.shape
        if self.width is None:
            has_shape = shape == (self.rows,)
        else:
            has_shape = len(shape) >= 2 if self.deep else len(shape) == 2
            has_shape = has_shape and shape[0] == self.rows and min(shape[1:]) >= 1 and self.width in (0, shape[-1])
        if not has_shape or (self._shape is not None and value.shape != self._shape):
            before = "" if self._shape is None else f", and {tuple(self._shape)} before"
            return f"shape {tuple(value.shape)}{before}", self._reshaped(value.shape)
        if value.device != self.device:
            return f"a tensor on {value.device}", f"value.to('{self.device}')"
        if value.dtype.is_complex or (self.dtype is not None and value.dtype != self.dtype):
            fix = "a comparison, such as value > limit" if self.dtype == torch.bool else "value.float()"
            return f"{_dtype_name(value.dtype)} numbers", "value.real" if value.dtype.is_complex else fix
        return ("a tensor that keeps its gradient", "value.detach()") if value.requires_grad else ("", "")

    def _reshaped(self, shape: torch.Size) -> str:
        if self._shape is not None:
            return "the same shape at every call"
        if self.width is None:
            return {(self.rows, 1): "value.squeeze(1)", (): "value.expand(env.num_envs)"}.get(tuple(shape), "")
        if shape == (self.rows,):
            return "value.unsqueeze(1)"
        return "value.flatten(1)" if len(shape) > 2 and shape[0] == self.rows else ""


def row_form(rows: int, device: torch.device, *, deep: bool = False) -> TensorForm:
    """Return the form of observations and commands: (N, width), or (N, ..., width) with ``deep``."""
    return TensorForm(rows, device, torch.get_default_dtype(), width=0, what="row of numbers", deep=deep)


class NoForm:
    """Requires that a term returns None, as event terms do."""

    def check(self, value: object, source: str) -> None:
        if value is not None:
            message = f"{source} returns {described(value)}, but must return nothing"
            raise ConfigError(message, expected="no return value")


class FiguresForm:
    """The form of the state that a curriculum logs: a number, numbers by name, or None."""

    def check(self, value: object, source: str) -> None:
        figures = value.values() if isinstance(value, Mapping) else [value]
        wrong = next((figure for figure in figures if figure is not None and not _is_number(figure)), None)
        if wrong is not None:
            inside = " in a mapping" if isinstance(value, Mapping) else ""
            expected = "a number, numbers by name, or None, such as {'level': float(levels.mean())}"
            raise ConfigError(f"{source} returns {described(wrong)}{inside}", expected=expected)


def _is_number(value: object) -> bool:
    if isinstance(value, (torch.Tensor, np.ndarray)):
        return math.prod(value.shape) == 1
    return isinstance(value, (int, float, np.generic)) and not isinstance(value, np.str_)


def _dtype_name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
