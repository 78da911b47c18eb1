"""What is compiled does what its operations do: writes through views, draws, masks, ids and types of numbers."""

from __future__ import annotations

import os

import pytest
import torch

from wheelleg_exp.env import fused
from wheelleg_exp.env.fused import Fused
from wheelleg_exp.env.recorders import CudaGraph
from wheelleg_exp.env.tape import Tape, Value
from wheelleg_exp.sim.warp.launches import launched

N = 8
DEVICE = os.environ.get("WHEELLEG_TEST_DEVICE", "cpu")


class Calls:
    """Does recorded work again: what a CUDA graph does on a GPU."""

    def __init__(self, generators=()) -> None:
        del generators

    def record(self, work) -> None:
        self._work = work

    def replay(self) -> None:
        self._work()


class Part:
    """Something like a step: it writes through views of one memory, draws, counts, and lets attributes hold others."""

    def __init__(self) -> None:
        gen = torch.Generator().manual_seed(3)
        self.draws = torch.Generator(DEVICE).manual_seed(1)
        self.state = torch.randn(N, 6, generator=gen).to(DEVICE)
        self.pos, self.vel = self.state[:, :3], self.state[:, 3:]
        self.count = torch.zeros(N, dtype=torch.long, device=DEVICE)
        self.sums, self.last = torch.zeros(4, N, device=DEVICE), torch.ones(N, 3, device=DEVICE)
        self.before = torch.zeros_like(self.last)
        self.ids = torch.tensor([1, 4, 5], device=DEVICE)
        self.flags = torch.zeros(N, dtype=torch.bool, device=DEVICE)
        self.turn = 2 * torch.eye(3, device=DEVICE)
        self.held = self.state

    def work(self) -> tuple[torch.Tensor, ...]:
        self.pos[self.ids] = torch.rand(3, 3, generator=self.draws, device=DEVICE) * 2 - 1
        self.vel.mul_(0.5).add_(self.pos, alpha=0.1)
        self.state[:, 4] = self.state.sum(dim=1)
        self.count += 1
        self.count.index_fill_(0, self.ids, 0)
        self.sums[1] += self.state.abs().sum(1)
        torch.mul(self.sums, 0.9, out=self.sums)
        self.flags |= self.state[:, 0] > 0.5
        self.state.masked_fill_(self.flags.unsqueeze(1), 0.25)
        turned = (self.pos @ self.turn).double()
        turned.masked_fill_(self.flags.unsqueeze(1), 1.0)
        older = self.last.clone()  # a copy of what is written before the copy is
        self.last.copy_(turned)
        self.before.copy_(older)
        self.held = torch.cat((self.pos, torch.rand(N, 1, generator=self.draws, device=DEVICE)), dim=1)
        first, second = self.held.unbind(1)[:2]
        return turned.float(), self.state, self.held[:, 1], first + second, self.count.float()

    def all(self) -> list[torch.Tensor]:
        return [self.state, self.count, self.sums, self.before, self.last, self.flags, self.held]


def followed(part: Part, steps: int = 4) -> Fused:
    """Record a part and hold what it does, step by step, against the same part that does it by itself."""
    twin, found = Part(), []
    recorder = Fused([part.draws], Calls if DEVICE == "cpu" else CudaGraph)
    recorder.record(lambda: found.append(part.work()))
    for _ in range(steps):
        wanted = twin.work()
        recorder.replay()
        for ours, theirs in zip((*found[0], *part.all()), (*wanted, *twin.all()), strict=True):
            torch.testing.assert_close(ours, theirs)
    return recorder


@pytest.mark.filterwarnings("error:a part of the step")
def test_a_compiled_part_does_what_the_part_does(monkeypatch):
    """On a GPU by its kernels; on a CPU, whose compiler takes a minute, by what kernels would be made of."""
    if DEVICE == "cpu":
        monkeypatch.setattr(fused, "_compile", functional)
    followed(Part())


def functional(module, inputs):
    from torch._inductor.compile_fx import compile_fx

    return compile_fx(module, inputs, inner_compile=lambda graph, *rest, **others: graph)


def test_what_comes_out_otherwise_is_not_used_and_told(monkeypatch):
    def wrong(self):
        return lambda: self._tensors[0].fill_(7)

    monkeypatch.setattr(fused._Plain, "compiled", wrong)
    with pytest.warns(UserWarning, match="not fused, but a plain graph: .* comes out otherwise"):
        followed(Part())


def test_what_cannot_be_compiled_is_a_plain_graph(monkeypatch):
    def broken(self):
        raise ModuleNotFoundError("No module named 'triton'")

    monkeypatch.setattr(fused._Plain, "compiled", broken)
    with pytest.warns(UserWarning, match="plain graph: No module named 'triton'"):
        followed(Part())


def test_work_that_waits_for_the_device_is_refused_and_has_done_nothing():
    part, twin = Part(), Part()

    def work() -> None:
        part.work()
        float(part.state.sum())

    with pytest.raises(RuntimeError, match="waits for the device"):
        Fused([part.draws], Calls).record(work)
    for ours, theirs in zip(part.all()[:-1], twin.all()[:-1], strict=True):
        assert torch.equal(ours, theirs)
    assert torch.equal(part.draws.get_state(), twin.draws.get_state())


def test_draws_come_first_and_memory_that_is_written_through_two_views_is_cut():
    part, tape = Part(), Tape()
    tape.record(part.work)
    pieces = tape.pieces()
    assert [piece.alone for piece in pieces] == [True, True, False, False, False]
    assert [str(op.call) for op in (pieces[3].operations[0], pieces[4].operations[0])] == [
        "aten.sum.dim_IntList",
        "aten.mm.default",
    ]


def test_a_launch_is_done_again_between_what_it_reads_and_what_reads_it(monkeypatch):
    monkeypatch.setattr(fused._Plain, "compiled", lambda self: self)
    given, far = torch.arange(3.0), torch.zeros(3)
    found = []

    def work() -> None:
        doubled = given * 2
        launch = lambda: far.copy_(doubled + 1)  # noqa: E731
        with torch.utils._python_dispatch._disable_current_modes():
            launch()
        launched(launch, (doubled,))
        found.append(far * 10)

    recorder = Fused((), Calls)
    recorder.record(work)
    given += 1
    recorder.replay()
    recorder.replay()
    assert found[0].tolist() == [30.0, 50.0, 70.0]


@pytest.mark.parametrize(
    ("one", "other", "meets"),
    [
        (lambda x: x[:, :2], lambda x: x[:, 2:], False),
        (lambda x: x[:, :3], lambda x: x[:, 2:], True),
        (lambda x: x[:2], lambda x: x[2:], False),
        (lambda x: x[1:3, :2], lambda x: x[2:, 2:], False),
        (lambda x: x[1:3, 1:3], lambda x: x[2:, 2:], True),
        (lambda x: x, lambda x: x[3], True),
        (lambda x: x.T, lambda x: x[:, 1:], True),
        (lambda x: x[:0], lambda x: x, False),
    ],
)
def test_memory_meets_where_an_element_is_shared(one, other, meets):
    whole = torch.zeros(4, 5)
    first, second = one(whole), other(whole)
    assert Value.of(first).may_meet(Value.of(second)) is meets
    assert Value.of(second).may_meet(Value.of(first)) is meets
