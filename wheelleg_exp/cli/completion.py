"""``wheelleg completion SHELL``: a script that makes the shell complete commands, options, keys and values."""

from __future__ import annotations

import argparse
import os
import shlex
from importlib import import_module
from pathlib import Path

from wheelleg_exp.cli.arguments import Parser, offer
from wheelleg_exp.errors import EXIT_OK, WheellegError
from wheelleg_exp.packages import with_current
from wheelleg_exp.paths import configs_dir
from wheelleg_exp.terms.key_syntax import PIPELINE, names_pipeline

# A shell's completion script sets WHEELLEG_COMPLETE_LINE to the typed command line, and then calls `wheelleg`.
# The bash completion script also sets WHEELLEG_COMPLETE_BREAKS to bash's word-splitting characters.
LINE, BREAKS = "WHEELLEG_COMPLETE_LINE", "WHEELLEG_COMPLETE_BREAKS"
_QUERY = "query"

BASH = f"""\
# wheelleg: completion for bash. To have it in every shell:
#   wheelleg completion bash > ~/.local/share/bash-completion/completions/wheelleg
_wheelleg_complete() {{
    local found
    COMPREPLY=()
    while IFS= read -r found; do
        COMPREPLY+=("$found")
    done < <({LINE}="${{COMP_LINE:0:COMP_POINT}}" {BREAKS}="$COMP_WORDBREAKS" "$1" completion {_QUERY} 2>/dev/null)
}}
complete -o nospace -F _wheelleg_complete wheelleg
"""

ZSH = f"""\
#compdef wheelleg
# wheelleg: completion for zsh. To have it in every shell: wheelleg completion zsh > "${{fpath[1]}}/_wheelleg"
_wheelleg_complete() {{
    local -a found
    found=("${{(@f)$({LINE}="$LBUFFER" "${{words[1]}}" completion {_QUERY} 2>/dev/null)}}")
    [[ -n "${{found[1]}}" ]] && compadd -S '' -- "${{found[@]}}"
}}
# As a file of fpath this text is the function itself; its first call must complete as well.
if [[ "${{funcstack[1]}}" == _wheelleg ]]; then _wheelleg_complete; else compdef _wheelleg_complete wheelleg; fi
"""

FISH = f"""\
# wheelleg: completion for fish. To have it in every shell:
#   wheelleg completion fish > ~/.config/fish/completions/wheelleg.fish
complete -c wheelleg -f -a '({LINE}=(commandline -cp | string collect) wheelleg completion {_QUERY} 2>/dev/null)'
"""

SCRIPTS = {"bash": BASH, "zsh": ZSH, "fish": FISH}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    shells = "{" + ",".join(SCRIPTS) + "}"
    offer([*SCRIPTS], parser.add_argument("shell", choices=[*SCRIPTS, _QUERY], metavar=shells, help="the shell"))


def run(args: argparse.Namespace) -> int:
    """Print a shell's completion script, or the completion candidates if a completion script calls the command."""
    if args.shell != _QUERY:
        print(SCRIPTS[args.shell], end="")
        return EXIT_OK
    for candidate in answer(os.environ.get(LINE, ""), os.environ.get(BREAKS)):
        print(candidate)
    return EXIT_OK


def answer(line: str, breaks: str | None = None) -> list[str]:
    """Return the completion candidates for the last word of a command line.

    ``breaks`` contains bash's word-splitting characters, such as ``=`` and ``:``; None for zsh and fish. bash expects
    only the part of a candidate after its last word break, and a space after a complete candidate.
    """
    words, word, quote = split(line)
    try:
        found = [c for c in candidates(words, word) if c.startswith(word)]
    except WheellegError:
        found = []
    if breaks is None:
        return found
    start = 0 if quote else max((word.rfind(letter) + 1 for letter in breaks if not letter.isspace()), default=0)
    return [c[start:] + ("" if c.endswith((".", "=", "/", ",", "[")) or quote else " ") for c in found]


def split(line: str) -> tuple[list[str], str, str]:
    """Split a command line into complete words, the unfinished last word, and the opening quote of the last word."""
    for quote in ("", "'", '"'):
        try:
            words = shlex.split(line + quote)
        except ValueError:
            continue
        if not quote and (not line or line[-1].isspace()):
            return words, "", ""
        return words[:-1], words[-1] if words else "", quote
    return [], "", ""


def candidates(words: list[str], word: str) -> list[str]:
    """Return the completion candidates for ``word``, the unfinished last word of a command line."""
    from wheelleg_exp.cli.main import COMMANDS

    typed = [w for w in words[1:] if w != "--debug"]
    if not typed:
        return ["--help", "--version", "--debug"] if word.startswith("-") else list(COMMANDS)
    command = COMMANDS.get(typed[0])
    if command is None:
        return []
    parser = Parser(prog=typed[0])
    import_module(f"wheelleg_exp.cli.{command.module}").configure(parser)
    known = [action for action in parser._actions if action.help != argparse.SUPPRESS]
    options = {text: action for action in known for text in action.option_strings}
    positionals = [action for action in parser._actions if not action.option_strings]
    given: dict[str, list[str]] = {}
    position, waiting = 0, None
    for text in typed[1:]:
        if waiting is not None:
            given.setdefault(waiting.dest, []).append(text)
            waiting = None
        elif text in options:
            waiting = options[text] if options[text].nargs != 0 else None
        elif not text.startswith("-") and position < len(positionals):
            given.setdefault(positionals[position].dest, []).append(text)
            position += positionals[position].nargs not in ("*", "+")
    if waiting is None and word.startswith("-"):
        return list(options)
    action = waiting or (positionals[position] if position < len(positionals) else None)
    return [] if action is None else _of(action, word, given)


def _of(action: argparse.Action, word: str, given: dict[str, list[str]]) -> list[str]:
    """Return the completion candidates for an argument; ``given`` contains the arguments before it, by name."""
    kind = vars(action).get("candidates", action.choices)  # ``offer`` has set the candidates.
    if kind is None:
        return _files(word) if action.type is Path else []
    if not isinstance(kind, str):
        return [str(choice) for choice in kind]
    before = given.get("overrides", [])
    folders = with_current([Path(text) for text in given.get("config_dirs", [])])
    in_pipeline = any("." in text and names_pipeline(text) for text in (*before, word))
    primary = given.get("primary", [PIPELINE if in_pipeline else "train"])[-1]
    if kind in ("override", "robot", "key"):
        from wheelleg_exp.config.explaining.alternatives import complete_override

        files = _files(word) if kind == "robot" and "=" not in word else []
        return files + complete_override(word, before, folders, primary, as_key=kind == "key")
    if kind == "primary":
        return sorted(path.stem for path in configs_dir().glob("*.yaml"))
    from wheelleg_exp.config.explaining import catalog
    from wheelleg_exp.run.run_directory import LATEST, PIPELINE_NAME, PIPELINES, run_folders
    from wheelleg_exp.run.stock_policies import PREFIX, stock_names

    if kind == "group":
        return catalog.groups(folders)
    root = Path(given.get("root", ["runs"])[-1])
    found = [entry.name for entry in catalog.options("task", folders)] if kind == "run or task" else []
    found += [LATEST, *(PREFIX + name for name in stock_names()), *(folder.name for folder in run_folders(root))]
    if kind == "run to resume":
        found += sorted(path.parent.name for path in (root / PIPELINES).glob(f"*/{PIPELINE_NAME}"))
    return found + _files(word)


def _files(word: str) -> list[str]:
    folder, _, start = word.rpartition("/")
    place = Path(f"{folder}/" if folder or word.startswith("/") else ".").expanduser()
    try:
        found = sorted(place.iterdir())
    except OSError:
        return []
    lead = word[: len(word) - len(start)]
    shown = [path for path in found if path.name.startswith(start) and (start or not path.name.startswith("."))]
    return [f"{lead}{path.name}{'/' if path.is_dir() else ''}" for path in shown]
