from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from patience import wait_until

from browser.chrome import Chrome
from wheelleg_exp.inspection.rerun_viewer import WebViewer
from wheelleg_exp.recording.reading.recording_reader import Recording
from wheelleg_exp.run.run_directory import RunDirectory

pytestmark = pytest.mark.browser

_WIDTH, _HEIGHT = 1100, 700


@pytest.fixture(scope="module")
def recording(played: RunDirectory) -> Recording:
    folder = min(played.play.iterdir())
    return Recording(folder / "recording.rrd")


@pytest.fixture(scope="module")
def address(recording: Recording) -> Iterator[str]:
    with WebViewer(recording.path) as served:
        yield served.url


@pytest.fixture(scope="module")
def pictures(chrome: Chrome, address: str, recording: Recording) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    chrome.size(_WIDTH, _HEIGHT)
    chrome.open(address)
    empty = chrome.picture()
    if not chrome.script("return !!document.createElement('canvas').getContext('webgl2')"):
        pytest.skip("this browser has neither WebGL nor a software renderer for it")
    wait_until(lambda: _robot(chrome.picture(), recording) > 500 and _lines(chrome.picture()) > 500, every_s=0.25)
    return empty, chrome.picture()


def test_the_robot_and_plots_are_on_screen(pictures, recording):
    empty, loaded = pictures
    assert len(np.unique(loaded.reshape(-1, 3), axis=0)) > 100
    assert np.mean(np.any(loaded != empty, axis=-1)) > 0.3
    assert (_robot(empty, recording), _lines(empty)) == (0, 0)
    assert min(_robot(loaded, recording), _lines(loaded)) > 500


def test_the_page_asks_only_its_own_server(pictures, chrome, address):
    assert {url.split("/")[2] for url in chrome.requests()} <= {address.split("/")[2], ""}


def _robot(picture: NDArray[np.uint8], recording: Recording) -> int:
    return _count(picture[:, : picture.shape[1] // 2], _colour(recording))


def _colour(recording: Recording) -> NDArray[np.float64]:
    packed = [
        colour
        for entity in recording.entities()
        if entity.startswith("world/")
        for colour in recording.static(entity).get("colors", [])
    ]
    colours = np.array([[c >> 24 & 255, c >> 16 & 255, c >> 8 & 255] for c in packed], dtype=float)
    # Only the robot has a warm colour. The floor, the sky, and the viewer's lines are grey and blue.
    return colours[np.argmax(colours[:, 0] - colours[:, 2])]


def _count(picture: NDArray[np.uint8], colour: NDArray[np.float64]) -> int:
    pixels = picture.astype(float)
    length = np.linalg.norm(pixels, axis=-1)
    alike = (pixels @ colour) / np.maximum(length * np.linalg.norm(colour), 1.0)
    return int(np.count_nonzero((alike > 0.985) & (length > 80)))


def _lines(picture: NDArray[np.uint8]) -> int:
    right = picture[40:-40, picture.shape[1] // 2 :].astype(int)
    return int(np.count_nonzero(right.max(axis=-1) - right.min(axis=-1) > 60))
