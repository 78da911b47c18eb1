import time
from datetime import UTC, datetime, timedelta, timezone

import pytest

from wheelleg_exp.run.timestamps import folder_moment, folder_text, parse_utc, utc_text

NOON = datetime(2026, 1, 31, 12, tzinfo=UTC)


@pytest.fixture
def nine_hours_east(monkeypatch):
    monkeypatch.setenv("TZ", "JST-9")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


def test_folders_are_named_in_local_time(nine_hours_east):
    assert (folder_text(NOON), folder_text(datetime(2026, 1, 31, 12))) == ("2026-01-31_21-00-00", "2026-01-31_12-00-00")
    assert folder_moment("2026-01-31_21-00-00_7_name-2") == NOON


@pytest.mark.parametrize("name", ["", "notes", "2026-13-01_00-00-00_1", "x2026-01-31_21-00-00"])
def test_the_name_of_another_folder_has_no_timestamp(name):
    assert folder_moment(name) is None


def test_moments_are_written_in_utc_and_read_back():
    moment = datetime(2026, 1, 31, 14, 0, 0, 120, tzinfo=timezone(timedelta(hours=2)))
    assert (utc_text(moment), parse_utc(utc_text(moment))) == ("2026-01-31T12:00:00.000120Z", moment)
    with pytest.raises(ValueError, match="no time zone"):
        parse_utc("2026-01-31T12:00:00")
