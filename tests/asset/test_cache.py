"""``convert_cached`` reuses a cache entry, or converts the robot again if a source file has changed."""

import hashlib
import multiprocessing
import shutil
from concurrent.futures import ProcessPoolExecutor
from importlib import metadata
from pathlib import Path

import mujoco
import pytest

from wheelleg_exp.asset import convert, convert_cached, source_digest
from wheelleg_exp.paths import find_asset

from .small_usd import link, write

LAYERS = {"wheelleg.usda", *(f"configuration/wheelleg_{part}.usda" for part in ("base", "physics", "sensor"))}


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    stock = find_asset("wheelleg/wheelleg.usda")
    folder = tmp_path / "robot"
    shutil.copytree(stock.parent, folder)
    return folder / stock.name


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_the_digest_names_every_layer_with_its_hash(robot):
    digest = source_digest(robot)
    assert set(digest) == LAYERS
    for name, value in digest.items():
        assert value == hashlib.sha256((robot.parent / name).read_bytes()).hexdigest()


def test_the_second_time_nothing_is_converted_and_the_cached_model_is_the_converted_one(robot, tmp_path):
    first = convert_cached(robot, cache_dir=tmp_path / "cache")
    second = convert_cached(robot, cache_dir=tmp_path / "cache")
    assert (first.fresh, second.fresh) == (True, False)
    assert (first.output, first.report) == (second.output, second.report)
    direct = convert(robot, tmp_path / "model.xml")
    assert (second.output.read_bytes(), second.report) == (direct.output.read_bytes(), direct.report)


@pytest.mark.parametrize("layer", sorted(LAYERS))
def test_a_change_in_any_layer_is_noticed(robot, tmp_path, layer):
    first = convert_cached(robot, cache_dir=tmp_path / "cache")
    change(robot.parent / layer, "upAxis", "# changed\n    upAxis")
    second = convert_cached(robot, cache_dir=tmp_path / "cache")
    assert second.fresh
    assert second.key != first.key


def test_another_physics_engine_has_entries_of_its_own(robot, tmp_path, monkeypatch):
    first = convert_cached(robot, cache_dir=tmp_path / "cache")
    version = metadata.version
    monkeypatch.setattr(metadata, "version", lambda name: "4.9.1" if name == "mujoco-core" else version(name))
    assert convert_cached(robot, cache_dir=tmp_path / "cache").key != first.key


def test_the_same_bytes_elsewhere_are_the_same_entry(robot, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(robot.parent, elsewhere)
    first = convert_cached(robot, cache_dir=tmp_path / "cache")
    assert not convert_cached(elsewhere / robot.name, cache_dir=tmp_path / "cache").fresh
    assert str(robot.parent) not in first.output.read_text() + first.report.to_json()


def test_options_have_entries_of_their_own(robot, tmp_path):
    options = ({}, {"base": "fixed"}, {"variants": {"Sensor": "None"}})
    keys = {convert_cached(robot, cache_dir=tmp_path / "cache", **option).key for option in options}
    assert len(keys) == 3


def test_variants_of_one_layer_have_entries_of_their_own(tmp_path):
    texts = {"short": link("a"), "long": link("a") + link("b")}
    body = "".join(f'"{name}" {{\n{text}}}\n' for name, text in texts.items())
    path = write(tmp_path, f'variantSet "legs" = {{\n{body}}}\n')
    change(path, 'def Xform "bot" ', 'def Xform "bot" (prepend variantSets = "legs")')
    made = [convert_cached(path, cache_dir=tmp_path / "cache", variants={"legs": name}) for name in texts]
    assert [mujoco.MjModel.from_xml_path(str(one.output)).nbody for one in made] == [2, 3]


def _work(arguments: tuple[str, str]) -> bytes:
    source, cache = arguments
    return convert_cached(Path(source), cache_dir=Path(cache)).output.read_bytes()


def test_several_processes_may_fill_one_cache(robot, tmp_path):
    cache = tmp_path / "cache"
    fresh = multiprocessing.get_context("spawn")  # A forked process would wait forever for USD's locks.
    with ProcessPoolExecutor(2, mp_context=fresh) as pool:
        found = set(pool.map(_work, [(str(robot), str(cache))] * 4))
    assert (len(found), len(list(cache.iterdir()))) == (1, 1)  # no incomplete entry
