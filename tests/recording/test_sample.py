import pytest

from wheelleg_exp.recording.writing.recorded_frames import Sample


def taken(lengths: list[int], enough: int, most: int, dues: tuple[int, ...] = (0,)) -> list[tuple[int, int]]:
    sample, found, before = Sample(), [], None
    rows = [(number, step, step == length) for number, length in enumerate(lengths) for step in range(1, length + 1)]
    for k, (number, step, ends) in enumerate(rows, start=1):
        if k - 1 in dues:
            goes_on = before is not None and bool(found) and found[-1] == before and step > 1
            sample.begin(enough, most, taken=0, is_in_episode=goes_on)
        if sample.takes(step):
            found.append((number, step))
            sample.took(ends=ends)
        before = (number, step)
    return found


def whole(*episodes: tuple[int, int]) -> list[tuple[int, int]]:
    return [(number, step) for number, length in episodes for step in range(1, length + 1)]


def test_it_waits_for_an_episode_to_begin_and_ends_with_one():
    assert taken([5, 4, 3, 9, 2], enough=6, most=99, dues=(2,)) == whole((1, 4), (2, 3))
    assert taken([3, 3], enough=0, most=8) == []


@pytest.mark.parametrize(("enough", "episodes"), [(4, 1), (5, 2), (7, 2), (8, 3)])
def test_no_episode_begins_once_there_are_enough_steps(enough, episodes):
    assert taken([4, 3, 9, 9], enough=enough, most=99) == whole((0, 4), (1, 3), (2, 9))[: [0, 4, 7, 16][episodes]]


def test_an_endless_episode_is_cut_off_and_continued_by_the_next_sample_if_it_reaches_that_far():
    assert taken([30], enough=3, most=8) == whole((0, 8))
    assert taken([30], enough=3, most=8, dues=(0, 5)) == whole((0, 13))
    assert taken([30, 2], enough=2, most=8, dues=(0, 20)) == [*whole((0, 8)), *whole((1, 2))]
