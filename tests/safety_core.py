"""The safety core under its tests: `make safety` (all branches) and `make mutants` (all changes noticed).

[tool.mutmut] in pyproject.toml says which files are the core and which tests hold it.

    python -m tests.safety_core coverage
    python -m tests.safety_core mutants [--report]

A mutant that the tests do not notice is a survivor. It must be explained in `module_agent/survivors.toml`, by
its function and by the lines that it changes. Two kinds need no entry: one that changes words of a message
alone, and one that makes a `zip` loose: its lengths are equal by construction, and strictness is there for
the day on which a change lets them differ. A survivor without an explanation fails, so does a mutant that was
not decided; an entry that no survivor needs any more is named.

A mutant under which the tests do not end is noticed by that: a run of them that hangs is no run that passes.
The limit, 15 times what they take and 15 s more, may be too short on a busy machine, so that each such mutant
is run a second time when all others are done, and counts if it hangs again.
"""

import io
import json
import os
import re
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
SURVIVORS = Path(__file__).parent / "module_agent" / "survivors.toml"
KILLED, SURVIVED, NOT_CHECKED, HANGS = "killed", "survived", "not checked", "timeout"


class Mutant(NamedTuple):
    """One change: the function that it is in, and the lines before and after it, not indented."""

    where: str
    was: str
    becomes: str


class Core(NamedTuple):
    """The files of the safety core, their tests, and what pytest is told of them."""

    files: list[str]
    tests: list[str]


def core() -> Core:
    """Return what [tool.mutmut] says."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mutmut"]
    return Core(settings["only_mutate"], settings["pytest_add_cli_args_test_selection"])


# ------------------------------------------------------------------ branches


def coverage() -> int:
    """Run the tests of the core and print its branches; return 0 if all are covered."""
    files, tests = core()
    python, include = [sys.executable, "-m"], f"--include={','.join(files)}"
    # The data has a place of its own: a coverage of all tests may be under way.
    environment = {**os.environ, "COVERAGE_FILE": str(ROOT / ".coverage.safety")}
    # Its own process: where coverage starts after the core is imported, definitions do not count.
    run = [*python, "coverage", "run", "--branch", include, "-m", "pytest", *tests]
    report = [*python, "coverage", "report", include, "--show-missing", "--fail-under=100", "--precision=2"]
    for command in (run, report):
        code = subprocess.call(command, cwd=ROOT, env=environment)
        if code:
            return code
    return 0


# ------------------------------------------------------------------ mutants


def results() -> dict[str, str]:
    """Return what was decided of every mutant, by its name."""
    from mutmut.stats import status_by_exit_code

    found = {}
    for file in core().files:
        meta = ROOT / "mutants" / f"{file}.meta"
        if meta.is_file():
            decided = json.loads(meta.read_text())["exit_code_by_key"]
            found |= {name: status_by_exit_code[code] for name, code in decided.items()}
    return found


def mutant(name: str) -> Mutant:
    """Return the change that a mutant makes."""
    from mutmut.mutation.diff_apply import get_diff_for_mutant

    module, _, mangled = name.rpartition("__mutmut_")[0].rpartition(".")
    # x_function, or xǁClassǁmethod.
    function = mangled.removeprefix("x_") if mangled.startswith("x_") else mangled[2:].replace("ǁ", ".")
    lines = get_diff_for_mutant(name).splitlines()[3:]
    was, becomes = (
        "\n".join(line[1:].strip() for line in lines if line.startswith(sign)) for sign in ("-", "+")
    )
    return Mutant(f"{module}.{function}", was, becomes)


def changes_words_only(one: Mutant) -> bool:
    """Return whether only the text of strings is changed, as in a message for a person."""
    before, after = (_without_words(text) for text in (one.was, one.becomes))
    return before is not None and before == after


def _without_words(text: str) -> list[str] | None:
    try:
        tokens = list(tokenize.generate_tokens(io.StringIO(f"({text}\n)").readline))
    except (tokenize.TokenError, IndentationError):
        return None
    words = [token.string for token in tokens if token.type == tokenize.STRING]
    # A text with a space is a sentence; a single word may be a name that the program reads.
    if not any(" " in word for word in words):
        return None
    return ["a string" if token.type == tokenize.STRING else token.string for token in tokens]


def makes_zip_loose(one: Mutant) -> bool:
    """Return whether a `zip` stops to insist on equal lengths, and nothing else is changed."""
    before, after = (re.sub(r"(, )?\bstrict=\w+|, (?=\))", "", text) for text in (one.was, one.becomes))
    return "strict=True" in one.was and "zip(" in before and before == after


def explained() -> dict[Mutant, str]:
    """Return the survivors that are explained, with their reasons."""
    entries = tomllib.loads(SURVIVORS.read_text(encoding="utf-8")).get("survivor", [])
    return {Mutant(e["where"], e["was"].strip(), e["becomes"].strip()): e["why"] for e in entries}


def run_mutants(*names: str) -> None:
    """Run the mutants of these names, or all that are not decided."""
    command = [sys.executable, "-m", "mutmut", "run", *names]
    subprocess.call(command, cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": "1"})


def mutants(run: bool) -> int:
    """Run all mutants and print what became of them; return 0 if every survivor is explained."""
    if run:
        run_mutants()
        if hanging := [name for name, status in results().items() if status == HANGS]:
            run_mutants(*hanging)
    os.chdir(ROOT)
    decided = results()
    alive = {
        name: mutant(name) for name, status in decided.items() if status not in (KILLED, HANGS, NOT_CHECKED)
    }
    survivors = {name: one for name, one in alive.items() if decided[name] == SURVIVED}
    words = {name for name, one in survivors.items() if changes_words_only(one)}
    loose = {name for name, one in survivors.items() if makes_zip_loose(one)}
    reasons = explained()
    open_ones = {n: one for n, one in alive.items() if n not in words | loose and one not in reasons}
    counts = Counter(decided.values())
    known = len(survivors) - len(words) - len(loose) - sum(n in survivors for n in open_ones)
    print(
        f"{len(decided)} mutants: "
        + ", ".join(f"{count} {status}" for status, count in counts.most_common())
        + f"; of the survivors {len(words)} change words of a message, {len(loose)} make a zip loose, "
        f"{known} are explained in {SURVIVORS.relative_to(ROOT)}"
    )
    waiting = counts[NOT_CHECKED]
    if waiting:
        print(f"{waiting} are not checked: run it again, it goes on where it has stopped")
    for name, one in open_ones.items():
        print(f"\n{decided[name]}, not explained: {name}\n  {one.where}\n- {one.was}\n+ {one.becomes}")
    for one in () if waiting else reasons.keys() - set(survivors.values()):
        print(f"explained, and no survivor any more: {one.where}: {one.was!r} -> {one.becomes!r}")
    return 1 if open_ones or waiting or not decided else 0


def main(arguments: list[str]) -> int:
    """Run one of the two commands."""
    commands: dict[str, Any] = {"coverage": coverage, "mutants": lambda: mutants("--report" not in arguments)}
    if not arguments or arguments[0] not in commands:
        print(__doc__)
        return 2
    result: int = commands[arguments[0]]()
    return result


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
