"""Ports of the drive page."""

import socket

import pytest

from jobs.small import refused
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.jobs.drive.drive_page import require_free


@pytest.fixture
def busy():
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        yield listening.getsockname()[1]


def test_a_port_in_use_is_reported_with_other_ports(busy):
    with pytest.raises(WheellegError, match=rf"^--port: port {busy}, for the page, is in use; .* or --port 0"):
        require_free(busy, "the page")


@pytest.mark.parametrize("port", [-1, 65536])
def test_an_invalid_port_is_rejected(port):
    with pytest.raises(WheellegError, match=f"the port {port} for the page is not a valid TCP port"):
        require_free(port, "the page")


@pytest.mark.train
def test_the_port_of_the_keys_is_the_one_after_the_pages(run, busy):
    said = refused("play", "latest", "--drive", "--port", str(busy - 1), "env.commands.base_velocity.ranges={}")
    assert f"port {busy}, for the page's keys and gamepads, is in use" in said
