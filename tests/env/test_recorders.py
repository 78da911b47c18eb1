"""Random numbers that are drawn before a recording is repeated are those that it would draw."""

from __future__ import annotations

import torch

from wheelleg_exp.env.recorders import _Drawn


def test_memory_for_draws_is_filled_with_what_would_have_been_drawn():
    generator, again = torch.Generator().manual_seed(3), torch.Generator().manual_seed(3)
    draws = _Drawn()
    with torch.inference_mode(), draws:
        low = torch.rand(5, 3, generator=generator)
        doubled = torch.rand(2, generator=generator, dtype=torch.float64)
    assert [numbers.shape for numbers, _ in draws.numbers] == [(5, 3), (2,)]
    for _ in range(2):  # replays go on in the streams
        for numbers, stream in draws.numbers:
            numbers.uniform_(generator=stream)
        assert torch.equal(low, torch.rand(5, 3, generator=again))
        assert torch.equal(doubled, torch.rand(2, generator=again, dtype=torch.float64))


def test_what_draws_nothing_is_done_as_it_is():
    draws = _Drawn()
    with draws:
        assert torch.equal(torch.ones(3) + 1.0, torch.full((3,), 2.0))
    assert draws.numbers == []
