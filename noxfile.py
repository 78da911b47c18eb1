"""Development sessions. They share the one environment that `make setup` makes: run them as `.venv/bin/nox`."""

import importlib.util
import os
import shutil
import sys
import sysconfig
import tempfile
from pathlib import Path

import nox

nox.needs_version = ">=2025.5"
nox.options.sessions = ["lint", "typecheck", "repro", "tests"]
nox.options.default_venv_backend = "none"
nox.options.error_on_external_run = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # Hundreds of child processes share the compiled modules.

# All tests of a file run in one process and share its trainings; long files do not run last.
SPREAD = ("-n", str(os.cpu_count() or 1), "--dist", "loadfile", "--no-loadscope-reorder")
_MAIN = "import sys; from wheelleg_exp.cli.main import main; sys.exit(main())"
_PURELIB = "import sysconfig; print(sysconfig.get_path('purelib'))"
# `quick` leaves out these folders of tests, which start commands, and all tests with these marks.
WHOLE = ("cli", "evaluation", "foreign", "gym", "jobs", "project", "promises", "report")
SLOW = "slow or train or repro or full or pictures or browser or corpus"
# Commands of an installed wheel, in a new project.
SMOKE = (
    "--version",
    "play stock:walk env.num_envs=1",
    "check --physics task=mine",
    "train task=mine env.num_envs=16 agent.max_iterations=2",
    "export latest -o bundle",
    "export latest --format isaaclab -o isaaclab",
    "import isaaclab --robot assets/mine/wheelleg.usda -o ../imported",
)


def _python(session: nox.Session, *words: str) -> None:
    """Run a module with this interpreter; report a missing environment in one line."""
    if importlib.util.find_spec("wheelleg_exp") is None:
        session.error("the package is not installed here: run `make setup`, then `.venv/bin/nox`")
    session.run(sys.executable, "-m", *words)


@nox.session
def tests(session: nox.Session) -> None:
    """Run the test suite."""
    _python(session, "pytest", *SPREAD, "--durations=20", "-m", "not repro and not full", *session.posargs)


@nox.session
def quick(session: nox.Session) -> None:
    """Run the fast tests of single packages."""
    outside = [f"--ignore=tests/{folder}" for folder in WHOLE]
    _python(session, "pytest", *SPREAD, *outside, "--durations=10", "-m", f"not ({SLOW})", *session.posargs)


@nox.session
def mutants(session: nox.Session) -> None:
    """Plant the faults of tests/mutants.yaml in a copy, all or those with a given word, and check that tests fail."""
    session.run(sys.executable, "tests/mutants.py", *session.posargs)


@nox.session
def lint(session: nox.Session) -> None:
    """Check style and formatting."""
    _python(session, "ruff", "check", ".")
    _python(session, "ruff", "format", "--check", ".")


@nox.session
def docs(session: nox.Session) -> None:
    """Build the manual as one static site in build/site, and fail on a broken link or anchor."""
    os.environ["NO_MKDOCS_2_WARNING"] = "1"  # The theme advertises its successor, which has no hooks.
    _python(session, "mkdocs", "build", "--strict", "--quiet", *session.posargs)
    session.log("open build/site/index.html, or run `.venv/bin/mkdocs serve`")


@nox.session
def typecheck(session: nox.Session) -> None:
    """Check types."""
    _python(session, "mypy", "--num-workers", "2")


@nox.session
def gpu(session: nox.Session) -> None:
    """Run the tests of the mujoco-warp engine and of PPO's CUDA graphs on a GPU."""
    _require_gpu(session)
    _python(session, "pytest", "-p", "no:xdist", "tests/sim/warp", "tests/rl/test_ppo_graphs.py", *session.posargs)


def _require_gpu(session: nox.Session) -> None:
    """Make the engine's tests run on a GPU; skip the session with a reason if no GPU exists."""
    missing = [name for name in ("warp", "mujoco_warp") if importlib.util.find_spec(name) is None]
    if missing:
        session.skip(f"not installed: {', '.join(missing)}; run pip install 'wheelleg_exp[gpu]'")
    import torch

    if not torch.cuda.is_available():
        session.skip(f"torch {torch.__version__} sees no GPU: `nox -s tests` runs the same tests on Warp's CPU device")
    os.environ.setdefault("WHEELLEG_TEST_DEVICE", "cuda:0")


@nox.session(venv_backend="virtualenv")
def clients(session: nox.Session) -> None:
    """Test with third-party libraries, in a separate environment on top of this one."""
    _test_on_top(session, "tests/clients")


@nox.session(venv_backend="virtualenv")
def physx(session: nox.Session) -> None:
    """Test the engine physx, in a separate environment on top of this one."""
    _test_on_top(session, "tests/physx")


@nox.session(venv_backend="virtualenv")
def notebooks(session: nox.Session) -> None:
    """Execute copies of the notebooks in docs/examples, in a separate environment on top of this one."""
    _install_on_top(session, "docs/examples")
    folder = tempfile.mkdtemp()  # outside the repository, where `wheelleg new` writes no project
    for path in Path("docs/examples").glob("*.ipynb"):
        copy = Path(shutil.copy(path, folder))
        session.run("jupyter", "execute", "--inplace", str(copy))
        outputs = copy.read_text(encoding="utf-8")
        if "wheelleg: error" in outputs or "Traceback" in outputs:  # The failure of a command stops no notebook.
            session.error(f"a command failed: see {copy}")
    shutil.rmtree(folder)


def _test_on_top(session: nox.Session, tests: str) -> None:
    _install_on_top(session, tests)
    session.run("python", "-m", "pytest", "-p", "no:xdist", tests, *session.posargs)


def _install_on_top(session: nox.Session, folder: str) -> None:
    here, own = sysconfig.get_path("purelib"), session.run("python", "-c", _PURELIB, silent=True).strip()
    Path(own, "_wheelleg.pth").write_text(f"import site; site.addsitedir({here!r})\n")
    session.install("-r", f"{folder}/requirements.txt")


@nox.session(venv_backend="virtualenv")
@nox.parametrize("versions", [nox.param("highest", id="newest"), nox.param("lowest-direct", id="oldest")])
def wheel(session: nox.Session, versions: str) -> None:
    """Build sdist and wheel, install only the wheel, with the newest or oldest allowed versions, and run commands."""
    folder = Path(session.create_tmp()).absolute()
    shutil.rmtree(folder)
    session.install("uv")
    session.run("uv", "build", "--quiet", "--out-dir", str(folder / "dist"))  # the wheel is built from the sdist
    # Releases without a wheel for this Python are left out. Hydra's parser has no wheel at all.
    wheels = ("--only-binary", ":all:", "--no-binary", "antlr4-python3-runtime", "--resolution", versions)
    session.run("uv", "pip", "install", "--quiet", *wheels, *session.posargs, *map(str, folder.glob("dist/*.whl")))
    session.env.update({"PYTHONPATH": None, "WHEELLEG_CACHE": str(folder / "cache")})
    session.chdir(folder)
    session.run("wheelleg", "new", "mine")
    session.chdir(folder / "mine")
    for line in SMOKE:
        session.run("wheelleg", *line.split())


@nox.session
def results(session: nox.Session) -> None:
    """Check the shipped policies, and repeat docs/results, all pages or the named ones, bit by bit."""
    if not session.posargs:
        session.run(sys.executable, "docs/make_policies.py", "check")
    names = session.posargs or sorted(path.stem for path in Path("docs/results").glob("*.json"))
    session.run(sys.executable, "-c", _MAIN, "results", *names, "--again")


@nox.session
def repro(session: nox.Session) -> None:
    """Prove with small sizes that runs repeat bit by bit, one check per line; `-- full` adds the long proofs."""
    words = [word for word in session.posargs if word != "full"]
    marks = "repro or full" if "full" in session.posargs else "repro"
    where = "tests" if "full" in session.posargs else "tests/repro"
    _python(session, "pytest", "-n", "logical", "-m", marks, "--no-header", "-vv", where, *words)
