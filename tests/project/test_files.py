from __future__ import annotations

import os
import re
import sys
from pathlib import Path

import pytest
from asset.corpus import ABSENT, corpus_folder, expectations

from project.robots import tetrahedron, urdf
from wheelleg_exp.asset import convert
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.paths import assets_dir
from wheelleg_exp.project.create import copy_robot, robot_file


def model(source: Path, folder: Path) -> dict[str, bytes]:
    """Return all files that the conversion of a robot writes."""
    convert(source, folder / "m" / "model.xml")
    files = {path.name: path.read_bytes() for path in (folder / "m").rglob("*") if path.is_file()}
    # The first line of the copy is a comment with the old paths of the layers.
    return {**files, "model.xml": re.sub(rb"^<!--.*?-->", b"", files["model.xml"], flags=re.DOTALL)}


def moved(copy: Path, to: Path) -> Path:
    to.mkdir(parents=True)
    copy.parent.rename(to / "robot")
    return to / "robot" / copy.name


def visual(name: str) -> str:
    return f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'


def test_the_layers_of_a_usd_stay_in_their_folders(tmp_path):
    source = assets_dir() / "wheelleg" / "wheelleg.usda"
    copy = copy_robot(source, tmp_path / "copy")
    there = {path.relative_to(source.parent): path.read_bytes() for path in source.parent.rglob("*.usd*")}
    assert {p.relative_to(copy.parent): p.read_bytes() for p in copy.parent.rglob("*") if p.is_file()} == there


def test_a_usd_with_layers_outside_its_folder_is_copied_completely(tmp_path):
    source = tmp_path / "robots" / "top" / "robot.usda"
    source.parent.mkdir(parents=True)
    base = copy_robot(assets_dir() / "wheelleg" / "wheelleg.usda", tmp_path / "robots" / "shared")
    source.write_text(f"#usda 1.0\n(\n    subLayers = [@{os.path.relpath(base, source.parent)}@]\n)\n")
    wanted = model(source, tmp_path / "a")
    copy = copy_robot(source, tmp_path / "project" / "copy")
    base.parent.rename(tmp_path / "gone")
    assert model(moved(copy, tmp_path / "elsewhere"), tmp_path / "b") == wanted


RELATIVE = ["mesh.obj", "meshes/deep/mesh.obj", "../shared/mesh.obj"]


@pytest.mark.parametrize("name", [*RELATIVE, "package://two_description/meshes/mesh.obj", "file://{}"])
def test_a_urdf_finds_its_meshes_from_the_copy(name, tmp_path):
    home = tmp_path / "two_description"
    mesh = tetrahedron(home / (name if name in RELATIVE else "meshes/mesh.obj"))
    source = urdf(home, visual(name.format(mesh.resolve())))
    wanted = model(source, tmp_path / "a")
    assert any(file.endswith(".obj") for file in wanted)
    copy = copy_robot(source, tmp_path / "project" / "copy")
    home.rename(tmp_path / "gone")
    mesh.unlink(missing_ok=True)
    copy = moved(copy, tmp_path / "elsewhere/far/away/from/all/of/it")
    assert set(model(copy, tmp_path / "b").values()) == set(wanted.values())


@pytest.mark.parametrize("name", ["mesh.obj", "missing.stl"])
def test_a_urdf_with_a_mesh_in_its_folder_or_with_a_missing_mesh_stays_the_same_to_the_byte(name, tmp_path):
    tetrahedron(tmp_path / "home" / "mesh.obj")
    source = urdf(tmp_path / "home", visual(name))
    assert copy_robot(source, tmp_path / "copy").read_bytes() == source.read_bytes()


@pytest.mark.parametrize("second", ["../b/mesh.obj", "meshes/mesh.obj"])
def test_meshes_of_the_same_name_stay_two(second, tmp_path):
    home = tmp_path / "home"
    tetrahedron(tmp_path / "a" / "mesh.obj", 0.05)
    other = tetrahedron(home / second, 0.01)
    copy = copy_robot(urdf(home, visual("../a/mesh.obj") + visual(second)), tmp_path / "copy")
    assert {p.name for p in (copy.parent / "meshes").iterdir()} == {"mesh.obj", "mesh_2.obj"}
    text = copy.read_text()
    assert text.count('"meshes/mesh.obj"') == text.count('"meshes/mesh_2.obj"') == 2
    if second == "meshes/mesh.obj":  # A mesh inside the folder of the robot does not move.
        assert (copy.parent / "meshes" / "mesh.obj").read_bytes() == other.read_bytes()


SECRET = "only its owner reads this"
STAGE = """#usda 1.0
(
    defaultPrim = "bot"
)
def Xform "bot" (prepend apiSchemas = ["PhysicsRigidBodyAPI"])
{{
    def Shader "s"
    {{
        asset inputs:file = @{}@
    }}
}}
"""


def naming(folder: Path, ending: str, name: str) -> Path:
    """Return a robot whose texture is the file ``name``."""
    texture = f'<visual><geometry><sphere radius="1"/></geometry><material name="m"><texture filename="{name}"/>'
    if ending == "urdf":
        return urdf(folder, f"{texture}</material></visual>")
    (folder / "bot.usda").write_text(STAGE.format(name))
    return folder / "bot.usda"


@pytest.mark.parametrize("ending", ["urdf", "usda"])
@pytest.mark.parametrize(
    "name", ["{0}/passwd", "../passwd", "file://{0}/passwd", "id_rsa", "./id_rsa", "pipe.png", "zero.png", "gone.png"]
)
def test_files_that_do_not_belong_to_the_robot_are_not_copied(tmp_path, ending, name):
    home = tmp_path / "home"
    home.mkdir()
    (tmp_path / "passwd").write_text(SECRET)
    (home / "id_rsa").write_text(SECRET)
    (home / "zero.png").symlink_to("/dev/zero")
    os.mkfifo(home / "pipe.png")
    source = naming(home, ending, name.format(tmp_path))
    copy = copy_robot(source, tmp_path / "copy")
    files = [path for path in (tmp_path / "copy").rglob("*") if path.is_file()]
    assert files == [copy]
    assert SECRET not in copy.read_text()


@pytest.mark.parametrize("ending", ["urdf", "usda"])
@pytest.mark.parametrize("name", ["wood.png", "../wood.png", "textures/wood.JPG"])
def test_the_textures_of_a_robot_are_copied(tmp_path, ending, name):
    home = tmp_path / "home"
    (home / "textures").mkdir(parents=True)
    (home / name).write_text("wood")
    copy = copy_robot(naming(home, ending, name), tmp_path / "copy")
    (texture,) = [path for path in (tmp_path / "copy").rglob("*") if path.is_file() and path != copy]
    assert texture.read_text() == "wood"
    assert texture.relative_to(copy.parent).as_posix() in copy.read_text()


@pytest.mark.parametrize("name", ["pipe.usda", "robot.stl", "robot.urdf.xacro", "robot.xml"])
def test_a_pipe_as_a_layer_and_another_format_are_refused(name, tmp_path):
    if name == "pipe.usda":
        os.mkfifo(tmp_path / name)
        source, message = naming(tmp_path, "usda", f"./{name}"), "is a pipe"
    else:
        (source := tmp_path / name).write_text("no robot")
        message = "mujoco_usd_converter" if name == "robot.xml" else None
    with pytest.raises(WheellegError, match=message):
        copy_robot(source, tmp_path / "copy")


def test_a_copy_of_a_robot_of_the_corpus_is_the_same_robot(request, tmp_path):
    folder = corpus_folder(request.config.getoption("--corpus"))
    if folder is None:
        pytest.skip(ABSENT)
    named = {"upkie", "wf_tron2a_isaac", "wf_tron2a_urdf", "wf_tron1a_isaac"}
    chosen = [item for item in expectations(folder) if Path(item["asset"]).parts[1] in named]
    assert len(chosen) == len(named)
    for number, item in enumerate(chosen):
        wanted = model(folder / item["asset"], tmp_path / f"{number}a")
        copy = moved(copy_robot(folder / item["asset"], tmp_path / "copy"), tmp_path / f"{number}far")
        assert model(copy, tmp_path / f"{number}b") == wanted, item["asset"]


@pytest.fixture
def descriptions(tmp_path, monkeypatch):
    """Install a package robot_descriptions with a URDF, an MJCF, and a robot that cannot be downloaded."""
    package = tmp_path / "site" / "robot_descriptions"
    package.mkdir(parents=True)
    table = "class One:\n    def __init__(self, urdf): self.has_urdf = urdf\nDESCRIPTIONS = "
    rows = "{'two_description': One(True), 'two_mj_description': One(False), 'gone_description': One(True)}\n"
    (package / "__init__.py").write_text(table + rows)
    (package / "two_description.py").write_text(f"URDF_PATH = {str(urdf(tmp_path / 'robot'))!r}\n")
    (package / "gone_description.py").write_text("raise OSError('no route to host')\n")
    for name in [name for name in sys.modules if name.split(".")[0] == "robot_descriptions"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(str(package.parent))
    yield tmp_path / "robot" / "two.urdf"
    for name in [name for name in sys.modules if name.split(".")[0] == "robot_descriptions"]:
        del sys.modules[name]


def test_a_name_of_robot_descriptions_is_its_urdf_unless_a_file_has_this_name(descriptions, tmp_path, monkeypatch):
    assert robot_file(Path("two_description")) == descriptions
    monkeypatch.chdir(tmp_path)
    Path("two_description").write_text("<robot/>")
    assert robot_file(Path("two_description")) == Path("two_description")


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("two_descriptin", "there is no such file or robot description; .* did you mean 'two_description'?"),
        ("two_mj_description", "this robot description has no URDF; .* did you mean 'two_description'?"),
        ("gone_description", "cannot load this robot: no route to host"),
        ("two_description.urdf", "there is no such file; expected a USD or URDF file$"),
    ],
)
def test_a_wrong_name_of_robot_descriptions_is_one_error(descriptions, name, error):
    with pytest.raises(WheellegError, match=error):
        robot_file(Path(name))


def test_without_robot_descriptions_the_error_names_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    with pytest.raises(WheellegError, match="pip install robot_descriptions"):
        robot_file(Path("two_description"))
