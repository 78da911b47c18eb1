"""Draw ``get_up.webp``, a film of the policy ``stock:get_up``: ``python docs/images/make_skill_pictures.py``.

A machine without a graphics card needs a software driver (Debian: libegl1 libgl1-mesa-dri).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import av

HERE = Path(__file__).parent
SEED = 5  # The robot starts upside down.
PLAY = ("play", "stock:get_up", "env.num_envs=1", f"seed={SEED}", "env.episode_length_s=2.0")


def main() -> None:
    """Play the policy in a temporary folder, and write the film to this folder."""
    with tempfile.TemporaryDirectory() as folder:

        def wheelleg(*words: str) -> None:
            subprocess.run([Path(sys.executable).with_name("wheelleg"), *words], cwd=folder, check=True)

        wheelleg(*PLAY, "env.events.reset_lying.share=1.0")
        [recording] = Path(folder).rglob("recording.rrd")
        wheelleg(
            "inspect", str(recording), *("--video", "film.mp4", "--width", "480", "--height", "300", "--fps", "20")
        )
        with av.open(str(Path(folder) / "film.mp4")) as film:
            frames = [frame.to_image() for frame in film.decode(video=0)]
    frames[0].save(HERE / "get_up.webp", append_images=frames[1:], save_all=True, duration=50, loop=0, quality=60)


if __name__ == "__main__":
    main()
