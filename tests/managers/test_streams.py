"""Random streams by name."""

import torch

from wheelleg_exp.managers.streams import Streams, stream_seed


def _draws(streams, path, count=4):
    return torch.rand(count, generator=streams.get(path)).tolist()


def test_a_stream_is_given_by_seed_and_path():
    assert _draws(Streams(3), "a") == _draws(Streams(3), "a")
    assert _draws(Streams(3), "a") != _draws(Streams(4), "a")
    assert _draws(Streams(3), "a") != _draws(Streams(3), "b")
    busy = Streams(3)
    _draws(busy, "b", 100)
    assert _draws(busy, "a") == _draws(Streams(3), "a")


def test_seeds_fit_the_generator_and_do_not_collide():
    seeds = {stream_seed(s, f"path{k}") for s in range(50) for k in range(50)}
    assert len(seeds) == 2500
    assert all(0 <= s < 2**63 for s in seeds)
    assert stream_seed(1, "1/x") != stream_seed(11, "x")


def test_reseeding_restarts_every_stream():
    streams = Streams(1)
    first = _draws(streams, "a")
    streams.reseed(2)
    other = _draws(streams, "a")
    streams.reseed(1)
    assert _draws(streams, "a") == first
    assert other != first
    assert _draws(streams, "late") == _draws(Streams(1), "late")


def test_saved_streams_continue_where_they_were():
    streams = Streams(1)
    _draws(streams, "a", 7)
    saved = streams.state_dict()
    expected = _draws(streams, "a"), _draws(streams, "late")
    other = Streams(99)
    other.load_state_dict(saved)
    assert (_draws(other, "a"), _draws(other, "late")) == expected
