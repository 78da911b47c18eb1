"""Small URDF files, written by hand, and the MuJoCo models of the converted robots."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from wheelleg_exp.asset import Conversion, convert

from .small_usd import tensor as tensor

INERTIAL = """<inertial><mass value="1"/>
      <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>"""
BOX = '<collision><geometry><box size="0.2 0.2 0.2"/></geometry></collision>'
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"


def link(name: str, inside: str = "", inertial: str = INERTIAL) -> str:
    return f'  <link name="{name}">\n    {inertial}{inside}\n  </link>\n'


def inertial(mass: float, *, at: str = "0 0 0", rpy: str = "0 0 0", tensor: str = "0 0 0 0 0 0") -> str:
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    numbers = " ".join(f'{name}="{value}"' for name, value in zip(names, tensor.split(), strict=True))
    return f'<inertial><origin xyz="{at}" rpy="{rpy}"/><mass value="{mass}"/><inertia {numbers}/></inertial>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", inside: str = "") -> str:
    return f"""  <joint name="{name}" type="{kind}">
    <parent link="{parent}"/><child link="{child}"/>{inside}
  </joint>
"""


def write(folder: Path, inside: str, name: str = "bot") -> Path:
    path = folder / f"{name}.urdf"
    path.write_text(f'<?xml version="1.0"?>\n<robot name="{name}">\n{inside}</robot>\n')
    return path


def pair(kind: str = "revolute", inside: str = "", child: str = INERTIAL) -> str:
    return link("a") + link("b", inertial=child) + joint("j", "a", "b", kind, inside)


def made(folder: Path, inside: str, base: Any = "auto") -> tuple[mujoco.MjModel, Conversion]:
    conversion = convert(write(folder, inside), folder / "out.xml", base=base)
    return mujoco.MjModel.from_xml_path(str(conversion.output)), conversion


def at_zero(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the mass matrix (nv, nv)."""
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full


def assumed(conversion: Conversion, words: str) -> list[tuple[str, str]]:
    return [(item.path, item.value) for item in conversion.report.assumptions if words in item.rule]


def left(conversion: Conversion) -> dict[str, str]:
    return {f"{path} {item.name}": item.reason for item in conversion.report.left_out for path in item.values}
