"""Run commands in forks of this process; each fork kills itself with SIGKILL during a named operation.

A line of standard input is a point and the words of a command, as JSON. The answer is the exit status of the fork.
"""

from __future__ import annotations

import json
import os
import signal
import sys

from wheelleg_exp.machine import prepare_threads

prepare_threads()


def kill() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def plant(point: str) -> None:
    """Let the process die at a point: ``source``, ``checkpoint:1``, ``torn:2`` or ``manifest``."""
    from wheelleg_exp.jobs.train import prepare_training, training_outputs
    from wheelleg_exp.run import manifest
    from wheelleg_exp.run import start_run as snapshot

    what, _, number = point.partition(":")
    write, checkpoint = training_outputs.Outputs.write, training_outputs.Outputs.checkpoint

    def half_a_checkpoint(path, data):
        if path.name == f"model_{number}.pt":
            path.with_name(f".{path.name}.0123456789ab.tmp").write_bytes(data[: len(data) // 2])
            kill()
        path.write_bytes(data)

    def torn(self, iteration, due):
        done = write(self, iteration, due)
        if iteration.index == int(number):
            path = self._directory.iterations
            text = path.read_bytes()
            path.write_bytes(text[: text.rindex(b'"scalars"')])
            for path in (training_outputs.event_files(self._directory.path)[-1], self._directory.recording):
                data = path.read_bytes()
                path.write_bytes(data[:-25])
            steps, step = [], self._trainer.env.step

            def counted(actions):
                steps.append(1)
                if len(steps) == 10:
                    kill()
                return step(actions)

            self._trainer.env.step = counted
        return done

    if what == "source":
        snapshot.snapshot_source = lambda *_, **__: kill()
    elif what == "checkpoint":
        training_outputs.write_bytes = half_a_checkpoint
    elif what == "torn":
        training_outputs.Outputs.write = torn
        training_outputs.Outputs.checkpoint = lambda self, iteration: (
            checkpoint(self, iteration) if iteration < int(number) else ""
        )
    elif what == "manifest":
        prepare_training.Manifest.finish = lambda self, *_: (
            self.path.with_name(".manifest.json.0123456789ab.tmp").write_text("{"),
            kill(),
        )
        assert prepare_training.Manifest is manifest.Manifest


if __name__ == "__main__":
    import wheelleg_exp.jobs.train.resume_training
    import wheelleg_exp.jobs.train.run_training  # noqa: F401
    from wheelleg_exp.cli.main import main

    for line in sys.stdin:
        point, *words = json.loads(line)
        if (child := os.fork()) == 0:
            os.dup2(2, 1)
            signal.alarm(600)  # The alarm ends a fork that hangs.
            plant(point)
            sys.exit(main(words))
        os.write(1, b"%d\n" % os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
