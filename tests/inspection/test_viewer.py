import http.client
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from inspection.written import write_recording
from patience import PATIENCE_S, wait_until
from PIL import Image

from wheelleg_exp.child_process import end_program
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.inspection import rerun_viewer
from wheelleg_exp.inspection.rerun_viewer import WebViewer
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.recording.writing.live_view import free_port
from wheelleg_exp.rendering.renderer import NoGraphics

pytestmark = pytest.mark.pictures

psutil = pytest.importorskip("psutil", reason="psutil looks at what a process listens on")


@pytest.fixture(scope="module")
def fetched() -> rerun_viewer.Files:
    return rerun_viewer.viewer_files()


@pytest.fixture
def files(fetched: rerun_viewer.Files, monkeypatch) -> rerun_viewer.Files:
    monkeypatch.setattr(rerun_viewer, "viewer_files", lambda: fetched)
    return fetched


@pytest.fixture
def served(played: Recording, files: rerun_viewer.Files) -> Iterator[WebViewer]:
    with WebViewer(played.path) as running:
        yield running


def ask(port: int, path: str, host: str | None = None, method: str = "GET") -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    try:
        connection.request(method, path, headers={"Host": host or f"127.0.0.1:{port}"})
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        connection.close()


def listening(pid: int, *, family: bool = True) -> set[str]:
    processes = [psutil.Process(pid), *(psutil.Process(pid).children(recursive=True) if family else [])]
    found = [c for process in processes for c in process.net_connections(kind="inet")]
    return {connection.laddr.ip for connection in found if connection.status == psutil.CONN_LISTEN}


def elsewhere(pid: int) -> set[str]:
    family = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
    found = [c.raddr.ip for process in family for c in process.net_connections(kind="inet") if c.raddr]
    return {ip for ip in found if ip not in ("127.0.0.1", "::1")}


def test_the_page_shows_the_recording_and_asks_nothing_of_other_machines(served: WebViewer) -> None:
    status, headers, _ = ask(served.port, "/")
    assert status == 302
    target = headers["Location"]
    assert target.startswith(f"{served.url}?url=http%3A%2F%2F127.0.0.1%3A{served.port}%2Frecording.rrd&")
    status, headers, page = ask(served.port, target.removeprefix(served.url.rstrip("/")))
    assert status == 200
    assert b"re_viewer.js" in page
    assert b"fonts.g" not in page  # rerun's own page loads a font from Google.
    policy = dict(part.split(" ", 1) for part in headers["Content-Security-Policy"].split("; "))
    assert policy["default-src"] == "'none'"
    assert policy["connect-src"] == "'self' data: blob:"


def test_the_recording_is_served_unchanged_on_the_loopback_address_only(served: WebViewer, played: Recording) -> None:
    status, headers, body = ask(served.port, "/recording.rrd")
    assert (status, body) == (200, Path(played.path).read_bytes())
    assert int(headers["Content-Length"]) == len(body)
    status, headers, nothing = ask(served.port, "/recording.rrd", method="HEAD")
    assert (status, nothing, int(headers["Content-Length"])) == (200, b"", len(body))
    assert listening(os.getpid(), family=False) == {"127.0.0.1"}  # Child processes are browsers of other tests.


def test_a_recording_that_grows_is_served_up_to_where_it_is(files, tmp_path: Path) -> None:
    path = write_recording(tmp_path / "growing.rrd")
    with WebViewer(path) as running:
        before = len(ask(running.port, "/recording.rrd")[2])
        with path.open("ab") as file:
            file.write(b"more")
        assert len(ask(running.port, "/recording.rrd")[2]) == before + 4
        path.unlink()
        assert ask(running.port, "/recording.rrd")[0] == 404


@pytest.mark.parametrize("path", ["/../../etc/passwd", "/etc/passwd", "/recording.rrd/..", "//etc/passwd", "/%2e%2e/x"])
def test_nothing_else_is_served(served: WebViewer, path: str) -> None:
    assert ask(served.port, path)[0] == 404


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1", "127.0.0.1:1"])
def test_a_page_of_another_name_reads_nothing(served: WebViewer, host: str) -> None:
    status, _, body = ask(served.port, "/recording.rrd", host=host)
    assert (status, body) == (403, b"")


def test_a_port_in_use_is_reported(files, played: Recording) -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        with pytest.raises(WheellegError, match="cannot listen on"):
            WebViewer(Path(played.path), holder.getsockname()[1])
    with pytest.raises(WheellegError, match="cannot listen on"):
        WebViewer(Path(played.path), 70000)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_serves_until_it_is_interrupted(played: Recording, number: signal.Signals) -> None:
    words = [sys.executable, "-m", "wheelleg_exp.cli.main", "inspect", str(played.path), "--web", "--no-browser"]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        port = int(line.rstrip().rstrip("/").rsplit(":", 1)[1])
        assert ask(port, "/recording.rrd")[0] == 200
        assert listening(process.pid) == {"127.0.0.1"}
        children = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(number)
        assert process.wait(PATIENCE_S) == 0
        assert process.stderr is not None
        assert process.stderr.read() == ""
        assert not [child for child in children if child.is_running()]
    finally:
        process.kill()
        process.communicate()


def test_a_viewer_listens_for_this_machine_only_and_talks_to_nobody(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)
    port = free_port()
    with rerun_viewer.viewer(["--headless", "--port", str(port)]) as (process, said):
        assert wait_until(lambda: listening(process.pid) or process.poll() is not None)
        if process.poll() is not None:
            pytest.skip(f"no viewer: {rerun_viewer.failure_line(said)}")
        assert listening(process.pid) == {"127.0.0.1"}
        seen = set()
        for _ in range(20):
            seen |= elsewhere(process.pid)
            time.sleep(0.05)
        assert seen == set()
        pid = process.pid
    assert not psutil.pid_exists(pid)
    assert not [path for path in tmp_path.rglob("*rerun*") if path.is_dir() and "config" in str(path)]


def test_ending_a_viewer_ends_what_it_started() -> None:
    code = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import time; time.sleep(600)'])"
    process = subprocess.Popen([sys.executable, "-c", code], start_new_session=True)
    children = wait_until(psutil.Process(process.pid).children)
    end_program(process)
    psutil.wait_procs(children, timeout=PATIENCE_S)
    assert children
    assert not [child for child in children if child.is_running() and child.status() != "zombie"]


def test_the_viewer_is_drawn_without_a_window(played: Recording, tmp_path: Path) -> None:
    path = tmp_path / "viewer.png"
    try:
        rerun_viewer.viewer_screenshot(Path(played.path), path, time_s=0.5, width=800, height=500)
    except NoGraphics as error:
        pytest.skip(str(error))
    with Image.open(path) as image:
        assert image.size == (800, 500)
        pixels = np.asarray(image.convert("RGB")).astype(int)
    orange = (pixels[..., 0] > 1.4 * pixels[..., 1]) & (pixels[..., 1] > 1.5 * pixels[..., 2]) & (pixels[..., 0] > 100)
    assert orange.mean() > 0.002  # the robot's shell


def test_a_viewer_without_a_driver_names_the_package(played: Recording, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("VK_DRIVER_FILES", "/nowhere.json")
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nowhere.json")
    with pytest.raises(WheellegError) as caught:
        rerun_viewer.viewer_screenshot(Path(played.path), tmp_path / "viewer.png", time_s=None)
    assert "apt install mesa-vulkan-drivers libvulkan1" in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["viewer.jpg", "taken.png"])
def test_a_wrong_picture_path_is_reported_before_a_viewer_starts(played, tmp_path, monkeypatch, name: str) -> None:
    (tmp_path / "taken.png").write_bytes(b"mine")
    monkeypatch.setattr(rerun_viewer, "viewer", lambda *_: pytest.fail("started"))
    with pytest.raises(WheellegError):
        rerun_viewer.viewer_screenshot(Path(played.path), tmp_path / name, time_s=None)
    assert (tmp_path / "taken.png").read_bytes() == b"mine"
