"""A recorded step does what the step itself does, to the bit; a tape of operations stands in for a CUDA graph."""

from __future__ import annotations

import pytest
import torch
from sim.small_envs import ASSETS
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.env import ManagerBasedRLEnv
from wheelleg_exp.env.captured import Captured, captured_look, captured_step

WAITS = ("_local_scalar_dense", "nonzero")  # what a graph cannot hold: the host waits for a number


class Tape(TorchDispatchMode):
    """Notes torch's operations and the engine's steps with their memory, and does them again on the same memory."""

    recording: Tape | None = None

    def __init__(self) -> None:
        super().__init__()
        self.notes: list = []
        self.is_new = True

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        assert operation.__name__.split(".")[0] not in WAITS
        result = operation(*args, **(kwargs or {}))
        self.notes.append((operation, args, kwargs or {}, result))
        return result

    def record(self, work):
        Tape.recording = self
        with self:
            work()
        Tape.recording = None

    def replay(self):
        if self.is_new:  # a graph's recording does nothing, the tape's has done it
            self.is_new = False
            return
        for operation, args, kwargs, result in self.notes:
            again = operation(*args, **kwargs)
            for old, new in zip(tree_flatten(result)[0], tree_flatten(again)[0], strict=True):
                if isinstance(old, torch.Tensor) and old.numel() and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


def stand() -> ManagerBasedRLEnv:
    words = ["task=stand", "env.num_envs=16", "env.sim.nthread=1", "env.episode_length_s=0.5"]
    env = ManagerBasedRLEnv(compose(words).config["env"], ASSETS / "legged.xml", 0)
    env.reset(seed=0)
    return env


def recorded(env: ManagerBasedRLEnv) -> ManagerBasedRLEnv:
    """Let an environment's step be taped as a GPU's would be captured."""
    step = env.scene.sim.step

    def noted() -> None:
        step()
        if Tape.recording is not None:
            Tape.recording.notes.append((lambda: step(), (), {}, None))

    env.scene.sim.step = noted
    env._captured = captured_step(env)
    env._captured_look = captured_look(env)
    env._captured._recorder = env._captured_look._recorder = Tape
    return env


def test_a_recorded_step_is_the_step_to_the_bit_through_resets_and_a_changed_weight():
    plain, taped = stand(), recorded(stand())
    gen = torch.Generator().manual_seed(1)
    ended = 0
    for index in range(60):
        action = 0.4 * torch.randn(16, plain.action_manager.total_action_dim, generator=gen)
        if index == 40:
            for env in (plain, taped):
                env.reward_manager.get_term_cfg("alive").weight = 3.0
        ours, theirs = taped.step(action), plain.step(action)
        assert torch.equal(ours[0]["critic"], theirs[0]["critic"])
        assert torch.equal(ours[1], theirs[1])
        assert torch.equal(ours[2], theirs[2])
        assert torch.equal(taped.scene.sim.state, plain.scene.sim.state)
        assert taped.common_step_counter == plain.common_step_counter
        ended += int((theirs[2] | theirs[3]).sum())
    assert ended > 16
    assert 1 <= len(taped._captured._variants) <= 6
    assert 1 <= len(taped._captured_look._variants) <= 6


class Counts:
    """Something that counts its steps."""

    __module__ = "wheelleg_exp.fake"

    def __init__(self) -> None:
        self.count = 0

    def work(self) -> None:
        self.count += 1


def test_what_counts_is_refused():
    counts = Counts()
    with pytest.raises(TypeError, match=r"Counts\.count counts, which a recording cannot"):
        Captured(counts.work, [counts], Tape, lambda: None)()
