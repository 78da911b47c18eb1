"""Masks come to the host, and numbers that are none are noticed, on a GPU as on a CPU."""

from __future__ import annotations

import math

import pytest
import torch

from wheelleg_exp.managers.asking import ask, is_finite


@pytest.mark.parametrize("at_once", [True, False])
def test_where_masks_hold_is_told_at_once_or_late(device, at_once):
    gen = torch.Generator().manual_seed(1)
    for _ in range(3):  # the memory is used again
        outer, inner, also = (torch.rand(3, 50, generator=gen) < torch.tensor([[0.3], [0.2], [0.1]])).to(device)
        inner &= outer
        asked = ask(outer, inner)
        found, broken = asked.ids(also, at_once=at_once)
        late = asked.late()
        assert {t.device.type for t in (found, broken, late)} == {torch.device(device).type}
        if at_once or not outer.is_cuda:
            assert late.tolist() == []
            outer, inner = outer | also, inner | also
        else:
            assert late.tolist() == [i for i, holds in enumerate(also.tolist()) if holds]
        assert found.tolist() == [i for i, holds in enumerate(outer.tolist()) if holds]
        assert broken.tolist() == [i for i, holds in enumerate(inner.tolist()) if holds]


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_none_is_noticed_and_those_after_it_are_numbers_again(device, number):
    def look(value: float) -> bool:
        torch.cuda.synchronize() if device.startswith("cuda") else None
        return is_finite(torch.tensor(value, device=device))

    found = [look(1e30) for _ in range(40)]
    assert all(found)
    assert not all([look(number) for _ in range(40)])
    assert all([look(0.0) for _ in range(600)][300:])
