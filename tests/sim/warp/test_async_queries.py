import math

import pytest
import torch

from wheelleg_exp.managers.async_queries import AsyncMaskQuery, is_finite


@pytest.mark.parametrize("at_once", [True, False])
def test_indices_of_masks_come_at_once_or_late(device, at_once):
    gen = torch.Generator().manual_seed(1)
    query = AsyncMaskQuery(50, torch.device(device))
    answers = []
    for _ in range(3):
        masks = torch.rand(3, 50, generator=gen) < torch.tensor([[0.3], [0.2], [0.1]])
        masks[1] &= masks[0]
        query.start(masks[0].to(device), masks[1].to(device))
        found = (*query.ids(masks[2].to(device), at_once=at_once), *query.late())
        assert {each.device.type for each in found} == {torch.device(device).type}
        outer, inner, also = (set(mask.nonzero().flatten().tolist()) for mask in masks)
        is_late = query.answers_late and not at_once
        expected = (outer, inner, also - inner, also - outer) if is_late else (outer | also, inner | also, set(), set())
        answers.append((found, expected))
    for found, expected in answers:
        assert [each.tolist() for each in found] == [sorted(each) for each in expected]


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_value_that_is_not_finite_is_detected_and_later_finite_values_recover(device, number):
    def look(value: float) -> bool:
        torch.cuda.synchronize() if device.startswith("cuda") else None
        return is_finite(torch.tensor(value, device=device))

    found = [look(1e30) for _ in range(40)]
    assert all(found)
    assert not all([look(number) for _ in range(40)])
    assert all([look(0.0) for _ in range(600)][300:])
