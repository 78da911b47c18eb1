"""Draw films of shipped policies: ``python docs/images/make_skill_pictures.py [NAME ...]`` writes ``NAME.webp``.

A machine without a graphics card needs a software driver (Debian: libegl1 libgl1-mesa-dri).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import av

HERE = Path(__file__).parent
FILMS = {
    "get_up": ("seed=5", "env.episode_length_s=2.0", "env.events.reset_lying.share=1.0"),  # begins upside down
    "jump": ("seed=3", "env.episode_length_s=6.0", "env.commands.base_velocity.rel_standing_envs=0.0"),
    "height": ("seed=3", "env.episode_length_s=5.0", "env.commands.base_pose.resampling_time_range=[1.0,1.0]"),
}


def main(name: str) -> None:
    """Play the policy in a temporary folder, and write the film to this folder."""
    with tempfile.TemporaryDirectory() as folder:

        def wheelleg(*words: str) -> None:
            subprocess.run([Path(sys.executable).with_name("wheelleg"), *words], cwd=folder, check=True)

        wheelleg("play", f"stock:{name}", "env.num_envs=1", *FILMS[name])
        [recording] = Path(folder).rglob("recording.rrd")
        wheelleg(
            "inspect", str(recording), *("--video", "film.mp4", "--width", "480", "--height", "300", "--fps", "12")
        )
        with av.open(str(Path(folder) / "film.mp4")) as film:
            frames = [frame.to_image() for frame in film.decode(video=0)]
    frames[0].save(HERE / f"{name}.webp", append_images=frames[1:], save_all=True, duration=83, loop=0, quality=60)


if __name__ == "__main__":
    for chosen in sys.argv[1:] or FILMS:
        main(chosen)
