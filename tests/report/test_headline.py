import pytest

from report.runs import add_play, change_manifest, make_run

GROUPS = {"torque_rms_nm": {"legs": 0.1, "wheels": 5.8}, "at_limit": {"legs": 0.0, "wheels": 0.25}}
MOTORS = {**GROUPS, "sign_changes_per_s": {"legs": 0.0, "wheels": 10.0}}
NONE = dict.fromkeys(("height_rmse_m", "height_mean_m", "pitch_rms_deg", "pitch_mean_deg"), float("nan"))
UNSETTLED = {"survival": 0.0, **NONE, "settled_episodes": 0, "settled_steps": 0}
RESUME = {"when": "2026-03-02T08:00:00.000000Z", "command": ["wheelleg", "resume"], "iteration": 2, "exact": True}
RESUME |= {"overrides": ["agent.max_iterations=9"], "before": {"status": "interrupted"}}
# Each case: arguments that create the run, its plays, changes of its manifest, and expected texts by section ("" is the
# whole page).
PAGES = {
    "a played policy": ({"overrides": ["agent.max_iterations=3"]}, [{}], {}, {"": [
        "The policy stays up through 6 of 8 episodes of 5 s, 2.1 mm (RMS, after 1 s) off its target height of 70 mm.",
        "Survival 75 %",
        "Base height 72.0 mm mean after 1 s; RMS error 2.1 mm against 70 mm",
        "Pitch 1.1° RMS after 1 s; mean lean 0.90°",
        "Iterations 3 in 2 min 30 s"]}),
    "drift and motors, those of the group with the largest torque": (
        {}, [{"drift_m": 0.0123, "yaw_drift_deg": 1.5, "action_rate_per_s": 75.0, "power_net_w": 0.5, **MOTORS}],
        {}, {"": ["Drift 12 mm largest after 1 s, mean of its episodes; turned by 1.5°",
                  "Torque 5.8 N·m RMS of the wheels after 1 s; 25 % at the limit; 10 sign changes per s",
                  "Power 0.50 W"],
             "standing": ["Torque, RMS, after 1 s (legs) 0.100 N·m 1 500 steps of 7 episodes",
                          "Strayed from its place, after 1 s 12.3 mm 7 episodes"]}),
    "a policy that always falls": ({}, [{"survival": 0.0, "ended_by": {"base_contact": 8}}], {}, {
        "": ["The policy falls in every one of 8 episodes of 5 s."]}),
    "a policy that falls before it settles": ({}, [UNSETTLED, UNSETTLED], {}, {"standing": [
        "Base height, mean, after 1 s – 0 steps of 0 episodes Pitch, RMS, after 1 s – ",
        "no episode lasted that long"]}),
    "three environments that fell with the time-out": (
        {}, [], {"last_ended_by": {"time_out": 5, "base_contact": 1, "time_out and base_contact": 3, "none": 1}},
        {"": ["In 50 % of the environments the last episode ran to the time-out."]}),
    "an unfinished episode": (
        {}, [{"unfinished": 1, "survival": 6 / 7, "ended_by": {"time_out": 6, "base_contact and leg_contact": 1}}], {},
        {"standing": ["Base height, mean, after 1 s 72.0 mm 1 500 steps of 7 episodes",
                      "Survived to the time-out 85.7 % 7 ended episodes", "How its 7 ended episodes ended",
                      "base contact and leg contact 1 14.3 %"]}),
    "an older play that counts twice": (
        {}, [{"ended_by": {"time_out": 6, "base_contact": 2, "leg_contact": 2}}], {},
        {"standing": ["an episode with two terminations counts for both"]}),
    "two plays": ({}, [{"survival": 0.25}, {"survival": 1.0, "overrides": ["seed=7"]}], {}, {
        "": ["through all 8 episodes"], "standing": ["All plays", "seed=7"]}),
    # Two of ten environments ended without a time-out in the last iteration. 60 steps of 1/60 s are one second.
    "no play": ({}, [], {}, {
        "": ["In 80 % of the environments the last episode ran to the time-out.",
             "Episode length 1.00 s mean of the last 100 ended episodes, of 5 s at most"],
        "standing": ["wheelleg play"]}),
    "a failed run": ({"status": "failed", "error": RuntimeError("physics gone to NaN")}, [], {}, {
        "": ["Training failed after iteration 3 of 110: physics gone to NaN."]}),
    "a run that failed before its first iteration": (
        {"status": "failed", "iterations": 0, "error": ValueError("no")}, [], {}, {"learning": ["no learning curves"]}),
    "an interrupted run": ({"status": "interrupted", "error": KeyboardInterrupt()}, [], {}, {
        "": ["Training was interrupted after iteration 3 of 110; it can be resumed.", "Iterations 3 of 110 planned"]}),
    "a running run": ({"status": "running"}, [], {}, {
        "": ["Training is running: iteration 3 of 110 is done."], "trust": ["still running"]}),
    "a resumed run": (
        {"overrides": ["agent.max_iterations=3"], "status": "interrupted"}, [], {"resumes": [RESUME]},
        {"": ["iteration 3 of 9"],
         "files": ["2026-03-02 08:00:00 UTC 2 agent.max_iterations=9 interrupted yes"]}),
}  # fmt: skip


@pytest.mark.parametrize(("made", "plays", "changes", "texts"), PAGES.values(), ids=list(PAGES))
def test_the_page_reports_the_result_of_the_run(page, root, made, plays, changes, texts):
    run = make_run(root, **made)
    for play in plays:
        add_play(run, **play)
    if changes:
        change_manifest(run, **changes)
    found = page(run)
    for section, expected in texts.items():
        text = found.section(section) if section else found.text
        assert [one for one in expected if one not in text] == [], text
    assert "nan" not in found.text.split()
    assert "Settle" not in found.section("standing")


def test_a_run_whose_process_died_has_crashed(page, root):
    run = make_run(root, status="running")
    change_manifest(run, process={**run.manifest().data["process"], "boot_id": "another boot"})
    found = page(run)
    assert found.text.startswith("crashed")
    assert "The process of this training died; iteration 3 of 110 was written. It can be resumed." in found.text


@pytest.mark.parametrize("share", [0.999, 0.9999])
def test_nearly_all_is_not_all(page, root, share):
    run = make_run(root)
    add_play(run, episodes=10000, survival=share)
    assert "100 %" not in page(run).section("standing")
