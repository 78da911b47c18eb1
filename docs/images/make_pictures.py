"""Renders the pictures of the docs with MuJoCo's offscreen renderer.

    MUJOCO_GL=egl python docs/images/make_pictures.py

A machine without a graphics card needs a software driver (Debian: libegl1 libgl1-mesa-dri).
"""

from __future__ import annotations

from pathlib import Path

import mujoco
from PIL import Image

from wheelleg_exp.build import prepare_asset
from wheelleg_exp.config.composing.compose import compose
from wheelleg_exp.sim.terrain import GROUND

WIDTH, HEIGHT = 1200, 675


def standing_scene() -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the robot on a checkered floor, in its default pose and standing on its wheels."""
    composed = compose(["task=stand"])
    spec = mujoco.MjSpec.from_file(str(prepare_asset(composed.config).output))
    for key in list(spec.keys):
        spec.delete(key)
    grid = spec.add_texture(
        name="grid", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        width=512, height=512, rgb1=[0.86, 0.88, 0.90], rgb2=[0.78, 0.81, 0.84],
    )  # fmt: skip
    material = spec.add_material(name="grid", texrepeat=[16, 16], reflectance=0.08)
    material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = grid.name
    spec.worldbody.add_geom(
        name=GROUND, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.05], material="grid", contype=0, conaffinity=0
    )
    spec.worldbody.add_light(pos=[0.4, -0.4, 0.8], dir=[-0.4, 0.4, -0.8], castshadow=True)
    sky = spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        width=64, height=384, rgb1=[0.95, 0.97, 1.0], rgb2=[0.72, 0.80, 0.90],
    )  # fmt: skip
    del sky
    spec.visual.global_.offwidth, spec.visual.global_.offheight = WIDTH, HEIGHT
    spec.visual.quality.shadowsize = 4096
    spec.visual.map.znear = 0.01
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:7] = [0, 0, 0.06995, 1, 0, 0, 0]
    for name, value in (("01", 0.9599), ("02", -1.8850), ("03", 0.3)):
        for side in "lr":
            data.qpos[model.joint(f"{side}{name}").qposadr[0]] = value
    mujoco.mj_forward(model, data)
    return model, data


def main() -> None:
    """Write robot.png beside this file."""
    model, data = standing_scene()
    options = mujoco.MjvOption()
    options.geomgroup[:] = [1, 1, 1, 0, 0, 0]
    camera = mujoco.MjvCamera()
    camera.lookat[:] = [0.0, 0.0, 0.045]
    camera.distance, camera.azimuth, camera.elevation = 0.30, 142, -14
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        renderer.update_scene(data, camera, options)
        Image.fromarray(renderer.render()).save(Path(__file__).with_name("robot.png"))


if __name__ == "__main__":
    main()
