"""The list of explained survivors is one of changes to the safety core, and words alone need no entry."""

import multiprocessing
from pathlib import Path

import pytest

from tests.safety_core import (
    KERNEL,
    Mutant,
    changes_words_only,
    core,
    explained,
    is_noticed,
    is_of_kernel,
    kernel_mutants,
    makes_zip_loose,
)

ROOT = Path(__file__).parents[1]


def test_core_and_tests_are_files_of_the_project() -> None:
    for path in (*core().files, *core().tests):
        assert (ROOT / path).is_file(), path


def test_every_explained_survivor_changes_a_line_that_is_there() -> None:
    """An entry for code that is gone would hide nothing, and mislead."""
    files = (*core().files, KERNEL)
    modules = {path.removesuffix(".py").replace("/", "."): (ROOT / path).read_text() for path in files}
    for one, why in explained().items():
        (module,) = [name for name in modules if one.where.startswith(f"{name}.")]
        lines = [line.strip() for line in modules[module].splitlines()]
        assert all(line in lines for line in one.was.splitlines()), one
        assert one.was != one.becomes
        assert len(why.split()) > 5, one


@pytest.mark.parametrize(
    ("was", "becomes", "words"),
    [
        ('raise A(f"at {x} rad")', 'raise A(f"XXat {x} radXX")', True),
        ('raise A(B.C, "no lease")', 'raise A(B.C, "NO LEASE")', True),
        ('raise A(B.C, "no lease")', "raise A(B.C, None)", False),
        ('state = "armed"', 'state = "XXarmedXX"', False),
        ('if x < 1: say("too low")', 'if x < 2: say("too low")', False),
        ('f"at {x} "', 'f"XXat {x} XX"', True),
    ],
)
def test_a_change_of_words_is_one_of_a_sentence_and_of_nothing_else(
    was: str, becomes: str, words: bool
) -> None:
    assert changes_words_only(Mutant("a.b", was, becomes)) is words


@pytest.mark.parametrize(
    ("becomes", "loose"),
    [
        ("for a, b in zip(f(x), y, strict=None):", True),
        ("for a, b in zip(f(x), y, strict=False):", True),
        ("for a, b in zip(f(x), y, ):", True),
        ("for a, b in zip(f(x), strict=True):", False),
        ("for a, b in zip(f(x), None, strict=True):", False),
        ("for a, b in zip(f(None), y, strict=True):", False),
    ],
)
def test_a_zip_that_is_loose_is_one_that_lost_its_strictness_and_nothing_else(
    becomes: str, loose: bool
) -> None:
    assert makes_zip_loose(Mutant("a.b", "for a, b in zip(f(x), y, strict=True):", becomes)) is loose


def test_every_explained_survivor_of_the_compiled_tick_is_one_of_its_mutants() -> None:
    assert {one for one in explained() if is_of_kernel(one)} <= kernel_mutants().keys()


def test_a_wrong_compiled_tick_is_noticed_and_the_right_one_is_not() -> None:
    """Each is compiled in a process of its own, beside the machine code that is kept."""
    mutants = kernel_mutants()
    (wrong,) = (source for one, source in mutants.items() if one.becomes == "return bad != 0")
    right = (ROOT / KERNEL).read_text()
    with multiprocessing.get_context("spawn").Pool(2, maxtasksperchild=1) as pool:
        assert pool.map(is_noticed, [right, wrong], chunksize=1) == [False, True]
    assert len(mutants) > 500
