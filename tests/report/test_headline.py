"""What stands at the top, from runs whose figures are known."""

from __future__ import annotations

import pytest

from report.runs import add_play, change_manifest, make_run


def test_a_played_policy_is_judged_by_its_play(page, root):
    run = make_run(root, ["agent.max_iterations=3"])
    add_play(run)
    text = page(run).text
    assert (
        "The policy stays up through 6 of 8 episodes of 5 s, 2.1 mm (RMS, after 1 s) off its target height of 70 mm."
        in text
    )
    assert "Survival 75 %" in text
    assert "Base height 72.0 mm mean after 1 s; RMS error 2.1 mm against 70 mm" in text
    assert "Pitch 1.1° RMS after 1 s; mean lean 0.90°" in text
    assert "Iterations 3 in 2 min 30 s" in text


def test_a_play_tells_where_it_strayed_and_what_its_motors_bore(page, root):
    """The motors of the group with the largest torque stand at the top; all groups in the table."""
    run = make_run(root)
    groups = {"torque_rms_nm": {"legs": 0.1, "wheels": 5.8}, "at_limit": {"legs": 0.0, "wheels": 0.25}}
    signs = {"sign_changes_per_s": {"legs": 0.0, "wheels": 10.0}}
    add_play(run, drift_m=0.0123, yaw_drift_deg=1.5, action_rate_per_s=75.0, power_net_w=0.5, **groups, **signs)
    found = page(run)
    assert "Drift 12 mm largest after 1 s, mean of its episodes; turned by 1.5°" in found.text
    assert "Torque 5.8 N·m RMS of the wheels after 1 s; 25 % at the limit; 10 sign changes per s" in found.text
    assert "Power 0.50 W" in found.text
    standing = found.section("standing")
    assert "Torque, RMS, after 1 s (legs) 0.100 N·m 1 500 steps of 7 episodes" in standing
    assert "Strayed from its place, after 1 s 12.3 mm 7 episodes" in standing


def test_a_policy_that_always_falls_is_said_to_fall(page, root):
    run = make_run(root)
    add_play(run, survival=0.0, ended_by={"base_contact": 8})
    assert "The policy falls in every one of 8 episodes of 5 s." in page(run).text


def test_figures_that_there_are_none_of_are_dashes_and_say_why(page, root):
    """As JSON has them: a policy that falls before its episodes settle has neither height nor pitch."""
    run = make_run(root)
    none = dict.fromkeys(("height_rmse_m", "height_mean_m", "pitch_rms_deg", "pitch_mean_deg"), float("nan"))
    add_play(run, survival=0.0, **none, settled_episodes=0, settled_steps=0)
    add_play(run, survival=0.0, **none, settled_episodes=0, settled_steps=0)
    found = page(run)
    assert "nan" not in found.text.split()
    assert "Base height, mean, after 1 s – 0 steps of 0 episodes Pitch, RMS, after 1 s – " in found.section("standing")
    assert "no episode lasted that long" in found.section("standing")


def test_the_last_episode_of_each_environment_counts_once(page, root):
    """Three fell with the time-out; the time-out's own share, which counts them, would be 80 %."""
    run = make_run(root)
    counts = {"time_out": 5, "base_contact": 1, "time_out and base_contact": 3, "none": 1}
    change_manifest(run, last_ended_by=counts)
    found = page(run)
    assert "In 50 % of the environments the last episode ran to the time-out." in found.text


def test_figures_of_a_play_say_of_which_steps_and_episodes_they_are(page, root):
    run = make_run(root)
    add_play(run, unfinished=1, survival=6 / 7, ended_by={"time_out": 6, "base_contact and leg_contact": 1})
    found = page(run).section("standing")
    assert "Base height, mean, after 1 s 72.0 mm 1 500 steps of 7 episodes" in found
    assert "Survived to the time-out 85.7 % 7 ended episodes" in found
    assert "How its 7 ended episodes ended" in found
    assert "base contact and leg contact 1 14.3 %" in found
    assert "Settle" not in found


def test_an_older_play_that_counts_twice_says_so(page, root):
    run = make_run(root)
    add_play(run, ended_by={"time_out": 6, "base_contact": 2, "leg_contact": 2})
    assert "an episode with two terminations counts for both" in page(run).section("standing")


def test_the_last_play_counts_and_all_are_listed(page, root):
    run = make_run(root)
    add_play(run, survival=0.25)
    add_play(run, survival=1.0, overrides=["seed=7"])
    found = page(run)
    assert "through all 8 episodes" in found.text
    assert "All plays" in found.section("standing")
    assert "seed=7" in found.section("standing")


def test_without_a_play_the_training_speaks_and_the_command_is_told(page, root):
    found = page(make_run(root))
    # Two environments in ten ended otherwise in the last iteration; 60 steps of 1/60 s are one second.
    assert "In 80 % of the environments the last episode ran to the time-out." in found.text
    assert "Episode length 1.00 s mean of the last 100 ended episodes, of 5 s at most" in found.text
    assert "wheelleg play" in found.section("standing")


def test_a_failed_run_tells_why(page, root):
    run = make_run(root, status="failed", error=RuntimeError("physics gone to NaN"))
    assert "Training failed after iteration 3 of 110: physics gone to NaN." in page(run).text


def test_an_interrupted_run_can_be_resumed(page, root):
    found = page(make_run(root, status="interrupted", error=KeyboardInterrupt()))
    assert "Training was interrupted after iteration 3 of 110; it can be resumed." in found.text
    assert "Iterations 3 of 110 planned" in found.text


def test_a_running_run_says_how_far_it_is(page, root):
    found = page(make_run(root, status="running"))
    assert "Training is running: iteration 3 of 110 is done." in found.text
    assert "still running" in found.section("trust")


def test_a_run_whose_process_is_gone_has_crashed(page, root):
    run = make_run(root, status="running")
    process = {**run.manifest().data["process"], "boot_id": "another boot"}
    change_manifest(run, process=process)
    found = page(run)
    assert found.text.startswith("crashed")
    assert "The process of this training died; iteration 3 of 110 was written. It can be resumed." in found.text


def test_a_run_that_ended_before_its_first_iteration_has_a_page(page, root):
    found = page(make_run(root, status="failed", iterations=0, error=ValueError("no")))
    assert "no learning curves" in found.section("learning")


def test_resumes_are_listed_and_raise_what_was_planned(page, root):
    run = make_run(root, ["agent.max_iterations=3"], status="interrupted")
    entry = {
        "when": "2026-03-02T08:00:00.000000Z",
        "command": ["wheelleg", "resume"],
        "iteration": 2,
        "overrides": ["agent.max_iterations=9"],
        "exact": True,
        "before": {"status": "interrupted"},
    }
    change_manifest(run, resumes=[entry])
    found = page(run)
    assert "iteration 3 of 9" in found.text
    assert "2026-03-02 08:00:00 UTC 2 agent.max_iterations=9 interrupted yes" in found.section("files")


@pytest.mark.parametrize("share", [0.999, 0.9999])
def test_nearly_all_is_not_all(page, root, share):
    run = make_run(root)
    add_play(run, episodes=10000, survival=share)
    assert "100 %" not in page(run).section("standing")
