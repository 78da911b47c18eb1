"""Find values that change between steps although nothing declares them, in the first steps of a training."""

from __future__ import annotations

import random
import warnings
from collections import deque
from collections.abc import Iterator

import numpy as np
import torch
from torch.utils._pytree import tree_leaves

from wheelleg_exp.errors import ConfigError
from wheelleg_exp.sim.engine import Engine
from wheelleg_exp.state.stateful import declarations, tree
from wheelleg_exp.state.values import PLAIN, is_own, same, snapshot

# These attributes are not state: the declarations themselves, the arguments from which a term's object was made, the
# robot's list of written rows, which is empty between steps, and the model fields that are checked after events.
_IGNORED = frozenset(("_declared", "_made_with", "_stale", "_written_fields"))
_VALUES = (*PLAIN, torch.Tensor, np.ndarray, np.generic, set, frozenset, deque, random.Random, np.random.Generator)
_OTHER = object()


class UndeclaredChanges:
    """Compares the undeclared attributes of an environment's parts now with those in some later step.

    With ``with_root``, the attributes of the environment itself are compared, too.
    """

    def __init__(self, root: object, *, with_root: bool = False) -> None:
        self._root, self._with_root = root, with_root
        self._before = {(path, name): _copied(value) for path, _, name, value in self._attributes()}

    def changed(self) -> Iterator[tuple[object, str]]:
        """Yield the owner and the name of each undeclared attribute that has changed."""
        return ((owner, name) for _, owner, name in self._changes() if name not in declarations(owner))

    def require_none(self) -> None:
        """Raise ConfigError if an undeclared tensor or plain value has changed; the error names it.

        A value that ``register_undeclared`` has registered causes only a warning, once for each class.
        """
        noted = set[type]()
        for path, owner, name in self._changes():
            call = "buffer" if isinstance(getattr(owner, name), torch.Tensor) else "number"
            kind, expected = type(owner).__qualname__, f'self.{call}("{name}", …) in the constructor'
            if name not in declarations(owner):
                message = f"'{name}' of '{kind}' changes between steps, but is not declared, so no checkpoint saves it"
                raise ConfigError(message, key=path, expected=expected)
            if type(owner) not in noted:
                noted.add(type(owner))
                message = f"{path}: '{name}' of '{kind}' is state that the class does not declare; expected {expected}"
                warnings.warn(f"{message}. The next release will not save undeclared state", stacklevel=2)

    def _changes(self) -> Iterator[tuple[str, object, str]]:
        before = self._before
        found = [one for one in self._attributes() if not same(_copied(one[3]), before.get((one[0], one[2]), _OTHER))]
        owned = set[int]()  # addresses of declared buffers and of the engine's memory, of which attributes may be views
        for _, owner in tree(self._root) if found else ():
            names = vars(owner) if isinstance(owner, Engine) else declarations(owner)
            leaves = tree_leaves([getattr(owner, name) for name in names])
            leaves += tree_leaves([getattr(leaf, "__dict__", {}) for leaf in leaves if is_own(type(leaf))])
            owned |= {leaf.untyped_storage().data_ptr() for leaf in leaves if isinstance(leaf, torch.Tensor)}
        for path, owner, name, value in found:
            if not isinstance(value, torch.Tensor) or value.untyped_storage().data_ptr() not in owned:
                yield path, owner, name

    def _attributes(self) -> Iterator[tuple[str, object, str, object]]:
        """Yield the path of each part, the part, and the name and value of each of its undeclared attributes."""
        for path, owner in tree(self._root):
            # The state dict of a user-defined class saves more than the declared values.
            saves_more = not is_own(getattr(type(owner), "state_dict", UndeclaredChanges))
            if saves_more or isinstance(owner, Engine) or (owner is self._root and not self._with_root):
                continue
            for name, value in list(getattr(owner, "__dict__", {}).items()):
                declared = declarations(owner).get(name)
                if name not in _IGNORED and (declared is None or declared.is_automatic):
                    yield path, owner, name, value


def _copied(value: object) -> object:
    """Copy a value, or a container's items; other objects, and lists and dictionaries in these, count as unchanged."""
    if not isinstance(value, (dict, list, tuple)):
        return snapshot(value) if isinstance(value, _VALUES) else _OTHER
    items = value.values() if isinstance(value, dict) else value
    return [snapshot(item) if isinstance(item, _VALUES) else _OTHER for item in items]
