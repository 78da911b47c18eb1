"""Convert a USD file with mujoco-usd: ``python mujoco_usd_worker.py IN.usd OUT.xml``."""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco

spec = mujoco.MjSpec.from_file(sys.argv[1])
spec.compile()
Path(sys.argv[2]).write_text(spec.to_xml(), encoding="utf-8")
