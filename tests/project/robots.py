"""Wheeled robots as URDF files."""

from __future__ import annotations

import re
from pathlib import Path

BODY, LEG, RADIUS = 2.0, 0.2, 0.06  # mass of the body (kg), length of a leg (m), radius of a wheel (m)
LOW, HIGH = 0.2, 1.2  # limits of the hips, rad

_LEGS = """
  <link name="{side}_leg">
    <inertial><origin xyz="0 0 -0.1"/><mass value="0.3"/>
      <inertia ixx="0.001" iyy="0.001" izz="0.0002" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 -0.1"/><geometry><box size="0.02 0.02 0.15"/></geometry></collision>
  </link>
  <joint name="{side}_hip" type="revolute">
    <parent link="body"/><child link="{side}_leg"/><origin xyz="0 {y} 0"/><axis xyz="0 1 0"/>
    <limit lower="{low}" upper="{high}" effort="8" velocity="20"/>
  </joint>
  <link name="{side}_wheel">
    <inertial><mass value="0.2"/><inertia ixx="0.0002" iyy="0.0004" izz="0.0002" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin rpy="1.5707963267948966 0 0"/><geometry><cylinder radius="{radius}" length="0.02"/></geometry>
    </collision>{inside}
  </link>
  <joint name="{side}_axle" type="continuous">
    <parent link="{side}_leg"/><child link="{side}_wheel"/><origin xyz="0 0 -{leg}"/><axis xyz="0 1 0"/>
  </joint>
"""


def urdf(folder: Path, inside: str = "", name: str = "two") -> Path:
    """Write the robot; ``inside`` is XML inside the links of the wheels."""
    legs = "".join(
        _LEGS.format(side=side, y=y, low=LOW, high=HIGH, radius=RADIUS, leg=LEG, inside=inside)
        for side, y in (("l", 0.08), ("r", -0.08))
    )
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.urdf"
    path.write_text(
        f'''<?xml version="1.0"?>
<robot name="{name}">
  <link name="body">
    <inertial><mass value="{BODY}"/><inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.2 0.1 0.1"/></geometry></collision>
  </link>{legs}</robot>
'''
    )
    return path


def edited(path: Path, *changes: tuple[str, str]) -> Path:
    """Replace texts in a file."""
    text = path.read_text()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    path.write_text(text)
    return path


def along_y(path: Path) -> Path:
    def turned(match: re.Match[str]) -> str:
        x, y, z = (float(part) for part in match[2].split())
        return f'{match[1]}="{-y} {x} {z}"'

    path.write_text(re.sub(r'(xyz)="([^"]+)"', turned, path.read_text()))
    inertia = ('ixx="0.0002" iyy="0.0004"', 'ixx="0.0004" iyy="0.0002"')
    rotation = ('rpy="1.5707963267948966 0 0"', 'rpy="0 1.5707963267948966 0"')
    return edited(path, inertia, rotation, ('"0.2 0.1 0.1"', '"0.1 0.2 0.1"'))


def knees(folder: Path) -> Path:
    """Write the robot with a knee in the middle of each leg, and with hips and knees that turn both ways."""
    path = urdf(folder, name="knees")
    text = path.read_text().replace(f'lower="{LOW}" upper="{HIGH}"', 'lower="-1.5" upper="1.5"')
    for side in "lr":
        shank = f'''
  <link name="{side}_shank">
    <inertial><origin xyz="0 0 -0.05"/><mass value="0.2"/>
      <inertia ixx="0.0005" iyy="0.0005" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0 -0.05"/><geometry><box size="0.02 0.02 0.06"/></geometry></collision>
  </link>
  <joint name="{side}_knee" type="revolute">
    <parent link="{side}_leg"/><child link="{side}_shank"/><origin xyz="0 0 -{LEG}"/><axis xyz="0 1 0"/>
    <limit lower="-2.5" upper="2.5" effort="8" velocity="20"/>
  </joint>'''
        text = text.replace(f'<link name="{side}_wheel">', f'{shank}\n  <link name="{side}_wheel">')
        text = text.replace(f'<parent link="{side}_leg"/><child link="{side}_wheel"/>',
                            f'<parent link="{side}_shank"/><child link="{side}_wheel"/>')  # fmt: skip
    path.write_text(text)
    return path


def tetrahedron(path: Path, size: float = 0.05) -> Path:
    """Write a tetrahedron mesh as an OBJ file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    points = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    corners = "".join(f"v {x * size} {y * size} {z * size}\n" for x, y, z in points)
    path.write_text(f"{corners}f 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    return path


def with_hip_yaw(folder: Path, limit: str = '<limit lower="-0.7" upper="0.7" effort="8" velocity="20"/>') -> Path:
    """Write ``knees`` with an unlimited vertical joint above each leg, although the joint has a ``<limit>``."""
    path = knees(folder)
    text = path.read_text()
    for side, y in (("l", 0.08), ("r", -0.08)):
        yaw = f'''
  <link name="{side}_yaw_link">
    <inertial><mass value="0.1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="{side}_yaw" type="continuous">
    <parent link="body"/><child link="{side}_yaw_link"/><origin xyz="0 {y} 0"/><axis xyz="0 0 1"/>{limit}
  </joint>'''
        text = text.replace(f'<link name="{side}_leg">', f'{yaw}\n  <link name="{side}_leg">')
        text = text.replace(f'<parent link="body"/><child link="{side}_leg"/><origin xyz="0 {y} 0"/>',
                            f'<parent link="{side}_yaw_link"/><child link="{side}_leg"/>')  # fmt: skip
    path.write_text(text)
    return path


def four_legs(folder: Path, front: float = 0.2) -> Path:
    path = knees(folder)
    text = path.read_text().replace('<box size="0.2 0.1 0.1"/>', '<box size="0.5 0.1 0.1"/>')
    head, _, legs = text.partition("</link>")
    legs = legs.removesuffix("</robot>\n")
    hind = legs.replace('xyz="0 0.08 0"', 'xyz="-0.2 0.08 0"').replace('xyz="0 -0.08 0"', 'xyz="-0.2 -0.08 0"')
    knee = 'xyz="0 0 -{}"/><axis xyz="0 1 0"/>\n    <limit'
    fore = hind.replace('xyz="-0.2', 'xyz="0.2').replace(knee.format(LEG), knee.format(front))
    fore = fore.replace('"l_', '"fl_').replace('"r_', '"fr_')
    path.write_text(f"{head}</link>{hind}{fore}</robot>\n")
    return path
