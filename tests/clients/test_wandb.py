"""``agent.logger=wandb`` with the library itself, offline: what it would send, read back with its own messages."""

import json
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from patience import PATIENCE_S

pytest.importorskip("wandb", reason="wandb is not installed: nox -s clients")

from jobs.small import SMALL, wheelleg
from wandb.proto.wandb_internal_pb2 import Record

from wheelleg_exp.files import sha256

pytestmark = [pytest.mark.train, pytest.mark.filterwarnings("default")]
_BLOCK = 32768


@pytest.fixture
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_USERNAME", "somebody")
    for name in ("WANDB_PROJECT", "WANDB_DIR", "WANDB_ENTITY"):
        monkeypatch.delenv(name, raising=False)


def kept(path: Path) -> Iterator[Any]:
    """Yield the records that ``wandb sync`` would send from a file: LevelDB's log format after 7 bytes."""
    data, start, content = path.read_bytes(), 7, b""
    while start + 7 <= len(data):
        left = _BLOCK - start % _BLOCK
        if left < 7:  # a block ends without another header
            start += left
            continue
        size, kind = struct.unpack_from("<HB", data, start + 4)
        content += data[start + 7 : start + 7 + size]
        start += 7 + size
        if kind in (1, 4):  # the kinds of a whole record and of the last piece of a record
            record = Record()
            record.ParseFromString(content)
            yield record
            content = b""


def history(records: list[Any]) -> dict[int, dict[str, float]]:
    rows = [{(i.key or i.nested_key[0]): json.loads(i.value_json) for i in r.history.item} for r in records]
    return {int(row.pop("_step")): row for row in rows if row}


def test_scalars_config_and_name_are_sent_and_nothing_else(offline, tmp_path):
    said = wheelleg("train", *SMALL, "agent.logger=wandb", f"run.root={tmp_path}")
    assert said.status == 0, said.err
    assert "scalars and config go to" in said.err
    (run,), (file,) = (tmp_path / "stand").iterdir(), tmp_path.glob("wandb/offline-run-*/*.wandb")
    records = list(kept(file))
    sent = next(record.run for record in records if record.HasField("run"))
    assert (sent.display_name, sent.project, sent.entity) == (f"stand/{run.name}", "wheelleg_exp", "")
    config = {item.key: json.loads(item.value_json) for item in sent.config.update if item.key != "_wandb"}
    assert config == yaml.safe_load((run / ".hydra" / "config.yaml").read_text())
    lines = [json.loads(line) for line in (run / "iterations.jsonl").read_text().splitlines()]
    found = history(records)
    assert list(found) == [0, 1, 2]
    for line in lines:
        row = {k: v for k, v in found[line["iteration"]].items() if not k.startswith("_")}
        assert row == pytest.approx(line["scalars"])
    kinds = {record.WhichOneof("record_type") for record in records}
    assert kinds <= {"header", "run", "telemetry", "history", "summary", "config", "exit", "footer", "final"}
    for secret in (b"somebody", socket.gethostname().encode(), b"diff --git", b"requirements.txt"):
        assert secret not in file.read_bytes()
    assert list(run.glob("events.out.tfevents.*"))
    assert not [path for path in run.rglob("*") if "wandb" in path.name]


def test_a_resume_continues_the_same_run_and_changes_no_number(offline, tmp_path):
    assert wheelleg("train", *SMALL, "agent.logger=wandb", f"run.root={tmp_path / 'a'}").status == 0
    assert wheelleg("train", *SMALL, f"run.root={tmp_path / 'b'}").status == 0
    (run,), (other,) = (tmp_path / "a" / "stand").iterdir(), (tmp_path / "b" / "stand").iterdir()
    for name in ("model_0.pt", "model_1.pt", "model_2.pt"):
        assert sha256(run / name) == sha256(other / name)
    said = wheelleg("resume", run, "agent.max_iterations=4")
    assert said.status == 0, said.err
    files = sorted(tmp_path.glob("a/wandb/offline-run-*/*.wandb"))
    first, second = (list(kept(file)) for file in files)
    ids = {record.run.run_id for records in (first, second) for record in records if record.HasField("run")}
    assert len(ids) == 1
    assert list(history(second)) == [3]


def test_without_a_login_the_message_names_the_remedy(tmp_path, monkeypatch):
    for name in ("WANDB_MODE", "WANDB_API_KEY", "NETRC"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    main = "import sys; from wheelleg_exp.cli.main import main; sys.exit(main())"  # wandb reads variables once
    words = ["train", *SMALL, "agent.logger=wandb", f"run.root={tmp_path}"]
    said = subprocess.run([sys.executable, "-c", main, *words], capture_output=True, text=True, timeout=PATIENCE_S)
    assert said.returncode != 0
    assert said.stderr.count("agent.logger: Weights & Biases") == 1
    assert "WANDB_MODE=offline" in said.stderr
    assert "Traceback" not in said.stderr
