"""Config classes: dataclasses whose defaults can be lists, dictionaries and other configs."""

from __future__ import annotations

import copy
import dataclasses
import inspect
from functools import partial
from typing import Any, TypeVar, dataclass_transform

_Class = TypeVar("_Class")


@dataclass_transform(kw_only_default=True)
def configclass(cls: type[_Class]) -> type[_Class]:
    """Make a keyword-only dataclass; instances get copies of the defaults, and ``MISSING`` marks a required field."""
    annotations = dict(inspect.get_annotations(cls))
    for name, value in list(vars(cls).items()):
        if name.startswith("_") or inspect.isroutine(value) or isinstance(value, (property, dataclasses.Field)):
            continue
        if inspect.isclass(value) and name not in annotations:  # A class inside a config class is no dataclass field.
            continue
        annotations.setdefault(name, Any)
        if value is dataclasses.MISSING:
            delattr(cls, name)
        elif type(value).__hash__ is None:
            setattr(cls, name, dataclasses.field(default_factory=partial(copy.deepcopy, value)))
    cls.__annotations__ = annotations
    return dataclasses.dataclass(kw_only=True)(cls)
