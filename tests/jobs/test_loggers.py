"""Loggers whose package is missing."""

from jobs.small import SMALL, wheelleg
from wheelleg_exp.jobs.train import prepare_training


def test_a_missing_package_is_one_message_before_there_is_a_run(tmp_path, monkeypatch):
    monkeypatch.setattr(prepare_training, "find_spec", lambda _: None)
    said = wheelleg("train", *SMALL, "agent.logger=wandb", f"run.root={tmp_path / 'runs'}")
    assert (said.status, said.err.count("agent.logger: the package wandb is not installed")) == (2, 1)
    assert "pip install wheelleg_exp[wandb]" in " ".join(said.err.split())
    assert "Traceback" not in said.err
    assert not (tmp_path / "runs").exists()
