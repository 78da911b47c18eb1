"""Ports for the page: one that somebody has is told with who that is, and with what to write instead."""

from __future__ import annotations

import os
import socket

import pytest

from jobs.small import wheelleg
from wheelleg_exp.errors import WheellegError
from wheelleg_exp.jobs.drive.drive_page import port_holder, require_free


@pytest.fixture
def busy():
    """A port that this process listens on."""
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        yield listening.getsockname()[1]


def test_a_port_in_use_is_told_with_who_has_it_and_another_to_take(busy):
    with pytest.raises(WheellegError) as told:
        require_free(busy, "the page")
    said = str(told.value)
    assert said.startswith(f"--port: port {busy}, for the page, is in use by ")
    assert f"process {os.getpid()}" in said
    assert "--port 0" in said
    assert "Errno" not in said


def test_who_has_a_port_is_found_among_files_that_are_closed_meanwhile():
    spare = os.open(os.devnull, os.O_RDONLY)
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        listening.listen()
        os.close(spare)  # to look takes this number for a moment, before that of the socket
        assert port_holder(listening.getsockname()[1]).endswith(f", process {os.getpid()}")


def test_nobody_has_a_port_that_is_free(busy):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        free = other.getsockname()[1]
    require_free(free, "the page")
    assert port_holder(free) == ""


@pytest.mark.parametrize("port", [-1, 65536])
def test_what_is_no_port_is_told(port):
    with pytest.raises(WheellegError, match=f"there is no port {port} for the page"):
        require_free(port, "the page")


@pytest.mark.train
def test_the_port_of_the_keys_is_the_one_after_the_pages(run, busy):
    said = wheelleg("play", "latest", "--drive", "--port", str(busy - 1), "env.commands.base_velocity.ranges={}")
    assert said.status == 2
    assert f"port {busy}, for the page's keys and gamepads, is in use by" in said.err
