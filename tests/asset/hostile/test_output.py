"""A conversion overwrites no robot file, no foreign mesh, and no target of a link; and a cache entry can be damaged."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from wheelleg_exp.asset import conversion_cache, convert, convert_cached
from wheelleg_exp.cli.main import main
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.paths import cache_dir

from .. import small_urdf
from ..small_usd import link as body
from ..small_usd import write as write_usd
from .scratch import CANARY, Scratch


def robot(folder: Path, mesh: str = "part.obj") -> Path:
    path = folder / mesh
    path.parent.mkdir(exist_ok=True)
    path.write_text(small_urdf.TETRAHEDRON)
    shape = f'<visual><geometry><mesh filename="{mesh}"/></geometry></visual>'
    return small_urdf.write(folder, small_urdf.link("a", shape))


def link_to(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


PLACES: dict[str, tuple[str, Callable[[Path], None]]] = {
    "a folder": ("bot.xml", Path.mkdir),
    "the robot by another link": ("bot.xml", link_to("bot.urdf")),
    "below a file": ("file/bot.xml", lambda path: path.parent.write_text(CANARY)),
    "a name without end": ("x" * 300 + ".xml", lambda path: None),
    "bytes that are no text": ("\udcff.xml", lambda path: None),
    "below the devices": ("/dev/null/bot.xml", lambda path: None),
    "no MJCF": ("bot.usda", lambda path: None),
    "no name": ("..", lambda path: None),
}


@pytest.mark.parametrize("name", PLACES)
def test_an_output_that_cannot_be_is_refused(scratch: Scratch, name: str) -> None:
    place, prepare = PLACES[name]
    source, output = robot(scratch.robot), scratch.robot / place
    prepare(output)
    said = scratch.run("convert", source, "-o", output)
    assert said.status == 2
    assert said.err.startswith("wheelleg: error: -o: ")


@pytest.mark.parametrize("target", ["canary.xml", "bot.xml", "nowhere/bot.xml"])
def test_an_output_that_is_a_link_takes_the_links_place(tmp_path: Path, target: str) -> None:
    (tmp_path / "canary.xml").write_text(CANARY)
    output = tmp_path / "bot.xml"
    output.symlink_to(target)
    convert(robot(tmp_path), output)
    assert not output.is_symlink()
    assert (tmp_path / "canary.xml").read_text() == CANARY


def test_meshes_that_are_a_link_take_the_links_place(tmp_path: Path) -> None:
    source, output = robot(tmp_path), tmp_path / "out.xml"
    convert(source, output)
    (tmp_path / "out_meshes").rename(tmp_path / "kept")
    (tmp_path / "out_meshes").symlink_to("kept")
    convert(source, output)
    assert not (tmp_path / "out_meshes").is_symlink()
    assert len(list((tmp_path / "kept").iterdir())) == 1


OTHERS = "contains files other than the meshes of 'bot.xml', such as 'mine.obj'"
KEPT: dict[str, tuple[dict[str, str], str]] = {  # files beside the robot
    "a mesh of the robot": ({}, "mesh files would overwrite the input 'bot_meshes/part.obj'"),
    "a mesh of no model": ({"bot_meshes/mine.obj": CANARY}, OTHERS),
    "a mesh of another model": ({"bot_meshes/mine.obj": CANARY, "bot.xml": "<mujoco/>"}, OTHERS),
    "a file": ({"bot_meshes": CANARY}, ""),
}


@pytest.mark.parametrize("name", KEPT)
def test_meshes_that_the_older_model_does_not_name_are_not_replaced(scratch: Scratch, name: str) -> None:
    files, words = KEPT[name]
    source = robot(scratch.robot, "part.obj" if files else "bot_meshes/part.obj")
    for file, text in files.items():
        (scratch.robot / file).parent.mkdir(exist_ok=True)
        (scratch.robot / file).write_text(text)
    said = scratch.run("convert", source, "-o", source.with_suffix(".xml"))
    assert said.status == 2
    assert words in said.err


def test_a_second_conversion_replaces_the_first(tmp_path: Path) -> None:
    output = tmp_path / "bot.xml"
    convert(robot(tmp_path), output)
    convert(robot(tmp_path, "other.obj"), output)
    assert [path.name for path in (tmp_path / "bot_meshes").iterdir()] == ["other_visual.obj"]
    convert(write_usd(tmp_path, body("a")), output)
    assert not (tmp_path / "bot_meshes").exists()


# ---------------------------------------------------------------- what is shown
STEERING = "\x1b[2J\x9b2J\u202e"
STEERED = [f'token physics:kinematicEnabled = "{STEERING}"', f'string physics:unknown = "{STEERING}"']


@pytest.mark.parametrize("text", STEERED)
def test_texts_of_a_file_do_not_steer_the_terminal(scratch: Scratch, text: str) -> None:
    said = scratch.convert(lambda folder: write_usd(folder, body("a", mass=text)))
    assert not [letter for letter in "\x1b\x9b\u202e" if letter in said.out + said.err]


def test_names_of_files_do_not_steer_the_terminal(scratch: Scratch) -> None:
    said = scratch.convert(lambda folder: robot(folder, "part\x7f.obj").rename(folder / "b\x1b[2J.urdf"))
    assert said.status == 0
    assert "b\\x1b[2J.urdf" in said.out


# ---------------------------------------------------------------- the cache
DAMAGE: dict[str, Callable[[Path], object]] = {
    "deep": lambda path: path.write_text("[" * 100_000),
    "pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "folder": lambda path: (path.unlink(), path.mkdir()),
    "number": lambda path: path.write_text("7"),
    "no text": lambda path: path.write_bytes(b"\xff\xfe"),
    "empty": lambda path: path.write_text(""),
    "gone": Path.unlink,
    "link to itself": lambda path: (path.unlink(), path.symlink_to(path.name)),
}


@pytest.mark.parametrize("file", [conversion_cache.MODEL, conversion_cache.REPORT, conversion_cache.CONTENTS])
@pytest.mark.parametrize("name", DAMAGE)
def test_a_damaged_cache_is_made_again(tmp_path: Path, name: str, file: str) -> None:
    source = robot(tmp_path)
    first = convert_cached(source, cache_dir=tmp_path / "cache")
    whole = first.output.read_bytes()
    DAMAGE[name](first.output.with_name(file))
    again = convert_cached(source, cache_dir=tmp_path / "cache")
    assert (again.fresh, again.output.read_bytes()) == (True, whole)
    assert not convert_cached(source, cache_dir=tmp_path / "cache").fresh


@pytest.mark.parametrize("kind", ["file", "pipe", "link to itself", "link elsewhere"])
def test_an_invalid_cache_entry_is_replaced(tmp_path: Path, kind: str) -> None:
    source = robot(tmp_path)
    entry = convert_cached(source, cache_dir=tmp_path / "cache").output.parent
    shutil.rmtree(entry)
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "canary").write_text(CANARY)
    {
        "file": lambda: entry.write_text(CANARY),
        "pipe": lambda: os.mkfifo(entry),
        "link to itself": lambda: entry.symlink_to(entry.name),
        "link elsewhere": lambda: entry.symlink_to(tmp_path / "elsewhere"),
    }[kind]()
    assert convert_cached(source, cache_dir=tmp_path / "cache").fresh
    assert not convert_cached(source, cache_dir=tmp_path / "cache").fresh
    assert [path.name for path in (tmp_path / "elsewhere").iterdir()] == ["canary"]


@pytest.mark.parametrize("variable", ["HOME", "XDG_CACHE_HOME", "WHEELLEG_CACHE"])
def test_an_unwritable_home_is_no_error_of_the_robots_file(monkeypatch, capsys, variable: str) -> None:
    for name in ("WHEELLEG_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(variable, "/dev/null")
    assert main(["check", "task=stand"]) == 2
    told = capsys.readouterr().err
    assert told.startswith("wheelleg: error: WHEELLEG_CACHE: cannot write the cache '/dev/null/")
    assert "env.robot" not in told


def test_a_user_without_a_home_folder_is_refused_with_the_variable(monkeypatch) -> None:
    for name in ("WHEELLEG_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as for an unknown user ID
    with pytest.raises(WheellegError, match="WHEELLEG_CACHE: the user has no home folder"):
        cache_dir()


@pytest.mark.parametrize("place", ["file", "file/below", "loop", "/dev/null", "a" * 300])
def test_a_cache_that_cannot_be_written_is_an_error(tmp_path: Path, place: str) -> None:
    source = robot(tmp_path)
    (tmp_path / "file").write_text(CANARY)
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(WheellegError, match="cannot write the cache") as told:
        convert_cached(source, cache_dir=tmp_path / place)
    assert (told.value.key, (tmp_path / "file").read_text()) == ("WHEELLEG_CACHE", CANARY)
