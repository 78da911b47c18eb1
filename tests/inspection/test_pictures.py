import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from inspection.synthetic import Writer
from inspection.written import CONTACT, DT, FELL_AT, HEIGHT, base_x, write_recording

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.inspection import recorded_scene, recording_pictures
from wheelleg_exp.inspection.recorded_scene import Camera, follow_robot
from wheelleg_exp.inspection.recording_pictures import Scenery, row_at, scenery
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.rendering import renderer
from wheelleg_exp.rendering.render_scene import Shape, camera_axes, points

pytestmark = pytest.mark.pictures

WIDTH, HEIGHT_PX = 320, 240
TAN = np.tan(np.radians(15.0))


@pytest.fixture(scope="module")
def shown(played: Recording) -> Scenery:
    return scenery(played)


def camera_of(shown: Scenery, row: int) -> tuple[Camera, np.ndarray]:
    camera = follow_robot(shown.scene, shown.motion, np.arange(len(shown.motion.step)), WIDTH / HEIGHT_PX)
    return camera, camera.lookat[row]


def pixel(point: np.ndarray, camera: Camera, lookat: np.ndarray) -> tuple[int, int]:
    right, up, back = camera_axes()
    seen = point - lookat
    depth = camera.distance - seen @ back
    scale = HEIGHT_PX / 2 / TAN / depth
    return round(WIDTH / 2 + scale * (seen @ right)), round(HEIGHT_PX / 2 - scale * (seen @ up))


def is_orange(rgb: np.ndarray) -> np.ndarray:
    r, g, b = np.moveaxis(rgb.astype(int), -1, 0)
    return (r > 1.3 * g) & (g > 1.5 * b) & (r > 60)


def is_magenta(rgb: np.ndarray) -> np.ndarray:
    r, g, b = np.moveaxis(rgb.astype(int), -1, 0)
    return (r > 2 * g) & (b > 2 * g) & (r > 60)


def test_a_scene_has_every_recorded_shape(shown: Scenery) -> None:
    kinds = {name: sorted(shape.kind for shape in shapes) for name, shapes in shown.scene.bodies.items()}
    assert kinds == {"base": ["box", "capsule", "ellipsoid", "mesh"], "wheel": ["cylinder"]}
    rod = next(shape for shape in shown.scene.bodies["base"] if shape.kind == "capsule")
    np.testing.assert_allclose(rod.pos, [0, 0, -0.05], atol=1e-7)  # rerun's origin is the lower cap's centre.
    assert shown.scene.ground is not None
    assert shown.scene.ground.tile == pytest.approx(0.1)
    assert list(shown.scene.bodies)[shown.scene.root] == "base"
    cloud = points(shown.scene, shown.motion.pos[0], shown.motion.quat[0])
    np.testing.assert_allclose(cloud.min(axis=0)[2], 0.0, atol=1e-6)  # The tyre touches the ground.
    np.testing.assert_allclose(cloud.max(axis=0)[2], HEIGHT + 0.09, atol=1e-6)  # The fin's tip is the highest point.
    np.testing.assert_allclose(cloud.max(axis=0)[0], 0.1, atol=1e-6)  # The eye is the foremost point.


def test_the_robot_is_drawn_where_a_camera_sees_it(shown: Scenery, graphics: str) -> None:
    row = 10
    image = recording_pictures.picture(shown, row, WIDTH, HEIGHT_PX, caption=False)
    camera, lookat = camera_of(shown, row)
    centre = np.array([base_x(shown.motion.step[row : row + 1])[0], 0.0, HEIGHT])
    corners = [
        pixel(centre + np.array([sx * 0.08, sy * 0.06, sz * 0.05]), camera, lookat)
        for sx in (-1, 1) for sy in (-1, 1) for sz in (-1, 1)
    ]  # fmt: skip
    assert 0.03 < is_orange(image).mean() < 0.5
    columns, rows = np.nonzero(is_orange(image).T)
    for bound in (min, max):
        assert abs(bound(columns) - bound(c for c, _ in corners)) <= 3
    assert abs(rows.max() - max(r for _, r in corners)) <= 3


def test_the_robot_moves_over_the_ground_between_two_times(shown: Scenery, graphics: str) -> None:
    (early, late), again = (recording_pictures.pictures(shown, [0, 33], WIDTH, HEIGHT_PX) for _ in range(2))
    np.testing.assert_array_equal(early, again[0])
    assert np.abs(early.astype(int) - late).mean() > 2.0
    # The camera follows the robot, so the robot has the same place in every picture.
    centres = [np.argwhere(is_orange(image)).mean(axis=0) for image in (early, late)]
    assert np.abs(centres[0] - centres[1]).max() < 0.1 * WIDTH


def test_a_contact_force_is_an_arrow_of_its_length(shown: Scenery, graphics: str) -> None:
    touching, free = recording_pictures.pictures(shown, [10, 11], WIDTH, HEIGHT_PX)
    assert not is_magenta(free).any()
    rows, columns = np.nonzero(is_magenta(touching))
    camera, lookat = camera_of(shown, 10)
    origin = shown.motion.arrows[0].origins[10][0]
    low, high = (pixel(origin + np.array([0, 0, up]), camera, lookat)[1] for up in (0.0, CONTACT))
    assert abs(rows.max() - low) <= 4
    assert abs(rows.min() - high) <= 4
    assert abs(columns.mean() - pixel(origin, camera, lookat)[0]) <= 3


@pytest.mark.parametrize(
    ("choice", "row"),
    [
        ({"time_s": 0.2}, 9),
        ({"at": "0.2s"}, 9),
        ({"at": ".2"}, 9),
        ({"at": "400ms"}, 19),
        ({"at": "20steps"}, 19),
        ({"at": "terminations.fell"}, FELL_AT - 1),
        ({"at": "terminations/fell"}, FELL_AT - 1),
        ({"at": "contacts.feet"}, 0),
        ({}, 30),
    ],
)
def test_a_moment_is_found(shown: Scenery, choice: dict, row: int) -> None:
    assert row_at(shown, **choice) == row


@pytest.mark.parametrize(
    ("choice", "step"),
    [
        ({"iteration": 5}, 121 + 12),
        ({"iteration": 6, "at": "0.1s"}, 145 + 5),
        ({"iteration": 6, "at": "5steps"}, 145 + 5),
        ({"iteration": 11, "at": "terminations.fell"}, 280),
        ({"at": "terminations.fell"}, 40),
        ({}, 241 + 30),
    ],
)
def test_a_moment_of_a_training_is_found(trained: Recording, choice: dict, step: int) -> None:
    found = scenery(trained)
    assert found.motion.step[row_at(found, **choice)] == step


def test_a_caption_names_environment_time_and_command(
    trained: Recording, several: Recording, played: Recording
) -> None:
    assert scenery(several, 3).source.branch == "env_3"
    with pytest.raises(WheellegError, match="environment 1 was not recorded"):
        scenery(several, 1)
    found = scenery(trained)
    expected = [f"iteration 5 · t = {121 * DT:.2f} s", "command: forward +0.50 m/s"]
    assert recorded_scene.caption_lines(found.motion, row_at(found, iteration=5, at="0s")) == expected
    assert list(recorded_scene.arrow_legend(found.motion)) == ["contact force"]
    for shown, caption in ((scenery(several, 3), "environment 3 · t = 0.02 s"), (scenery(played), "t = 0.02 s")):
        assert recorded_scene.caption_lines(shown.motion, 0, shown.env_id)[0] == caption


def test_a_pose_that_is_not_finite_is_the_last_that_was() -> None:
    rows = np.array([[np.nan, 0], [1, 2], [np.inf, 0], [3, 4]], dtype=float)
    np.testing.assert_array_equal(recorded_scene._last_finite(rows), [[1, 2], [1, 2], [1, 2], [3, 4]])


def test_a_recording_without_a_robot_is_rejected(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "other.rrd")
    writer.numbers("something", [1.0])
    with pytest.raises(WheellegError, match="no moving robot"):
        scenery(Recording(writer.close()))


def test_a_driver_that_aborts_takes_nothing_with_it(shown: Scenery, monkeypatch) -> None:
    crashing = [sys.executable, "-c", "import os; os.write(2, b'driver: cannot\\n'); os.abort()"]
    real = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda _, **options: real(crashing, **options))
    with pytest.raises(WheellegError, match="driver: cannot"):
        recording_pictures.picture(shown, 0, 64, 64)


def test_the_wanted_backend_comes_first(monkeypatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert renderer.backends() == ("osmesa", "egl")
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    assert renderer.backends() == ("egl", "osmesa")


def test_drawing_leaves_no_process_and_no_log_behind(shown, graphics, tmp_path: Path, monkeypatch) -> None:
    started = []
    real = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", lambda *a, **k: started.append(real(*a, **k)) or started[-1])
    monkeypatch.chdir(tmp_path)
    recording_pictures.picture(shown, 0, 64, 64)
    assert [process.returncode for process in started] == [0]
    assert not list(tmp_path.iterdir())


def test_queries_need_neither_torch_nor_mujoco_in_this_process(tmp_path: Path) -> None:
    path = write_recording(tmp_path / "r.rrd")
    code = (
        "import sys; from pathlib import Path; from wheelleg_exp.recording.reading.recording_reader import Recording\n"
        "from wheelleg_exp.inspection import recording_pictures, recording_plots, recording_video\n"
        "from wheelleg_exp.inspection import export_numbers, rerun_viewer\n"
        f"recording_pictures.scenery(Recording(Path({str(path)!r})))\n"
        "print([m for m in ('torch', 'mujoco', 'matplotlib.pyplot') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_terrain_and_meshes_without_an_area_are_no_trouble(shown: Scenery, graphics: str) -> None:
    x, y = np.meshgrid([-2.0, 0.0, 2.0], [-2.0, 0.0, 2.0])
    flat = np.column_stack((x.ravel(), y.ravel(), np.zeros(9)))
    faces = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [3, 4, 7], [3, 7, 6], [4, 5, 8], [4, 8, 7]])
    place, upright, green = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.6, 0.0, 1.0)
    terrain = Shape("mesh", (), place, upright, green, flat, faces)
    point = Shape("mesh", (), place, upright, green, np.zeros((4, 3)), np.array([[0, 1, 2], [1, 2, 3]]))
    scene = replace(shown.scene, fixed=[terrain, point], ground=None)
    image = recording_pictures.picture(replace(shown, scene=scene), 5, WIDTH, HEIGHT_PX, caption=False).astype(int)
    assert ((image[..., 1] > 1.5 * image[..., 0]) & (image[..., 1] > 1.5 * image[..., 2])).mean() > 0.3
    assert is_orange(image).mean() > 0.03


def test_generated_ground_is_drawn_relative_to_each_environment(tmp_path: Path) -> None:
    recording = Recording(write_recording(tmp_path / "r.rrd", env_ids=(0, 3), tile=True))
    for env_id, x in ((0, 2.0), (3, 0.0)):  # The tile is below the origin of the second environment.
        (tile,) = scenery(recording, env_id).scene.fixed
        np.testing.assert_allclose(tile.pos, (x, 0.0, -0.01), atol=1e-6)


def test_the_moment_of_a_term_is_searched_in_every_environment(tmp_path: Path) -> None:
    writer = Writer(tmp_path / "r.rrd")
    for env_id, fell_at in ((0, 40), (3, 25), (7, 60)):
        fired = np.arange(1, 61) == fell_at
        writer.numbers(f"env_{env_id}/terminations/fell", fired, None, None, np.arange(60) // 30)
    recording = Recording(writer.close())
    assert recording_pictures.first_env(recording, "terminations.fell") == 3
    assert recording_pictures.first_env(recording, "terminations.fell", iteration=1) == 0
    assert recording_pictures.first_env(recording, "1.5s") is None
    assert recording_pictures.first_env(recording, "terminations.never") is None
