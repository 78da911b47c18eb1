"""A tape of torch operations replaces a CUDA graph, so that graph capture can be tested without a GPU."""

from __future__ import annotations

from types import SimpleNamespace
from unittest import mock

import torch
from sim.small_envs import ASSETS
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from env.composed import composed
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.graph_capture import CapturedPart, GraphCapture
from wheelleg_exp.sim.batch_engine import BatchEngine
from wheelleg_exp.state import Stateful, register_undeclared

# A CUDA graph cannot record these operations, because they copy numbers between host and GPU.
WAITS = ("_local_scalar_dense", "nonzero", "lift_fresh")


class Tape(TorchDispatchMode):
    def __init__(self, streams=()) -> None:
        super().__init__()
        self.notes: list = []
        self.is_new = True

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        if operation.__name__.split(".")[0] in WAITS:
            raise RuntimeError("operation not permitted when stream is capturing")
        result = operation(*args, **(kwargs or {}))
        self.notes.append((operation, args, kwargs or {}, result))
        return result

    def record(self, work):
        with self:
            work()

    def replay(self):
        if self.is_new:  # Recording a tape already runs its operations; recording a CUDA graph runs no kernel.
            self.is_new = False
            return
        for operation, args, kwargs, result in self.notes:
            again = operation(*args, **kwargs)
            for old, new in zip(tree_flatten(result)[0], tree_flatten(again)[0], strict=True):
                if isinstance(old, torch.Tensor) and old.numel() and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


def make_env(task: str = "stand", *overrides: str, captured: bool = False) -> ManagerBasedRLEnv:
    """Return a reset environment with 16 simulations and short episodes; ``captured``: with tapes for graphs."""
    words = [f"task={task}", "env.num_envs=16", "env.sim.nthread=1", "env.episode_length_s=0.5", *overrides]
    with (
        mock.patch.object(BatchEngine, "is_captured", captured),
        mock.patch("wheelleg_exp.env.env.GraphCapture", lambda env: GraphCapture(env, Tape)),
    ):
        env = ManagerBasedRLEnv(composed(*words).config["env"], ASSETS / "legged.xml", 0)
    env._ended.answers_late = captured
    env.reset(seed=0)
    return env


class OneTermEnv(Stateful):
    """What a graph capture needs of an environment, for one term."""

    def __init__(self, term) -> None:
        self.observation_manager, self.curriculum_manager = SimpleNamespace(), None
        self.reset_order = [None]
        self.streams = SimpleNamespace(all=list)
        data = SimpleNamespace(invalidate=lambda: None)
        self.scene = SimpleNamespace(robot=SimpleNamespace(data=data))
        self.child("term", term)


def make_part(work, term, *, make_graph=Tape):
    """Return a captured part of a term, and a function that compares the settings and then runs the part."""
    register_undeclared(term)
    capture = GraphCapture(OneTermEnv(term), make_graph)
    part = CapturedPart(capture, work)

    def run(*args):
        capture.is_checked = False
        return part(*args)

    return part, run
