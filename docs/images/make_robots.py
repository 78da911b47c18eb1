"""Renders what the converter makes of a corpus of USD robots: robots.png.

    MUJOCO_GL=egl python docs/images/make_robots.py --corpus DIR NAME [NAME ...]

A corpus is a folder with ``expected/NAME.json``, each of which names its asset (see docs/converters.md).
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from wheelleg_exp.asset import convert

TILE, COLUMNS = 360, 4


def scene(mjcf: Path) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return a robot in front of a light sky, in its saved pose."""
    spec = mujoco.MjSpec.from_file(str(mjcf))
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        width=64, height=384, rgb1=[0.97, 0.98, 1.0], rgb2=[0.80, 0.86, 0.93],
    )  # fmt: skip
    spec.visual.global_.offwidth = spec.visual.global_.offheight = TILE
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.45] * 3, [0.5] * 3
    model = spec.compile()
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return model, data


def picture(mjcf: Path) -> Image.Image:
    """Return one robot, its visuals and what collides, from the front left."""
    return drawn(*scene(mjcf))


def drawn(model: mujoco.MjModel, data: mujoco.MjData) -> Image.Image:
    """Return a picture of a robot in the pose of ``data``, from the front left."""
    boxes = [data.xpos[i] for i in range(1, model.nbody)]
    low, high = np.min(boxes, axis=0), np.max(boxes, axis=0)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (low + high) / 2
    camera.distance, camera.azimuth, camera.elevation = 1.6 * float(np.linalg.norm(high - low)) + 0.05, 145, -18
    options = mujoco.MjvOption()
    options.geomgroup[:] = [1, 1, 1, 1, 0, 0]
    with mujoco.Renderer(model, TILE, TILE) as renderer:
        renderer.update_scene(data, camera, options)
        return Image.fromarray(renderer.render())


def main() -> None:
    """Convert the named robots and write robots.png beside this file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--corpus", type=Path, required=True)
    parser.add_argument("names", nargs="+")
    args = parser.parse_args()
    rows = -(-len(args.names) // COLUMNS)
    sheet = Image.new("RGB", (TILE * COLUMNS, TILE * rows), "white")
    for index, name in enumerate(args.names):
        asset = json.loads((args.corpus / "expected" / f"{name}.json").read_text())["asset"]
        with tempfile.TemporaryDirectory() as folder:
            tile = picture(convert(args.corpus / asset, Path(folder) / f"{name}.xml").output)
        sheet.paste(tile, (TILE * (index % COLUMNS), TILE * (index // COLUMNS)))
    sheet.quantize(256).save(Path(__file__).with_name("robots.png"), optimize=True)


if __name__ == "__main__":
    main()
