"""Build the sections of a report on the provenance and reproducibility of a run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from wheelleg_exp.errors import WheellegError
from wheelleg_exp.files import read_json
from wheelleg_exp.report.page_blocks import Block, Card, Cell, Code, Facts, Heading, More, Note, Table, Text, Tone
from wheelleg_exp.report.report_subject import KIND, Subject
from wheelleg_exp.report.value_format import brief, counted, moment, number, size
from wheelleg_exp.run.file_inventory import MANIFEST_NAME, odd_entries
from wheelleg_exp.run.records import RunRecord, read_record
from wheelleg_exp.run.run_directory import REPLAYS, RunDirectory
from wheelleg_exp.run.source_restore import load_source
from wheelleg_exp.verify.check_files import Check, RunFindings
from wheelleg_exp.verify.check_run import verify_run
from wheelleg_exp.verify.run_comparison import compare_runs

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


@dataclass(frozen=True)
class _Conversion:
    """The content of ``asset/report.json`` that the page shows."""

    source: str = "–"
    base: str = "–"
    totals: Mapping[str, object] = field(default_factory=dict)
    warnings: tuple[object, ...] = ()
    unresolved: tuple[object, ...] = ()
    assumptions: tuple[object, ...] = ()
    left_out: tuple[object, ...] = ()


def source(subject: Subject) -> list[Block]:
    """Return the state of the source: commit, local changes, and the saved patch."""
    noted = [subject.manifest.source] if subject.manifest.source and subject.manifest.has_source else []
    exists = subject.file("source/git.json") is not None
    records = subject.tried(lambda: load_source(subject.path), noted) if exists else noted
    if not records:
        return [Note("The state of the source was not recorded.")]
    found: list[Block] = [Heading("Source")]
    for place, record in enumerate(records):
        changes = "–" if record.dirty is None else "local changes" if record.dirty else "no local changes"
        rows = [
            ("Repository" if not place else f"Repository {place + 1}", record.root or ""),
            ("Source", _ENTRY_STATES.get(record.status, record.status)),
            ("Commit", record.commit or ""),
            ("Branch", record.branch or ""),
            ("Working tree", f"{changes}; tree {record.tree or '–'}"),
            ("Patch", f"source/{record.patch}, {size(record.patch_bytes)}" if record.patch else "none"),
            ("Remote", ", ".join(str(part) for part in (record.remote or {}).values() if part)),
        ]
        found.append(Facts([(name, value) for name, value in rows if value]))
        found += [Note(record.note)] if record.note else []
        found += _file_list("Untracked files, saved in the patch", record.untracked)
        refused = [f"{entry['path']}: {entry['reason']}" for entry in record.refused]
        found += _file_list("Files left out of the patch", refused)
    return found


def _file_list(title: str, names: Sequence[str]) -> list[Block]:
    if not names:
        return []
    shown = list(names[:_LISTED])
    more = [f"… and {number(len(names) - _LISTED)} more"] if len(names) > _LISTED else []
    return [More(f"{title} ({number(len(names))})", [Code("\n".join([*shown, *more]))])]


def machine(subject: Subject) -> list[Block]:
    """Return report blocks about a run's machine, threads, environment variables, and package versions."""
    manifest = subject.manifest
    hardware, threads, process = manifest.hardware or {}, manifest.threads or {}, manifest.process or {}
    cores = "–" if hardware.get("cores") is None else f"{hardware.get('cores_usable', '–')} of {hardware['cores']}"
    rows = [
        ("CPU", f"{hardware.get('cpu', '–')} ({hardware.get('machine', '–')})"),
        ("Cores usable", cores),
        ("Memory", f"{number(hardware.get('memory_gib'))} GiB"),
        ("System", str(hardware.get("platform", "–"))),
        ("Host", str(process.get("host") or "–")),
        *_arithmetic(threads),
    ]
    found: list[Block] = [Heading("Machine")]
    found += [Facts([(name, value) for name, value in rows if value != "–"])] if hardware else []
    if variables := manifest.environment_variables:
        found.append(Code("\n".join(f"{k}={v}" for k, v in variables.items()), "Environment variables in force:"))
    versions = [(name, str(value)) for name, value in (manifest.versions or {}).items()]
    if versions:
        exists = subject.file("environment.txt") is not None
        installed = [Text("environment.txt lists every installed distribution.")] if exists else []
        found.append(More("Versions", [Facts(versions), *installed]))
    return found if found[1:] else [Note("The machine was not recorded.", "")]


def _arithmetic(threads: Mapping[str, object]) -> list[tuple[str, str]]:
    mkl, numerics = threads.get("mkl"), threads.get("numerics")
    numerics = numerics if isinstance(numerics, Mapping) else {}
    reasons = threads.get("dependent_because")
    rows = [(name, brief(threads[key])) for key, name in _THREADS.items() if threads.get(key) is not None]
    if isinstance(mkl, Mapping):
        rows.append(("MKL's code branch", f"{mkl.get('branch')}, {'strict' if mkl.get('strict') else 'not strict'}"))
    if "independent" in threads:
        why = "; ".join(map(str, reasons)) if isinstance(reasons, list) and reasons else "yes"
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
    path = subject.file("asset/report.json")
    read = partial(read_record, _Conversion, broken="broken conversion report", where=path)
    report = subject.tried(lambda: read(read_json(path)), None) if path else None
    if report is None:
        return [Note("There is no report of the robot's conversion.", "")]
    rows, units = [("Source", report.source), ("Base", report.base)], {"mass": " kg"}
    rows += [(name.capitalize(), number(value) + units.get(name, "")) for name, value in report.totals.items()]
    found: list[Block] = [Heading("Robot"), Facts(rows)]
    for key, tone, words in _CONVERSION:
        entries: Sequence[object] = getattr(report, key)
        if entries:
            title = f"{counted(len(entries), 'thing')} {words}"
            found += [Note(f"The conversion has {title}.", "warn")] if tone else []
            found.append(More(title.capitalize(), [_findings(entries)]))
    return found


def _findings(entries: Sequence[object]) -> Table:
    rows = []
    for found in entries[:_FINDINGS]:
        entry = found if isinstance(found, Mapping) else {"": found}
        rest = [brief(value) for key, value in entry.items() if key not in ("path", "name")]
        where = " ".join(str(entry[key]) for key in ("path", "name") if entry.get(key))
        rows.append([Cell(where or "–", code=True), Cell("; ".join(rest))])
    return Table("Findings of the conversion", ("Where", "Finding"), rows, titled=False)


def resumes(subject: Subject) -> list[Block]:
    """Return a table with one row per resume of the run."""
    rows = [
        [
            Cell(moment(entry.when)),
            Cell("–" if entry.iteration is None else number(entry.iteration), number=True),
            Cell(" ".join(entry.overrides) or "–", code=True),
            Cell((entry.before and entry.before.status) or "–"),
            Cell("–" if entry.exact is None else "yes" if entry.exact else "no"),
        ]
        for entry in subject.manifest.resumes
    ]
    columns = ("Resumed", "From iteration", "Changed", "Status before", "As if never stopped")
    return [Table("Resumes", columns, rows)] if rows else []


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
        subject, found = self.subject, list(_found(self))
        if self.repeats:
            rows = [
                [
                    Cell(r.label, code=True),
                    Cell(r.how),
                    Cell(r.verdict, tone=_VERDICTS.get(r.verdict, "")),
                    Cell(r.reason),
                ]
                for r in self.repeats
            ]
            title = "Runs that should have the same numbers"
            found.append(Table(title, ("Run", "What it is", "Verdict", "Why"), rows))
            details = [Code("\n".join(r.lines), f"{r.how} {r.label}:") for r in self.repeats if r.lines]
            found += [More("The comparisons", details)] if details else []
        if original := subject.manifest.replay_of:
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
    return {name for entry in subject.additions(KIND) for name in entry.files}


def _lines(subject: Subject, lines: Sequence[str]) -> list[str]:
    own = tuple(f"{name} " for name in _reports(subject))
    return [line for line in lines if not (own and line.startswith(own))]


def _repeats(subject: Subject, run: RunDirectory) -> Iterator[Repeat]:
    own, of = subject.manifest, subject.manifest.replay_of
    folders: dict[str, list[Path]] = {"original": [], "replay": [], "same settings": []}
    if of is not None and Path(of).name == of:
        with suppress(WheellegError):
            folders["original"].append(RunDirectory.open(of, run.root).path)
    for folder, record in _others(run, run.root / REPLAYS, "*/*"):
        folders["replay"] += [folder] if record.replay_of == (own.id or run.id) else []
    for folder, record in _others(run, run.path.parent, "*") if not of else ():
        is_equal = record.status == "finished" and _inputs(record) == _inputs(own)
        folders["same settings"] += [folder] if is_equal else []
    for how, found in folders.items():
        yield from (_compared(run, folder, how) for folder in found[-_COMPARED:])


def _others(run: RunDirectory, root: Path, pattern: str) -> Iterator[tuple[Path, RunRecord]]:
    for path in sorted(root.glob(f"{pattern}/{MANIFEST_NAME}")):
        if path.parent != run.path:
            with suppress(WheellegError):
                yield path.parent, RunDirectory(path.parent).manifest().facts


def _inputs(record: RunRecord) -> tuple[object, ...]:
    return record.seeds, *(record.files.get(name) for name in _PARAMS)


def _compared(run: RunDirectory, folder: Path, how: str) -> Repeat:
    label = f"{folder.parent.name}/{folder.name}"
    try:
        found = compare_runs(run, RunDirectory.open(folder, run.root), common=True)
    except Exception as error:  # Reading damaged files of a run can raise any error.
        return Repeat(label, how, "not compared", str(error), [])
    verdict = "not compared" if found.parts["files"].state == "different" else found.verdict
    return Repeat(label, how, verdict, f"{counted(found.iterations, 'iteration')}: {found.reason}", found.lines())
