from report.runs import make_run
from wheelleg_exp.files import write_json, write_text

EPISODES = "test,survived,time_to_failure_s\nstand,1,60.0\nstand,0,10.0\n"


def add_evaluation(run, kind="evaluation", survival=0.5, scenarios="c" * 64):
    folder = run.evaluation / kind
    folder.mkdir(parents=True)
    figures = {
        "stand/survival": {"value": survival, "low": 0.0, "high": 1.0, "episodes": 2, "unit": "", "better": "higher"},
        "stand/height_mean": {"value": 0.07, "low": 0.07, "high": 0.07, "episodes": 2, "unit": "m", "better": ""},
        "stand/pitch_rms": {"value": 0.1, "low": None, "high": None, "episodes": 2, "unit": "rad", "better": "lower"},
    }
    about = {"format": 1, "checkpoint": "model_2.pt", "about": {"profile": "article"}, "scenarios_sha256": scenarios}
    write_json(folder / "evaluation.json", {**about, "protocol": {"name": "stand"}, "metrics": figures})
    write_text(folder / "episodes.csv", EPISODES)
    values = {name: figure["value"] for name, figure in figures.items()}
    results = {"protocol": "stand", "scenarios_sha256": scenarios, "metrics": values}
    run.manifest().add(kind, [folder / "evaluation.json", folder / "episodes.csv"], results, command=["wheelleg"])


def test_metrics_have_their_intervals_and_units(page, root):
    run = make_run(root)
    assert "How well did it do?" not in page(run).text
    add_evaluation(run)
    found = page(run).section("evaluation")
    for text in ("Protocol stand", "Survival 0.500 0.00 to 1.00", "Pitch rms 5.73° –", "Episodes that still stand"):
        assert text in found
    assert "Height mean 0.0700 m Pitch" in found  # All episodes agree, so that there is no interval.
    assert f"wheelleg evaluate {run.id} protocol=stand --reference" in found
    (run.evaluation / "evaluation" / "evaluation.json").unlink()
    assert "cannot be read" in page(run).section("evaluation")
    run = make_run(root)
    add_evaluation(run)
    add_evaluation(run, "reference", survival=1.0)
    found = page(run).section("evaluation")
    assert "Survival 0.500 0.00 to 1.00 1.00" in found
    assert "Largest survived change" not in found
    run.manifest().add("evaluation", [], {"metrics": {"robust/margin/slope": 0.125}}, command=["wheelleg"])
    assert "Largest survived change Change Policy Reference Slope of the floor, rad 0.125 –" in (
        page(run).section("evaluation")
    )
    other = make_run(root, name="other")
    add_evaluation(other)
    add_evaluation(other, "reference", survival=1.0, scenarios="d" * 64)
    assert "Reference" not in page(other).section("evaluation").replace("--reference", "")


def test_the_same_policies_in_two_engines_are_a_table_per_protocol(page, root):
    run = make_run(root)
    add_evaluation(run)
    results = {"protocol": "stand", "verdict": "physx differs.", "engines": ["mujoco", "physx"], "runs": 3}
    for damaged in (None, {"engines": 1}, {"engines": ["a"], "metrics": {"x": 1}}):
        run.manifest().add("comparison", [], damaged, command=["wheelleg"])
    for pitch in (0.2, 0.3):
        metrics = {"stand/survival": [1.0, 0.5, ""], "stand/pitch_std": [0.1, pitch, "rad"]}
        run.manifest().add("comparison", [], {**results, "metrics": metrics}, command=["wheelleg"])
    found = page(run).section("evaluation")
    assert found.count("In two engines: stand, runs: 3") == 1
    assert "Metric mujoco physx Unit stand/survival 1.00 0.500 stand/pitch_std 5.73 17.2 °" in found
    assert "physx differs." in found
