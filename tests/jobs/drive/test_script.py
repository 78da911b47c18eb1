"""Scripts of drives: what is asked for at which control step, and mistakes with their line."""

import pytest

from wheelleg_exp.errors import ConfigError, RunDirectoryError
from wheelleg_exp.jobs.drive.drive_script import Axis, Controls, Jump, Push, Reset, ScriptPlayer, read_script

AXES = [Axis("lin_vel_x", "base_velocity", "lin_vel_x", -0.3, 0.3), Axis("height", "pose", "height", 0.06, 0.08)]

SCRIPT = """\
- {for: 0.5}
- {for: 1.0, lin_vel_x: 0.3}
- at: 1.0
  height: 0.08
  push: 0.2
- {at: 2.0, stop: true, lin_vel_x: -0.1, push: [0.1, -0.2], reset: true, jump: true, for: 0.25}
"""


@pytest.fixture
def script(tmp_path):
    def write(text):
        path = tmp_path / "script.yaml"
        path.write_text(text)
        return path

    return write


def test_entries_begin_at_their_moment_or_where_the_one_before_ends(script):
    read = read_script(script(SCRIPT), AXES)
    assert ([entry.at for entry in read.entries], read.duration_s) == ([0.0, 0.5, 1.0, 2.0], 2.25)
    assert read.entries[3].requests == [Reset(), Jump(), Push(0.1, -0.2)]
    assert read.entries[2].requests == [Push(0.2, 0.0)]


def test_each_step_is_done_under_what_is_due_before_it(script):
    controls = Controls(AXES)
    hand = ScriptPlayer(read_script(script(SCRIPT), AXES), controls, 0.1)
    seen, requests = [], {}
    for step in range(hand.last_step):
        hand.before(step)
        seen.append((controls.values["lin_vel_x"], controls.values["height"]))
        requests |= {step: found} if (found := controls.take()) else {}
    assert (len(seen), seen) == (23, [(0.0, 0.07)] * 5 + [(0.3, 0.07)] * 5 + [(0.3, 0.08)] * 10 + [(-0.1, 0.07)] * 3)
    assert requests == {10: [Push(0.2)], 20: [Reset(), Jump(), Push(0.1, -0.2)]}


def test_a_moment_between_two_steps_waits_for_the_second_and_rounding_counts_for_nothing(script):
    read = read_script(script("- {at: 0.1, lin_vel_x: 0.1}\n- {at: 0.11, lin_vel_x: 0.2, for: 0.1}"), AXES)
    hand = ScriptPlayer(read, Controls(AXES), 1.0 / 60.0)
    controls = hand._controls
    values = []
    for step in range(9):
        hand.before(step)
        values.append(controls.values["lin_vel_x"])
    assert values == [0.0] * 6 + [0.1] + [0.2] * 2  # 0.1 s is step 6, and 0.11 s is after step 6.


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("- {lin_vel_z: 0.2, for: 1}", ["lin_vel_z", ":1", "did you mean 'lin_vel_x'?", "height"]),
        ("- for: 1\n- for: 1\n  lin_vel_x: 0.4", ["lin_vel_x", ":3", "-0.3 to 0.3", "base_velocity.ranges.lin_vel_x"]),
        ("- {lin_vel_x: fast, for: 1}", ["'fast'", "a number"]),
        ("- {lin_vel_x: .nan, for: 1}", ["nan", "a number"]),
        ("- {at: 1}\n- {at: 0.5, for: 1}", ["at", ":2", "at least 1"]),
        ("- {for: soon}", ["for", "'soon'", "seconds"]),
        ("- {for: 1}\n- for: 1\n  push: [1]", [":3", "push", "[1]", "m/s forwards, or [forwards, to the left]"]),
        ("- {reset: 1, for: 1}", ["reset", "true"]),
        ("- {trigger: bumps, for: 1}", ["trigger", "'bumps'", "step or bump"]),
        ("- {lin_vel_x: 0.1}", ["for", "end", ":1"]),
        ("lin_vel_x: 0.1", ["--script", "- {at: 1.0, lin_vel_x: 0.3, for: 2.0}"]),
        ("- {at: 1", ["--script", "not YAML"]),
    ],
)
def test_a_mistake_is_reported_with_its_line(script, text, words):
    with pytest.raises(ConfigError) as told:
        read_script(script(text), AXES)
    assert [word for word in words if word not in str(told.value)] == []
    assert "script.yaml" in str(told.value)


def test_a_task_without_jumps_has_no_jumps_in_its_scripts(script):
    assert read_script(script("- {jump: true, for: 1}"), AXES).entries[0].requests
    with pytest.raises(ConfigError, match="jump: unknown key"):
        read_script(script("- {jump: true, for: 1}"), AXES, missing=["jump"])


def test_a_missing_script_is_reported(tmp_path):
    with pytest.raises(RunDirectoryError, match="nowhere"):
        read_script(tmp_path / "nowhere.yaml", AXES)
