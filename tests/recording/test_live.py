import contextlib
import os
import signal
import sys
import textwrap
from pathlib import Path

import pytest
import torch
from patience import wait_until

from wheelleg_exp.recording.reading.recording_digest import entity_digests
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.recording.writing.live_view import Follower, LiveView, viewer_command, viewer_environment
from wheelleg_exp.recording.writing.recorder import Recorder

pytestmark = pytest.mark.slow

STEPS = 120

# This fake viewer prints its process id, accepts connections and never reads. With "die", it stops after the first
# connection.
_VIEWER = """
    import os, socket, sys, time
    from pathlib import Path
    server = socket.create_server(("127.0.0.1", int(sys.argv[1])))
    Path(sys.argv[2]).write_text(str(os.getpid()))
    kept = []
    while True:
        kept.append(server.accept())
        if sys.argv[3] == "die" and len(kept) > 1:
            sys.exit(0)
"""


@pytest.fixture(scope="module")
def env(make_env):
    return make_env(num_envs=2)


def viewer(tmp_path: Path, manner: str) -> list[str]:
    return [sys.executable, "-c", textwrap.dedent(_VIEWER), "{port}", str(tmp_path / "pid"), manner]


def end_viewer(tmp_path: Path) -> None:
    pid = tmp_path / "pid"
    if pid.exists():
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(pid.read_text()), signal.SIGKILL)


def rolled(env, path: Path, command: list[str] | None, *, wait_for: Path | None = None) -> dict[str, str]:
    env.common_step_counter = 0
    env.reset(seed=0)
    env.event_manager.fired.clear()
    recorder = Recorder(path, env, recording_id="r", name="n", env_ids=[0], purpose="play", flush_every=20)
    env.observers = [recorder.capture]
    recorder.start()
    recorder.flush()
    live = None if command is None else LiveView(recorder, command)
    if wait_for is not None:
        assert wait_until(wait_for.exists)
    with torch.inference_mode():
        for _ in range(STEPS):
            env.step(torch.zeros(2, 6))
    recorder.close()
    if live is not None:
        live.close()
    env.observers = []
    return entity_digests(path)


@pytest.fixture(scope="module")
def alone(env, tmp_path_factory) -> dict[str, str]:
    return rolled(env, tmp_path_factory.mktemp("alone") / "r.rrd", None)


@pytest.mark.parametrize("manner", ["hang", "die", "missing"])
def test_a_viewer_that_hangs_dies_or_is_missing_does_not_change_a_recording(env, alone, tmp_path, manner):
    path, missing = tmp_path / "r.rrd", manner == "missing"
    command = [str(tmp_path / "none")] if missing else viewer(tmp_path, manner)
    assert rolled(env, path, command, wait_for=None if missing else tmp_path / "pid") == alone
    assert len(Recording(path).table("base/height")) == STEPS
    end_viewer(tmp_path)


def test_a_viewer_is_opened_for_this_machine_alone_and_sends_nothing():
    command, surroundings = viewer_command(5), viewer_environment()
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    assert surroundings["CI"] == "true"  # CI=true disables rerun's analytics.
    assert surroundings["HTTPS_PROXY"] == surroundings["https_proxy"] == "http://127.0.0.1:9"


def pieces(follower: Follower) -> list[tuple[str, int, bool]]:
    return [(chunk.entity_path, chunk.num_rows, not chunk.is_static) for _, chunk in follower.chunks()]


def test_the_follower_gives_each_whole_message_once(env, tmp_path):
    path = tmp_path / "r.rrd"
    rolled(env, path, None)
    data, growing = path.read_bytes(), tmp_path / "growing.rrd"
    growing.write_bytes(data[:12])
    follower, found = Follower(growing), []
    for end in range(12, len(data) + 90_000, 90_000):
        with growing.open("ab") as file:
            file.write(data[growing.stat().st_size : end])
        found += pieces(follower)
    assert sorted(found) == sorted(pieces(Follower(path)))
    assert sum(n for entity, n, moving in found if entity == "/base/height" and moving) == STEPS
