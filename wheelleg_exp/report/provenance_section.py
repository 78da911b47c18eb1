"""Build the sections of a report on the provenance and reproducibility of a run.

The report lists the source code, machine, threads, versions, robot conversion, resumes, and files of a run. One section
checks the run's files against manifest.json, and compares the run with trainings of equal settings and seed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.files import read_json
from wheelleg_exp.report.page_blocks import Block, Card, Cell, Code, Facts, Heading, More, Note, Table, Text, Tone
from wheelleg_exp.report.report_subject import KIND, Subject
from wheelleg_exp.report.value_format import brief, counted, moment, number, size
from wheelleg_exp.run.file_inventory import MANIFEST_NAME, odd_entries
from wheelleg_exp.run.run_directory import REPLAYS, RunDirectory
from wheelleg_exp.run.source_snapshot import source_entries
from wheelleg_exp.verify import Check, RunFindings, compare_runs, verify_run

_LISTED, _FINDINGS = 40, 200
_THREADS = {
    "torch": "Threads of torch",
    "physics": "Threads of physics",
    "interop": "Threads between torch's operations",
    "cpu_capability": "Instructions that torch uses",
    "device": "Networks on",
    "matmul": "Products of the update",
}
_NUMERICS = {
    "mkldnn": "oneDNN in use",
    "matmul_precision": "Precision of matrix products",
    "default_dtype": "Numbers of torch",
    "deterministic_algorithms": "Deterministic algorithms asked for",
    "rounds_to_nearest": "Rounds to nearest",
    "keeps_denormals": "Keeps denormal numbers",
}
_CONVERSION: tuple[tuple[str, Tone, str], ...] = (
    ("warnings", "warn", "to check"),
    ("unresolved", "warn", "that could not be resolved"),
    ("assumptions", "", "assumed because the file does not specify them"),
    ("left_out", "", "left out, with the reason"),
)
_ENTRY_STATES: Mapping[str, str] = {
    "ok": "saved",
    "no_commits": "saved (the repository has no commit)",
    "no_repository": "not captured: no git repository",
    "installed": "an installed package",
    "patch_too_large": "not captured: the patch is too large",
    "no_git": "not captured: git is not installed",
    "failed": "not captured: git failed",
}


def source(subject: Subject) -> list[Block]:
    """Return the state of the source: commit, local changes, and the saved patch."""
    record = _json(subject, "source/git.json") or dict(subject.manifest.get("source") or {})
    if not record:
        return [Note("The state of the source was not recorded.")]
    found: list[Block] = [Heading("Source")]
    for number_, entry in enumerate(source_entries(record)):
        found += _repository(entry, number_)
    return found


def _repository(record: Mapping[str, Any], place: int) -> list[Block]:
    changes = {True: "local changes", False: "no local changes"}.get(record.get("dirty"), "–")  # type: ignore[arg-type]
    patch, remote = record.get("patch"), record.get("remote") or ""
    rows = [
        ("Repository" if not place else f"Repository {place + 1}", str(record.get("root") or "–")),
        ("Source", _ENTRY_STATES.get(str(record.get("status")), str(record.get("status")))),
        ("Commit", str(record.get("commit") or "–")),
        ("Branch", str(record.get("branch") or "–")),
        ("Working tree", f"{changes}; tree {record.get('tree') or '–'}"),
        ("Patch", f"source/{patch}, {size(record.get('patch_bytes'))}" if patch else "none"),
        ("Remote", ", ".join(str(part) for part in remote.values() if part) if isinstance(remote, Mapping) else remote),
    ]
    found: list[Block] = [Facts([(name, str(value)) for name, value in rows if value not in ("–", "")])]
    if record.get("note"):
        found.append(Note(str(record["note"])))
    found += _file_list("Untracked files, saved in the patch", record.get("untracked"))
    refused = [f"{e.get('path')}: {e.get('reason', 'left out')}" for e in _mappings(record.get("refused"))]
    return [*found, *_file_list("Files left out of the patch", refused)]


def _file_list(title: str, names: Any) -> list[Block]:
    if not isinstance(names, Sequence) or isinstance(names, str) or not names:
        return []
    shown = [str(name) for name in names[:_LISTED]]
    more = [f"… and {number(len(names) - _LISTED)} more"] if len(names) > _LISTED else []
    return [More(f"{title} ({number(len(names))})", [Code("\n".join([*shown, *more]))])]


def machine(subject: Subject) -> list[Block]:
    """Return report blocks about a run's machine, threads, environment variables, and package versions."""
    manifest = subject.manifest
    hardware, threads = dict(manifest.get("hardware") or {}), dict(manifest.get("threads") or {})
    process = manifest.get("process") or {}
    cores = "–" if hardware.get("cores") is None else f"{hardware.get('cores_usable', '–')} of {hardware['cores']}"
    rows = [
        ("CPU", f"{hardware.get('cpu', '–')} ({hardware.get('machine', '–')})"),
        ("Cores usable", cores),
        ("Memory", f"{number(hardware.get('memory_gib'))} GiB"),
        ("System", str(hardware.get("platform", "–"))),
        ("Host", str(process.get("host", "–"))),
        *_arithmetic(threads),
    ]
    found: list[Block] = [Heading("Machine")]
    found += [Facts([(name, value) for name, value in rows if value != "–"])] if hardware else []
    variables = dict(manifest.get("environment_variables") or {})
    if variables:
        found.append(Code("\n".join(f"{k}={v}" for k, v in variables.items()), "Environment variables in force:"))
    versions = [(str(name), str(value)) for name, value in (manifest.get("versions") or {}).items()]
    if versions:
        exists = subject.file("environment.txt") is not None
        installed = [Text("environment.txt lists every installed distribution.")] if exists else []
        found.append(More("Versions", [Facts(versions), *installed]))
    return found if found[1:] else [Note("The machine was not recorded.", "")]


def _arithmetic(threads: Mapping[str, Any]) -> list[tuple[str, str]]:
    mkl, numerics = threads.get("mkl"), threads.get("numerics")
    numerics = numerics if isinstance(numerics, Mapping) else {}
    reasons = threads.get("dependent_because") or []
    rows = [(name, brief(threads[key])) for key, name in _THREADS.items() if threads.get(key) is not None]
    if isinstance(mkl, Mapping):
        rows.append(("MKL's code branch", f"{mkl.get('branch')}, {'strict' if mkl.get('strict') else 'not strict'}"))
    if "independent" in threads:
        why = "; ".join(map(str, reasons)) or "yes"
        rows.append(("Numbers depend on torch's threads", "no" if threads["independent"] else why))
    if threads.get("variables_in_time") is False:
        rows.append(("Thread variables", "were set after torch was imported"))
    for key, name in _NUMERICS.items():
        if key in numerics:
            value = numerics[key]
            rows.append((name, ("yes" if value else "no") if isinstance(value, bool) else brief(value)))
    return [*rows, *(("Library", str(line)) for line in numerics.get("libraries") or [] if isinstance(line, str))]


def robot(subject: Subject) -> list[Block]:
    """Return report blocks about the conversion of the robot's model: its inputs, assumptions, and omissions."""
    report = _json(subject, "asset/report.json")
    if not report:
        return [Note("There is no report of the robot's conversion.", "")]
    totals = dict(report.get("totals") or {})
    rows = [("Source", str(report.get("source", "–"))), ("Base", str(report.get("base", "–")))]
    units = {"mass": " kg"}
    rows += [(str(name).capitalize(), number(value) + units.get(name, "")) for name, value in totals.items()]
    found: list[Block] = [Heading("Robot"), Facts(rows)]
    for key, tone, words in _CONVERSION:
        entries = _mappings(report.get(key))
        if entries:
            title = f"{counted(len(entries), 'thing')} {words}"
            found += [Note(f"The conversion has {title}.", "warn")] if tone else []
            found.append(More(title.capitalize(), [_findings(entries)]))
    return found


def _findings(entries: Sequence[Mapping[str, Any]]) -> Table:
    rows = []
    for entry in entries[:_FINDINGS]:
        rest = {key: value for key, value in entry.items() if key not in ("path", "name")}
        where = " ".join(str(entry[key]) for key in ("path", "name") if entry.get(key))
        rows.append([Cell(where or "–", code=True), Cell("; ".join(brief(value) for value in rest.values()))])
    return Table("Findings of the conversion", ("Where", "Finding"), rows, titled=False)


def resumes(subject: Subject) -> list[Block]:
    """Return a table with one row per resume of the run."""
    entries = _mappings(subject.manifest.get("resumes"))
    if not entries:
        return []
    rows = [
        [
            Cell(moment(entry.get("when"))),
            Cell("–" if entry.get("iteration") is None else number(entry["iteration"]), number=True),
            Cell(" ".join(str(text) for text in entry.get("overrides") or []) or "–", code=True),
            Cell(str((entry.get("before") or {}).get("status", "–"))),
            Cell({True: "yes", False: "no"}.get(entry.get("exact"), "–")),  # type: ignore[arg-type]
        ]
        for entry in entries
    ]
    return [Table("Resumes", ("Resumed", "From iteration", "Changed", "Status before", "As if never stopped"), rows)]


def files(subject: Subject) -> list[Block]:
    """Return a table of all files in the run's manifest except reports, with the size and hash of each file."""
    if subject.run is None:
        return [Note("An agent's run keeps no record of its files.", "")]
    own, every = _reports(subject), subject.run.manifest().recorded_files()
    records = {name: record for name, record in every.items() if name not in own}
    total = sum(record["size"] for record in records.values())
    rows = [
        [Cell(name, code=True), Cell(size(record["size"]), number=True), Cell(record["sha256"], code=True)]
        for name, record in sorted(records.items())
    ]
    lead = f"{counted(len(rows), 'file')}, {size(total)} in all; each with its digest in the manifest."
    table = Table("Files", ("File", "Size", "sha256"), rows, titled=False)
    return [Text(lead), More("Names, sizes and digests", [table])]


def _json(subject: Subject, name: str) -> dict[str, Any]:
    path = subject.file(name)
    empty: dict[str, Any] = {}
    return subject.tried(lambda: dict(read_json(path)), empty) if path else empty


def _mappings(value: Any) -> list[Mapping[str, Any]]:
    return [entry for entry in value if isinstance(entry, Mapping)] if isinstance(value, list) else []


_COMPARED = 3  # Compare a run with at most 3 replays and 3 runs of equal settings: comparisons open checkpoints.
_STATES: Mapping[str, Tone] = {"ok": "good", "note": "", "failed": "bad", "not checked": "warn"}
_VERDICTS: Mapping[str, Tone] = {"identical": "good", "within tolerance": "warn", "different": "bad"}
_PARAMS = ("params/env.yaml", "params/agent.yaml")


@dataclass(frozen=True)
class Repeat:
    """A run that should be bitwise equal to the reported run, and the result of comparing the two runs."""

    label: str  # ``label`` names the run that is compared with the reported run, by task and id.
    how: str  # ``how`` relates the other run to the reported run: ``replay``, ``original``, or ``same settings``.
    verdict: str  # The two runs are ``identical``, equal ``within tolerance``, ``different``, or ``not compared``.
    reason: str
    lines: Sequence[str]  # the whole comparison


@dataclass(frozen=True)
class Verdict:
    """The facts about the reproducibility of a run, for a card and a section of the report."""

    card: Card | None
    findings: RunFindings | None
    repeats: Sequence[Repeat]
    subject: Subject
    problem: str = ""

    def blocks(self) -> list[Block]:
        """Return the content of the report's section on reproducibility."""
        subject, found = self.subject, [*_found(self), *_repeated(self)]
        if original := subject.manifest.get("replay_of"):
            found.append(Text(f"This run is itself a replay of {original}."))
        if subject.status == "running":
            return [*found, Note("The run is still running, so it cannot be compared.", "")]
        lines = f"wheelleg verify {subject.id}\nwheelleg replay {subject.id}"
        return [*found, Code(lines, "Check the files; train the run from its snapshot and compare to the bit:")]


def judge(subject: Subject) -> Verdict:
    """Check a run's files against its file manifest.json, and compare the run with trainings of equal settings."""
    if subject.run is None:
        return Verdict(None, None, [], subject)
    odd = odd_entries(subject.path)
    if odd:  # Do not read the run's files, because a symbolic link can point to a private file elsewhere.
        damaged = Card("Reproducibility", "Damaged", note="it holds links or pipes", tone="bad")
        name, what = next(iter(odd.items()))
        return Verdict(damaged, None, [], subject, f"{name} is {what}, which may lead anywhere")
    repeats = list(_repeats(subject, subject.run)) if subject.status != "running" else []
    try:
        findings = verify_run(subject.run)
    except Exception as error:  # Reading damaged files of a run can raise any error.
        return Verdict(None, None, repeats, subject, str(error))
    failed = [check for check in findings.checks if _lines(subject, check.failures)]
    return Verdict(_card(subject, bool(failed), repeats), findings, repeats, subject)


def _card(subject: Subject, damaged: bool, repeats: Sequence[Repeat]) -> Card | None:
    label = "Reproducibility"
    if damaged:
        return Card(label, "Damaged", note="files are not what the manifest says", tone="bad")
    known = [repeat for repeat in repeats if repeat.verdict in _VERDICTS]
    worst = max(known, key=lambda repeat: list(_VERDICTS).index(repeat.verdict), default=None)
    if worst is None:
        note = "the run is still running" if subject.status == "running" else "files as recorded, not replayed yet"
        return Card(label, "Untested", note=note)
    count = f"{counted(len(known), 'repeated run')}"
    words = {
        "identical": ("Proven", f"{count}, equal to the bit"),
        "within tolerance": ("Close", f"{count}, equal within tolerance"),
        "different": ("Refuted", f"{worst.label} gave other numbers"),
    }[worst.verdict]
    return Card(label, words[0], note=words[1], tone=_VERDICTS[worst.verdict])


def _found(verdict: Verdict) -> list[Block]:
    subject, findings = verdict.subject, verdict.findings
    if findings is None:
        return [Note(f"The run could not be checked against its manifest: {verdict.problem}.", "bad")]
    rows, wrong = [], []
    for check in findings.checks:
        failures, notes = _lines(subject, check.failures), _lines(subject, check.notes)
        state = "failed" if failures else "ok" if check.state == "failed" else check.state
        text = "; ".join([_text(subject, check), *notes])
        rows.append([Cell(check.name), Cell(state, tone=_STATES.get(state, "")), Cell(text)])
        wrong += failures
    summary = Note("The run is what its manifest says, and agrees with itself.", "good")
    if wrong:
        summary = Note(f"The run is not what its manifest says: {'; '.join(wrong[:10])}.", "bad")
    return [summary, Table("Checks against its own manifest", ("Part", "State", "Checked"), rows)]


def _text(subject: Subject, check: Check) -> str:
    """Describe the result of one check of a run; the check ``files`` counts all recorded files except reports."""
    if check.name != "files" or subject.run is None or check.skipped:
        return check.skipped or check.text
    own = _reports(subject)
    kept = [record for name, record in subject.run.manifest().recorded_files().items() if name not in own]
    return f"{counted(len(kept), 'file')}, {size(sum(record['size'] for record in kept))}"


def _reports(subject: Subject) -> set[str]:
    return {name for entry in subject.additions(KIND) for name in entry.get("files", {})}


def _lines(subject: Subject, lines: Sequence[str]) -> list[str]:
    own = tuple(f"{name} " for name in _reports(subject))
    return [line for line in lines if not (own and line.startswith(own))]


def _repeated(verdict: Verdict) -> list[Block]:
    if not verdict.repeats:
        return []
    rows = [
        [Cell(r.label, code=True), Cell(r.how), Cell(r.verdict, tone=_VERDICTS.get(r.verdict, "")), Cell(r.reason)]
        for r in verdict.repeats
    ]
    details: list[Block] = [Code("\n".join(r.lines), f"{r.how} {r.label}:") for r in verdict.repeats if r.lines]
    table = Table("Runs that should have the same numbers", ("Run", "What it is", "Verdict", "Why"), rows)
    return [table, *([More("The comparisons", details)] if details else [])]


def _repeats(subject: Subject, run: RunDirectory) -> Iterator[Repeat]:
    known = str(subject.manifest.get("id") or run.id)
    for how, folders in {
        "original": _original(run, subject),
        "replay": _replays(run, known),
        "same settings": _equals(run, subject),
    }.items():
        yield from (_compared(run, folder, how) for folder in folders[-_COMPARED:])


def _original(run: RunDirectory, subject: Subject) -> list[Path]:
    of = subject.manifest.get("replay_of")
    if not isinstance(of, str) or Path(of).name != of:
        return []
    try:
        return [RunDirectory.open(of, run.root).path]
    except WheellegError:
        return []


def _replays(run: RunDirectory, known: str) -> list[Path]:
    found = sorted((run.root / REPLAYS).glob(f"*/*/{MANIFEST_NAME}"))
    return [path.parent for path in found if path.parent != run.path and _data(path).get("replay_of") == known]


def _equals(run: RunDirectory, subject: Subject) -> list[Path]:
    if subject.manifest.get("replay_of"):
        return []
    found = []
    for path in sorted(run.path.parent.glob(f"*/{MANIFEST_NAME}")):
        data = _data(path)
        same = _parameters(data) == _parameters(subject.manifest) and data.get("seeds") == subject.manifest.get("seeds")
        if path.parent != run.path and same and data.get("status") == "finished":
            found.append(path.parent)
    return found


def _parameters(manifest: Mapping[str, Any]) -> list[Any]:
    files = manifest.get("files") or {}
    return [(files.get(name) or {}).get("sha256", name) for name in _PARAMS]


def _data(path: Path) -> dict[str, Any]:
    try:
        return RunDirectory(path.parent).manifest().data
    except WheellegError:
        return {}


def _compared(run: RunDirectory, folder: Path, how: str) -> Repeat:
    label = f"{folder.parent.name}/{folder.name}"
    try:
        found = compare_runs(run, RunDirectory.open(folder, run.root), common=True)
    except Exception as error:  # Reading damaged files of a run can raise any error.
        return Repeat(label, how, "not compared", str(error), [])
    verdict = "not compared" if found.parts["files"].state == "different" else found.verdict
    return Repeat(label, how, verdict, f"{counted(found.iterations, 'iteration')}: {found.reason}", found.lines())
