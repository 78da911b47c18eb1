"""Processes of a distributed training, with torchrun's environment variables but without torchrun."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from patience import PATIENCE_S

SIZE = 2
_OF_NOBODY = 20000, 32000
# A line of the answer is one command's exit status. After an error, a process cannot train, so "fork" goes first.
_SCRIPT = """
import json, os, sys
import wheelleg_exp.rl.ranks
from wheelleg_exp.cli.main import main

for words, port in zip(json.loads(sys.argv[1]), json.loads(sys.argv[2]), strict=True):
    os.environ["MASTER_PORT"] = str(port)
    if words[0] != "fork":
        status = main(words)
    elif child := os.fork():
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    else:
        os._exit(main(words[1:]))
    print("status", status, flush=True)
"""


def start(commands: Sequence[Sequence[str]], folder: Path, script: str = _SCRIPT) -> list[subprocess.Popen[str]]:
    """Start the processes; each process executes the commands one after another, in ``folder``."""
    ports = json.dumps(_free_ports(len(commands)))
    shared = {"WORLD_SIZE": str(SIZE), "LOCAL_WORLD_SIZE": str(SIZE), "MASTER_ADDR": "127.0.0.1"}
    words = json.dumps([[str(word) for word in command] for command in commands])
    return [
        subprocess.Popen(
            # With -R, the second process is not a fork, and has other hashes of strings.
            [sys.executable, *["-R"] * rank, "-c", script, words, ports],
            env={**os.environ, **shared, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            cwd=folder,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for rank in range(SIZE)
    ]


def end(processes: Sequence[subprocess.Popen[str]]) -> list[tuple[list[int], str, str]]:
    """Wait for the processes; return the exit statuses, remaining output, and errors of each process."""
    found = []
    try:
        for process in processes:
            out, err = process.communicate(timeout=PATIENCE_S)
            lines = out.splitlines()
            statuses = [int(line.split()[1]) for line in lines if line.startswith("status ")]
            found.append((statuses, "\n".join(line for line in lines if not line.startswith("status ")), err))
    finally:
        for process in processes:
            process.kill()
    return found


def _free_ports(count: int) -> list[int]:
    """Return ports that nobody is given who asks for any: who waits for one of those can be connected to itself."""
    found: list[int] = []
    while len(found) < count:
        port = _OF_NOBODY[0] + secrets.randbelow(_OF_NOBODY[1] - _OF_NOBODY[0])
        with contextlib.suppress(OSError), socket.socket() as tried:
            tried.bind(("127.0.0.1", port))
            found = sorted({*found, port})
    return found
