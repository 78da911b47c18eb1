import os
import signal
import subprocess
import sys

import pytest
from patience import PATIENCE_S

from wheelleg_exp.errors import RunDirectoryError
from wheelleg_exp.run.run_lock import RunLock

HOLD = """
import sys, time
from pathlib import Path
from wheelleg_exp.run.run_lock import RunLock
RunLock(Path(sys.argv[1])).acquire()
print("held", flush=True)
time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path):
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_another_process_is_refused_with_the_pid_until_the_holder_is_killed(tmp_path, holder):
    with pytest.raises(RunDirectoryError, match=f"is being written by process {holder.pid} "), RunLock(tmp_path):
        pass
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    with RunLock(tmp_path, timeout_s=PATIENCE_S):
        pass


def test_one_process_cannot_take_it_twice_but_again_after_release(tmp_path):
    held = RunLock(tmp_path)
    for _ in range(2):
        with held, RunLock(tmp_path, name=".manifest.lock"):
            with pytest.raises(RunDirectoryError, match=f"process {os.getpid()} "):
                RunLock(tmp_path).acquire()
            with pytest.raises(RunDirectoryError, match="being written"):
                RunLock(tmp_path, timeout_s=0.05).acquire()


def test_a_missing_directory_is_reported(tmp_path):
    with pytest.raises(RunDirectoryError, match="cannot write"):
        RunLock(tmp_path / "missing").acquire()
