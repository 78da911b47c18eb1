import pytest

from wheelleg_exp import progress
from wheelleg_exp.cli.printing import progress_display as module
from wheelleg_exp.cli.printing.progress_display import ConsoleDisplay


def work():
    assert list(progress.with_progress("making tiles", ["a", "b", "c"])) == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("every_s", "shown"), [(0.0, ["making tiles 1/3", "making tiles 2/3", "making tiles 3/3"]), (9.0, [])]
)
def test_plain_lines_come_only_when_work_takes_long(monkeypatch, capsys, every_s, shown):
    monkeypatch.setattr(module, "PLAIN_EVERY_S", every_s)
    with ConsoleDisplay():
        work()
    work()  # nobody listens any more
    assert capsys.readouterr().err.splitlines() == shown


def test_a_live_line_is_gone_when_the_work_is_done(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TTY_INTERACTIVE", "1")
    with ConsoleDisplay() as display:
        work()
        display.steps(1, 2)
        assert [task.description for task in display._progress.tasks] == ["playing"]
    capsys.readouterr()
