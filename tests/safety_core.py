"""The safety core under its tests: `make safety` (all branches) and `make mutants` (all changes noticed).

[tool.mutmut] in pyproject.toml says which files are the core and which tests hold it.

    python -m tests.safety_core coverage
    python -m tests.safety_core mutants [--report]
    python -m tests.safety_core kernel [--report]

A mutant that the tests do not notice is a survivor. It must be explained in `module_agent/survivors.toml`, by
its function and by the lines that it changes. Two kinds need no entry: one that changes words of a message
alone, and one that makes a `zip` loose: its lengths are equal by construction, and strictness is there for
the day on which a change lets them differ. A survivor without an explanation fails, so does a mutant that was
not decided; an entry that no survivor needs any more is named.

A mutant under which the tests do not end is noticed by that: a run of them that hangs is no run that passes.
The limit, 15 times what they take and 15 s more, may be too short on a busy machine, so that each such mutant
is run a second time when all others are done, and counts if it hangs again.

Most ticks are decided by a compiled copy of the core, `KERNEL`. mutmut makes the same changes of it, but
cannot run them: a kernel calls no function that is exchanged at run time. `kernel` compiles each changed copy
anew, in a process of its own, and looks whether the tests that compare it with the core notice. A change that
numba does not compile is noticed. The kernel's loops run over arrays of given lengths, so that none hangs.
What was decided counts for this kernel and these tests: after a change of either it begins anew.
"""

import contextlib
import difflib
import hashlib
import io
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, NamedTuple

from module_agent.model.files import replacing

ROOT = Path(__file__).parents[1]
SURVIVORS = Path(__file__).parent / "module_agent" / "survivors.toml"
KILLED, SURVIVED, NOT_CHECKED, HANGS = "killed", "survived", "not checked", "timeout"
KERNEL = "module_agent/firmware/tick_kernel.py"
KERNEL_TESTS = "tests/module_agent/firmware/test_quiet_ticks.py"
KERNEL_RESULTS = ROOT / "mutants" / "tick_kernel.json"
# What a process says by its exit code.
NOTICED = 3
# How a mutant may end its process that writes beyond its arrays: that is noticed, too.
ENDED_BY_ITSELF = (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGFPE, signal.SIGILL)


class Mutant(NamedTuple):
    """One change: the function that it is in, and the lines before and after it, not indented.

    place: which of several equal lines of the function it changes, of the compiled tick.
    """

    where: str
    was: str
    becomes: str
    place: int = 0


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
    """Return the survivors that are explained, with their reasons; several of a line may share one."""
    reasons = {}
    for entry in tomllib.loads(SURVIVORS.read_text(encoding="utf-8")).get("survivor", []):
        becomes = entry["becomes"]
        for one in [becomes] if isinstance(becomes, str) else becomes:
            mutant = Mutant(entry["where"], entry["was"].strip(), one.strip(), entry.get("place", 0))
            reasons[mutant] = entry["why"]
    return reasons


def run_mutants(*names: str) -> None:
    """Run the mutants of these names, or all that are not decided."""
    command = [sys.executable, "-m", "mutmut", "run", *names]
    subprocess.call(command, cwd=ROOT)


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
    if not waiting:
        print_needless({one for one in reasons if not is_of_kernel(one)} - set(survivors.values()))
    return 1 if open_ones or waiting or not decided else 0


def print_needless(reasons: set[Mutant]) -> None:
    """Name the explanations of mutants that are noticed by now."""
    for one in reasons:
        print(f"explained, and no survivor any more: {one.where}: {one.was!r} -> {one.becomes!r}")


# ------------------------------------------------------------------ the compiled copy


def is_of_kernel(one: Mutant) -> bool:
    """Return whether a mutant is one of the compiled tick."""
    return one.where.rpartition(".")[0] == _module(KERNEL)


def _module(file: str) -> str:
    return file.removesuffix(".py").replace("/", ".")


def kernel_mutants() -> dict[Mutant, str]:
    """Return all mutants of the compiled tick, each with the source of its file."""
    from mutmut.mutation.file_mutation import create_mutations, deep_replace

    # It passes decorated functions by.
    plain = (ROOT / KERNEL).read_text().replace("@compiled\n", "")
    tree, mutations, *_ = create_mutations(KERNEL, plain)
    found: dict[Mutant, str] = {}
    seen: Counter[Mutant] = Counter()
    for mutation in mutations:
        function = mutation.contained_by_top_level_function
        if function is None:
            continue
        changed: Any = deep_replace(function, mutation.original_node, mutation.mutated_node)
        before, after = tree.code_for_node(function), tree.code_for_node(changed)
        lines = list(difflib.unified_diff(before.splitlines(), after.splitlines(), "", "", n=0))[3:]
        was, becomes = (
            "\n".join(line[1:].strip() for line in lines if line.startswith(sign)) for sign in ("-", "+")
        )
        one = Mutant(f"{_module(KERNEL)}.{function.name.value}", was, becomes)
        source = re.sub("^def ", "@compiled\ndef ", plain.replace(before, after), flags=re.MULTILINE)
        found[one._replace(place=seen[one])] = source
        seen[one] += 1
    return found


def is_noticed(source: str) -> bool:
    """Return whether the tests of the compiled tick fail on this source of it; spoils it for this process."""
    import pytest
    from hypothesis import Phase, settings

    from module_agent.firmware import tick_kernel

    settings.register_profile(
        "kernel", phases=[Phase.generate], report_multiple_bugs=False, derandomize=True, database=None
    )
    settings.load_profile("kernel")
    os.environ.pop("PYTEST_ADDOPTS", None)
    options = ["-x", "-q", "-o", "addopts=", "--import-mode=importlib"]
    options += ["-p", "no:cacheprovider", "-p", "no:faulthandler"]
    with contextlib.redirect_stdout(io.StringIO()) as said:
        # Where a source has no file, its machine code is not taken from what is kept on disk.
        exec(compile(source, "<mutant>", "exec"), vars(tick_kernel))
        code = pytest.main([*options, str(ROOT / KERNEL_TESTS)])
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        raise RuntimeError(f"pytest ended with {code!r}:\n{said.getvalue()}")
    return code == pytest.ExitCode.TESTS_FAILED


def _end_by_tests(source: str) -> None:
    sys.exit(NOTICED if is_noticed(source) else 0)


def run_kernel_mutants() -> None:
    """Run all mutants of the compiled tick that are not decided, and keep what becomes of them."""
    decided = kernel_results()
    waiting = [(one, source) for one, source in kernel_mutants().items() if one not in decided]
    running: dict[int, tuple[Any, Mutant]] = {}
    while waiting or running:
        while waiting and len(running) < (os.cpu_count() or 1):
            one, source = waiting.pop()
            # A process of its own: what it has changed is not changed back.
            process = multiprocessing.get_context("fork").Process(target=_end_by_tests, args=(source,))
            process.start()
            running[process.sentinel] = process, one
        for sentinel in wait(list(running)):
            process, one = running.pop(sentinel)  # type: ignore[index]
            process.join()
            if process.exitcode not in (0, NOTICED, *(-end for end in ENDED_BY_ITSELF)):
                raise RuntimeError(f"the tests of {one} ended with {process.exitcode}")
            decided[one] = SURVIVED if process.exitcode == 0 else KILLED
        KERNEL_RESULTS.parent.mkdir(exist_ok=True)
        kept = {"of": _digest(), "decided": [[*one, status] for one, status in decided.items()]}
        with replacing(KERNEL_RESULTS) as temporary:
            temporary.write_text(json.dumps(kept))
        alive = sum(status == SURVIVED for status in decided.values())
        print(f"\r{len(decided)} decided, {len(waiting)} wait, {alive} not noticed", end="", flush=True)
    print()


def kernel_results() -> dict[Mutant, str]:
    """Return what was decided of every mutant of the compiled tick as it and its tests are."""
    kept = json.loads(KERNEL_RESULTS.read_text()) if KERNEL_RESULTS.is_file() else {"of": None}
    if kept["of"] != _digest():
        return {}
    return {Mutant(*one): status for *one, status in kept["decided"]}


def _digest() -> str:
    """Return what tells the kernel and its tests from others."""
    files = b"".join((ROOT / path).read_bytes() for path in (KERNEL, KERNEL_TESTS))
    return hashlib.sha256(files).hexdigest()


def kernel(run: bool) -> int:
    """Run all mutants of the compiled tick and print what became of them; return 0 if all are explained."""
    if run:
        run_kernel_mutants()
    decided = kernel_results()
    survivors = [one for one, status in decided.items() if status == SURVIVED]
    reasons = {one: why for one, why in explained().items() if is_of_kernel(one)}
    open_ones = [one for one in survivors if one not in reasons]
    waiting = len(kernel_mutants().keys() - decided.keys())
    noticed, known = len(decided) - len(survivors), len(survivors) - len(open_ones)
    print(
        f"{len(decided)} mutants of {KERNEL}: {noticed} noticed, {known} explained in "
        f"{SURVIVORS.relative_to(ROOT)}, {len(open_ones)} neither, {waiting} not checked"
    )
    for one in open_ones:
        print(f"\nnot explained: {one.where}, place {one.place}\n- {one.was}\n+ {one.becomes}")
    if not waiting:
        print_needless(reasons.keys() - set(survivors))
    return 1 if open_ones or waiting else 0


def main(arguments: list[str]) -> int:
    """Run one of the commands."""
    os.environ["OMP_NUM_THREADS"] = "1"
    run = "--report" not in arguments
    commands: dict[str, Any] = {
        "coverage": coverage,
        "mutants": lambda: mutants(run),
        "kernel": lambda: kernel(run),
    }
    if not arguments or arguments[0] not in commands:
        print(__doc__)
        return 2
    result: int = commands[arguments[0]]()
    return result


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
