import os
import shutil
import struct
import zlib

import numpy as np
import pytest
import torch
from matplotlib.image import imsave

from sim.small_envs import ASSETS, env_config, env_of
from sim.terrain.tiles import TERRAIN
from wheelleg_exp.errors import ConfigError, WheellegError

MATERIAL = {"static_friction": 0.5, "dynamic_friction": 0.4, "restitution": 0.0}


@pytest.fixture
def ground(tmp_path):
    shutil.copy(ASSETS / "block.xml", tmp_path)
    (tmp_path / "ground").mkdir()

    def make(kind: str, **options):
        node = {"_target_": TERRAIN + kind, **MATERIAL, **options}
        return env_of(tmp_path / "block.xml", env_config("block", scene={"terrain": node})).scene.terrain

    make.folder = tmp_path / "ground"
    return make


def test_an_array_gives_heights_along_x_and_y(ground):
    np.save(ground.folder / "hills.npy", np.array([[0, 0, 0], [0, 1, 2]], dtype=np.int16))
    made = ground("HeightField", file="hills.npy", size=[2.0, 4.0], height_range=[0.1, 0.3])
    points = torch.tensor([[-1.0, 0.0], [1.0, 0.0], [1.0, 2.0], [0.0, 0.0], [1.0, 1.0], [5.0, 0.0]])
    torch.testing.assert_close(made.height_at(points), torch.tensor([0.1, 0.3, 0.5, 0.2, 0.4, 0.0]))
    random = torch.rand(500, 2) * torch.tensor([2.0, 4.0]) - torch.tensor([1.0, 2.0])
    torch.testing.assert_close(made.height_at(random), made.probe.height_at(random), atol=2e-6, rtol=0)


def test_a_picture_is_a_map(ground):
    picture = np.zeros((3, 5, 3))
    picture[0, 4] = 1.0
    imsave(ground.folder / "map.png", picture)
    made = ground("HeightField", file="map.png", size=[4.0, 2.0], height_range=[-0.1, 0.9])
    corners = torch.tensor([[2.0, 1.0], [-2.0, 1.0], [2.0, -1.0], [-2.0, -1.0]])
    torch.testing.assert_close(made.height_at(corners), torch.tensor([0.9, -0.1, -0.1, -0.1]))


ROOF = """v 1 1 0\nv 5 1 0\nv 5 3 0\nv 1 3 0\nv 3 1 1\nv 3 3 1
f 1 5 6\nf 1 6 4\nf 5 2 3\nf 5 3 6\n"""


def test_heights_of_a_mesh_are_those_seen_from_above(ground):
    (ground.folder / "roof.obj").write_text(ROOF)
    made = ground("Mesh", file="roof.obj", horizontal_scale=0.1, scale=0.5, start=[[1.5, 1.0], [1.0, 1.0]])
    x, y = (torch.rand(400) * 2 + 0.5).clamp(0.51, 2.49), torch.rand(400) * 0.98 + 0.51
    expected = 0.5 * (1 - (2 * x - 3).abs() / 2)
    torch.testing.assert_close(made.height_at(torch.stack((x, y), dim=1)), expected, atol=1e-5, rtol=0)
    origins = torch.tensor([[1.5, 1.0, 0.5], [1.0, 1.0, 0.25]])
    torch.testing.assert_close(made.env_origins[:2], origins, atol=1e-5, rtol=0)
    assert torch.equal(made.env_origins[2:], made.env_origins[:2])
    assert made.terrain_origins is None


def test_flat_patches_are_found_on_a_file(ground):
    heights = np.zeros((21, 21))
    heights[12:] = np.arange(9)[:, None]
    np.save(ground.folder / "edge.npy", heights)
    flat = {"_target_": TERRAIN + "FlatPatches", "num_patches": 50, "patch_radius": 0.1, "max_height_diff": 0.01}
    made = ground("HeightField", file="edge.npy", size=[2.0, 2.0], height_range=None, flat_patches={"goal": flat})
    places = made.flat_patches["goal"]
    assert places.shape == (1, 1, 50, 3)
    assert places[..., 0].max() < 0.1 + 0.01
    assert places[..., 0].min() < -0.8
    assert not places[..., 2].any()


FIELD = {"size": [1.0, 1.0], "height_range": None}
NOT_HEIGHTS = r"file: 'a.npy' contains .*rows and columns of finite numbers"


@pytest.mark.parametrize(
    ("kind", "file", "content", "words"),
    [
        ("HeightField", "a.npz", b"", r"'a.npz' is not a file of a ground.*ends in .npy or .png.*'.npy'"),
        ("HeightField", "a.npy", b"no", r"file: the file 'a.npy' is not a NumPy array"),
        ("HeightField", "a.png", b"no", r"file: the file 'a.png' is not a readable image"),
        ("Mesh", "a.obj", b"v 0 0 0", r"file: the file 'a.obj' is not a readable mesh"),
        ("HeightField", "../a.npy", None, "a file's path below a folder"),
        *(("HeightField", "a.npy", np.zeros(shape), NOT_HEIGHTS) for shape in (3, (1, 5))),
        ("HeightField", "a.npy", np.full((2, 2), np.nan), NOT_HEIGHTS),
        ("HeightField", "a.npy", np.zeros((2, 2), dtype=complex), NOT_HEIGHTS),
    ],
)
def test_wrong_files_are_rejected(ground, kind, file, content, words):
    if isinstance(content, bytes):
        (ground.folder / file).write_bytes(content)
    elif content is not None:
        np.save(ground.folder / file, content)
    with pytest.raises(ConfigError, match=words):
        ground(kind, file=file, **(FIELD if kind == "HeightField" else {"horizontal_scale": 0.1}))


def test_a_picture_is_refused_before_it_is_decoded(ground):
    packer = zlib.compressobj()
    rows = b"".join(packer.compress(bytes(25_001)) for _ in range(25_000)) + packer.flush()
    parts = ((b"IHDR", struct.pack(">IIBBBBB", 25_000, 25_000, 8, 0, 0, 0, 0)), (b"IDAT", rows), (b"IEND", b""))
    chunks = (struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in parts)
    (ground.folder / "wide.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))
    with pytest.raises(ConfigError, match="not a readable image of at most 33,554,432 pixels"):
        ground("HeightField", file="wide.png", **FIELD)


def test_a_pipe_is_no_ground(ground):
    os.mkfifo(ground.folder / "pipe.png")
    with pytest.raises(WheellegError, match="not an ordinary file"):
        ground("HeightField", file="pipe.png", **FIELD)
