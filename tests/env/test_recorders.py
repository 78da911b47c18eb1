"""What a CUDA graph does when what it records fails, with torch's part of it played."""

from __future__ import annotations

import pytest
import torch

from wheelleg_exp.env.recorders import CudaGraph
from wheelleg_exp.errors import SimulationFailure


class Capture:
    """As ``torch.cuda.graph``: a capture in which something failed fails at its end, and leaves its own stream."""

    streams: list[str]

    def __init__(self, graph, pool=None, capture_error_mode="") -> None:
        pass

    def __enter__(self) -> None:
        self.streams.append("the capture's")

    def __exit__(self, kind, error, trace) -> None:
        if kind is not None:
            raise RuntimeError("CUDA error: operation failed due to a previous error during capture")
        self.streams.pop()


@pytest.fixture
def streams(monkeypatch):
    used = ["the step's"]
    monkeypatch.setattr(Capture, "streams", used, raising=False)
    monkeypatch.setattr(torch.cuda, "graph", Capture)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: None)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda: used[-1])
    monkeypatch.setattr(torch.cuda, "set_stream", used.append)
    monkeypatch.setattr(torch, "zeros", lambda *sizes, device: None)
    return used


def test_work_that_fails_is_told_by_its_own_error_with_its_cause_and_leaves_the_stream(streams):
    def work() -> None:
        try:
            raise RuntimeError("operation not permitted when stream is capturing")
        except RuntimeError as error:
            raise SimulationFailure("'mine.asks' raises RuntimeError", key="env.rewards.asks") from error

    with pytest.raises(SimulationFailure, match=r"env\.rewards\.asks: 'mine\.asks' raises") as told:
        CudaGraph([]).record(work)
    assert "not permitted" in str(told.value.__cause__)
    assert streams[-1] == "the step's"


def test_work_that_is_recorded_leaves_the_stream(streams):
    done = []
    CudaGraph([]).record(lambda: done.append(streams[-1]))
    assert done == ["the capture's"]
    assert streams[-1] == "the step's"
