"""Child processes that are forks of one process with the imported packages, because importing torch takes 4 s.

The packages are third-party: a fork imports this project, and code of a test, from scratch.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import gc
import importlib
import os
import pickle
import runpy
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

PACKAGES = "torch._dynamo rsl_rl.runners torch.utils.tensorboard rerun hydra mujoco.batch pxr.Usd pyarrow onnx"
_SET_CHILD_SUBREAPER = 36  # linux/prctl.h
_MOST = 1 << 17  # bytes of a request
_LOCK = threading.Lock()
_Popen = subprocess.Popen


# --- the process of the tests ---


@contextmanager
def forking() -> Iterator[None]:
    """Start Python programs as forks, also those that this project starts. Only on Linux.

    A fork has the environment variables of its program, but torch has read those of the tests. Hashes of strings are
    equal in all forks, so two forks do not show that an order of a set changes a result.
    """
    if sys.platform != "linux" or subprocess.Popen is _Fork:
        yield
        return
    prctl = ctypes.CDLL(None).prctl
    with mock.patch("subprocess.Popen", _Fork):
        prctl(_SET_CHILD_SUBREAPER, 1)  # The forks become children of this process.
        try:
            yield
        finally:
            prctl(_SET_CHILD_SUBREAPER, 0)


class _Fork(_Popen):
    def _execute_child(
        self, args, executable, preexec_fn, close_fds, pass_fds, cwd, env, startupinfo, creationflags, shell, *rest
    ):
        pipes, (session, group) = rest[:6], rest[-2:]
        if args[0] != sys.executable or pass_fds or _program(args) is None:
            given = executable, preexec_fn, close_fds, pass_fds, cwd, env, startupinfo, creationflags, shell
            super()._execute_child(args, *given, *rest)
            return
        words, env = [os.fspath(word) for word in args], dict(os.environ if env is None else env)
        group = None if session else os.getpgrp() if group == -1 else group
        request = words, str(cwd or Path.cwd()), env, group
        ends = enumerate((pipes[0], pipes[3], pipes[5]))
        streams = [number if end == -1 else end for number, end in ends]
        with _LOCK:
            socket.send_fds(_server(), [pickle.dumps(request)], streams)
            self.pid = int(_server().recv(_MOST))
        self._child_created = True
        self._close_pipe_fds(*pipes)


@functools.cache
def _server() -> socket.socket:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    number = theirs.fileno()
    process = _Popen([sys.executable, "-P", __file__, str(number)], pass_fds=[number], process_group=0)
    theirs.close()
    atexit.register(lambda: (ours.close(), process.wait()))
    return ours


# --- the server and its forks ---


def _serve(channel: socket.socket) -> None:
    for name in PACKAGES.split():
        importlib.import_module(name)
    gc.freeze()  # The end of a fork does not search all modules for garbage.
    while True:
        data, streams, *_ = socket.recv_fds(channel, _MOST, 3)
        if not data:
            return
        reader, writer = os.pipe()
        if (parent := os.fork()) == 0:
            if os.fork():
                os._exit(0)
            words, cwd, env, group = pickle.loads(data)
            os.setsid() if group is None else os.setpgid(0, group)
            os.write(writer, b"%d" % os.getpid())
            for stream, number in zip(streams, range(3), strict=True):
                os.dup2(stream, number)
            for file in (*streams, reader, writer, channel.detach()):
                os.close(file)
            _become(words, cwd, env)
            return
        os.waitpid(parent, 0)
        channel.send(os.read(reader, 99))
        for file in (*streams, reader, writer):
            os.close(file)


def _become(words: Sequence[str], cwd: str, env: Mapping[str, str]) -> None:
    """Run a program of Python in this process."""
    os.chdir(cwd)
    own = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    os.environ.clear()
    os.environ.update(env)
    tempfile.tempdir = None
    kind, name, sys.argv = _program(words)
    added = [] if "-P" in words else [{"-c": "", "-m": cwd, "": str(Path(name).parent)}[kind]]
    added += filter(None, env.get("PYTHONPATH", "").split(os.pathsep))
    sys.path[:] = [*added, *(place for place in sys.path if place not in own)]
    if kind == "-c":
        exec(compile(name, "<string>", "exec"), {"__name__": "__main__"})
    elif kind == "-m":
        runpy.run_module(name, run_name="__main__", alter_sys=True)
    else:
        runpy.run_path(name, run_name="__main__")


def _program(words: Sequence[str]) -> tuple[str, str, list[str]] | None:
    """Return ``-c``, ``-m``, or "", its argument or a file, and ``sys.argv``; None for other options of Python."""
    rest = list(words[1:])
    if rest[:1] == ["-P"]:
        rest.pop(0)
    if rest[:1] in (["-c"], ["-m"]):
        return rest[0], rest[1], [rest[0], *rest[2:]]
    return None if not rest or rest[0].startswith("-") else ("", rest[0], rest)


if __name__ == "__main__":
    _serve(socket.socket(fileno=int(sys.argv[1])))
