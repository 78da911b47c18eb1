from typing import Any

import pytest
import rerun.blueprint as rrb

from wheelleg_exp.recording import layout
from wheelleg_exp.recording.blueprint import blueprint
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.recording.writing.recorder import Recorder

KEYS = ["Train/mean_reward", "Episode_Reward/alive", "Episode_Termination/time_out", "Loss/value", "Own/thing"]


@pytest.fixture(scope="module")
def layouts(recorded, tmp_path_factory) -> list:
    path = tmp_path_factory.mktemp("layouts") / "r.rrd"
    with Recorder(path, recorded[2], recording_id="r", name="n", env_ids=[1], purpose="play") as recorder:
        return recorder.layout_state()[0]


def made(layouts, purpose, documents=("config", "figures"), training=KEYS) -> rrb.Blueprint:
    return blueprint(layouts, purpose, documents=documents, training=training)


def tabs(of: rrb.Blueprint) -> Any:
    return of.root_container.contents[1]


def views(container: Any) -> list[Any]:
    if not hasattr(container, "contents") or isinstance(container, rrb.View):
        return [container]
    return [view for part in container.contents for view in views(part)]


def shown(view: Any) -> list[str]:
    contents = view.contents if isinstance(view.contents, list) else [view.contents]
    return [str(entity).removeprefix("+ ").lstrip("/") for entity in contents]


@pytest.mark.parametrize(
    ("purpose", "first"), [("training", "Learning"), ("play", "Motion"), ("evaluation", "Metrics")]
)
def test_each_purpose_opens_with_what_matters_to_it(layouts, purpose, first):
    opened = made(layouts, purpose)
    assert isinstance(opened.root_container.contents[0], rrb.Spatial3DView)
    assert opened.time_panel.timeline == (layout.STEP if purpose == "training" else layout.SIM_TIME)
    found = tabs(opened)
    assert (found.contents[0].name, found.active_tab) == (first, 0)
    names = [tab.name for tab in found.contents]
    assert len(set(names)) == len(names)
    assert {"Motion", "Joints", "Rewards", "Episodes", "Observations", "Documents"} <= set(names)


def test_the_first_curves_are_those_of_this_training(layouts):
    overview = tabs(made(layouts, "training")).contents[0].contents[0]
    assert overview.name == "Overview"
    assert [view.name for view in views(overview)] == [
        "Return, mean of the last 100 ended episodes",
        "Reward by term: sum of an episode / longest episode's seconds",
        "Last episode ended by, share of all environments",
        "Losses",
    ]
    every = {entity for view in views(tabs(made(layouts, "training")).contents[0]) for entity in shown(view)}
    assert every == {layout.join_key(layout.TRAINING, key) for key in KEYS}
    assert shown(tabs(made(layouts, "training", training=[])).contents[0]) == ["training/**"]


def test_every_view_shows_something_that_is_recorded(layouts, recorded):
    known = set(Recording(recorded[0]).entities()) | {"ground", "documents/config", "documents/figures"}
    for view in views(made(layouts, "play").root_container):
        entities = [str(view.origin).lstrip("/")] if isinstance(view, rrb.TextDocumentView) else shown(view)
        for entity in entities:
            whole = entity.removesuffix("/**")
            assert whole in known or any(e.startswith(f"{whole}/") for e in known), (view.name, entity)


def test_figures_are_shown_as_text_if_there_are_any(layouts):
    for documents in (("figures",), ()):
        found = views(tabs(made(layouts, "evaluation", documents=documents)).contents[0])
        assert any(isinstance(view, rrb.TextDocumentView) for view in found) == bool(documents)


@pytest.mark.parametrize(
    ("entity", "unit"),
    [
        ("base/height", "m"),
        ("env_3/base/pitch", "rad"),
        ("joints/l01/effort", "N·m"),
        ("contacts/feet/peak", "N"),
        ("rewards/alive", "1/s"),
        ("observations/policy/x", None),
        ("env_3/rewards", None),
    ],
)
def test_numbers_have_units(entity, unit):
    assert layout.unit(entity) == unit
