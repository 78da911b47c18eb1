"""Masks come to the host, and numbers that are none are noticed, on a GPU as on a CPU."""

from __future__ import annotations

import math

import pytest
import torch

from wheelleg_exp.managers.async_queries import AsyncMaskQuery, is_finite


@pytest.mark.parametrize("at_once", [True, False])
def test_where_masks_hold_is_told_at_once_or_late(device, at_once):
    gen = torch.Generator().manual_seed(1)
    asked = AsyncMaskQuery(50, torch.device(device))
    told = []
    for _ in range(3):  # the memory is used again
        masks = torch.rand(3, 50, generator=gen) < torch.tensor([[0.3], [0.2], [0.1]])
        masks[1] &= masks[0]
        asked.start(masks[0].to(device), masks[1].to(device))
        found = (*asked.ids(masks[2].to(device), at_once=at_once), *asked.late())
        assert {each.device.type for each in found} == {torch.device(device).type}
        outer, inner, also = (set(mask.nonzero().flatten().tolist()) for mask in masks)
        expected = (outer | also, inner | also, set(), set()) if at_once else (outer, inner, also - inner, also - outer)
        told.append((found, expected))
    for found, expected in told:
        assert [each.tolist() for each in found] == [sorted(each) for each in expected]


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_none_is_noticed_and_those_after_it_are_numbers_again(device, number):
    def look(value: float) -> bool:
        torch.cuda.synchronize() if device.startswith("cuda") else None
        return is_finite(torch.tensor(value, device=device))

    found = [look(1e30) for _ in range(40)]
    assert all(found)
    assert not all([look(number) for _ in range(40)])
    assert all([look(0.0) for _ in range(600)][300:])
