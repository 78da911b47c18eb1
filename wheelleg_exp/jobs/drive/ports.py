"""Ports of the loopback address: whether one is free, and who has it if not."""

from __future__ import annotations

import errno
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.recording.writing.feed import LOOPBACK

_PROC = Path("/proc")
_LISTENS = "0A"  # state of a socket in /proc/net/tcp


def require_free(port: int, use: str) -> None:
    """Raise WheellegError unless a port can be listened on, with who has it where the system tells.

    Args:
        port: the port; 0 is any that is free.
        use: what it is for, in words.
    """
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((LOOPBACK, port))
    except OverflowError as error:
        raise _refused(f"there is no port {port} for {use}", "0 to 65534") from error
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise taken(port, use) from error
        why = "is kept for the system's services" if error.errno == errno.EACCES else f"cannot be had: {error.strerror}"
        raise _refused(f"port {port}, for {use}, {why}", _FREE) from error


def taken(port: int, use: str) -> WheellegError:
    """Return what to tell of a port that somebody else has."""
    who = holder(port)
    return _refused(f"port {port}, for {use}, is in use" + (f" by {who}" if who else ""), _FREE)


_FREE = "another port, such as --port 8123, or --port 0 for any that is free"


def _refused(message: str, expected: str) -> WheellegError:
    return WheellegError(message, key="--port", expected=expected)


def holder(port: int) -> str:
    """Return name and number of the process that listens on a port; empty where the system does not tell."""
    sockets = {f"socket:[{inode}]" for inode in _listening(port)}
    for folder in _PROC.glob("[0-9]*/fd") if sockets else ():
        with suppress(OSError):  # of another user, or gone by now
            if any(_points_to(entry) in sockets for entry in folder.iterdir()):
                return f"{(folder.parent / 'comm').read_text().strip()}, process {folder.parent.name}"
    return ""


def _points_to(entry: Path) -> str:
    with suppress(OSError):  # closed by now, as what listed the folder is
        return str(entry.readlink())
    return ""


def _listening(port: int) -> Iterator[str]:
    """Yield the inodes of the sockets that listen on a port, proc_net(5)."""
    for name in ("tcp", "tcp6"):
        with suppress(OSError):
            for line in (_PROC / "self" / "net" / name).read_text().splitlines()[1:]:
                fields = line.split()
                if fields[3] == _LISTENS and int(fields[1].rpartition(":")[2], 16) == port:
                    yield fields[9]
