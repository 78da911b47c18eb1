"""Run a command in a child process that kills itself with SIGKILL during a named operation."""

from __future__ import annotations

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
    from wheelleg_exp.cli.main import main

    plant(sys.argv[1])
    sys.exit(main(sys.argv[2:]))
