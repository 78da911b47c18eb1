"""What it ran on: source, machine, threads, versions, the robot's conversion, resumes, files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from wheelleg_exp.files import read_json
from wheelleg_exp.report.blocks import Block, Cell, Code, Facts, Heading, More, Note, Table, Text, Tone
from wheelleg_exp.report.subject import KIND, Subject
from wheelleg_exp.report.words import brief, counted, moment, number, size
from wheelleg_exp.run.source.snapshot import entries

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
    ("warnings", "warn", "to be looked at"),
    ("unresolved", "warn", "that could not be resolved"),
    ("assumptions", "", "assumed where the file says nothing"),
    ("left_out", "", "left out, with the reason"),
)
_STATES: Mapping[str, str] = {
    "ok": "kept",
    "no_commits": "kept (the repository has no commit)",
    "no_repository": "no repository",
    "installed": "an installed package",
    "patch_too_large": "not kept: the patch is too large",
    "no_git": "not kept: git is not installed",
    "failed": "not kept: git failed",
}


def source(subject: Subject) -> list[Block]:
    """Return the state of the source: commit, local changes, what of them is kept."""
    record = _json(subject, "source/git.json") or dict(subject.manifest.get("source") or {})
    if not record:
        return [Note("The state of the source was not recorded.")]
    found: list[Block] = [Heading("Source")]
    for number_, entry in enumerate(entries(record)):
        found += _repository(entry, number_)
    return found


def _repository(record: Mapping[str, Any], place: int) -> list[Block]:
    changes = {True: "local changes", False: "no local changes"}.get(record.get("dirty"), "–")  # type: ignore[arg-type]
    patch = record.get("patch")
    rows = [
        ("Repository" if not place else f"Repository {place + 1}", str(record.get("root") or "–")),
        ("Source", _STATES.get(str(record.get("status")), str(record.get("status")))),
        ("Commit", str(record.get("commit") or "–")),
        ("Branch", str(record.get("branch") or "–")),
        ("Working tree", f"{changes}; tree {record.get('tree') or '–'}"),
        ("Patch", f"source/{patch}, {size(record.get('patch_bytes'))}" if patch else "none"),
        ("Remote", _remote(record.get("remote"))),
    ]
    found: list[Block] = [Facts([(name, value) for name, value in rows if value not in ("–", "")])]
    if record.get("note"):
        found.append(Note(str(record["note"])))
    found += _named("Untracked files, kept in the patch", record.get("untracked"))
    refused = [f"{e.get('path')}: {e.get('reason', 'left out')}" for e in _mappings(record.get("refused"))]
    return [*found, *_named("Files left out of the patch", refused)]


def _remote(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(str(part) for part in value.values() if part)
    return str(value) if value else ""


def _named(title: str, names: Any) -> list[Block]:
    if not isinstance(names, Sequence) or isinstance(names, str) or not names:
        return []
    shown = [str(name) for name in names[:_LISTED]]
    more = [f"… and {number(len(names) - _LISTED)} more"] if len(names) > _LISTED else []
    return [More(f"{title} ({number(len(names))})", [Code("\n".join([*shown, *more]))])]


def machine(subject: Subject) -> list[Block]:
    """Return the machine, threads, environment variables and versions."""
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
        found.append(More("Versions", [Facts(versions), *_installed(subject)]))
    return found if found[1:] else [Note("The machine was not recorded.", "")]


def _arithmetic(threads: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return threads and arithmetic as people read them; what is as it should be is left to one line."""
    mkl, numerics = threads.get("mkl"), threads.get("numerics")
    numerics = numerics if isinstance(numerics, Mapping) else {}
    reasons = threads.get("dependent_because") or []
    rows = [(name, brief(threads[key])) for key, name in _THREADS.items() if threads.get(key) is not None]
    if isinstance(mkl, Mapping):
        rows.append(("MKL's code branch", f"{mkl.get('branch')}, {'strict' if mkl.get('strict') else 'not strict'}"))
    if "independent" in threads:
        told = "; ".join(map(str, reasons)) or "yes"
        rows.append(("Numbers depend on torch's threads", "no" if threads["independent"] else told))
    if threads.get("variables_in_time") is False:
        rows.append(("Thread variables", "were set after torch was imported"))
    rows += [(name, _plain(numerics[key])) for key, name in _NUMERICS.items() if key in numerics]
    libraries = numerics.get("libraries") or []
    return [*rows, *(("Library", str(line)) for line in libraries if isinstance(line, str))]


def _plain(value: Any) -> str:
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else brief(value)


def _installed(subject: Subject) -> list[Block]:
    there = subject.file("environment.txt") is not None
    return [Text("environment.txt lists every installed distribution.")] if there else []


def robot(subject: Subject) -> list[Block]:
    """Return what the robot's conversion read, assumed and left out."""
    report = _json(subject, "asset/report.json")
    if not report:
        return [Note("There is no report of the robot's conversion.", "")]
    totals = dict(report.get("totals") or {})
    rows = [("Source", str(report.get("source", "–"))), ("Base", str(report.get("base", "–")))]
    rows += [
        (str(name).capitalize(), number(value) + (" kg" if name == "mass" else "")) for name, value in totals.items()
    ]
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
    return Table("What the conversion says", ("Where", "What became of it"), rows, titled=False)


def resumes(subject: Subject) -> list[Block]:
    """Return one row a resume."""
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
    columns = ("Resumed", "From iteration", "Changed", "Status before", "As if never stopped")
    return [Table("Resumes", columns, rows)]


def files(subject: Subject) -> list[Block]:
    """Return every recorded file with its size and digest; reports are not counted."""
    if subject.run is None:
        return [Note("An agent's run keeps no record of its files.", "")]
    records = dict(subject.run.manifest().recorded_files())
    for entry in subject.additions(KIND):
        for name in entry.get("files", {}):
            records.pop(name, None)
    total = sum(record["size"] for record in records.values())
    rows = [
        [Cell(name, code=True), Cell(size(record["size"]), number=True), Cell(record["sha256"], code=True)]
        for name, record in sorted(records.items())
    ]
    lead = f"{counted(len(rows), 'file')}, {size(total)} in all; each with the digest that the manifest holds."
    return [
        Text(lead),
        More("Names, sizes and digests", [Table("Files", ("File", "Size", "sha256"), rows, titled=False)]),
    ]


def _json(subject: Subject, name: str) -> dict[str, Any]:
    path = subject.file(name)
    empty: dict[str, Any] = {}
    return subject.tried(lambda: dict(read_json(path)), empty) if path else empty


def _mappings(value: Any) -> list[Mapping[str, Any]]:
    return [entry for entry in value if isinstance(entry, Mapping)] if isinstance(value, list) else []
