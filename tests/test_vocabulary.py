"""Retired words stay out of names and prose: the code speaks the field's language.

A name in `NAMES` was private vocabulary for something that the field has a term for; a word in `PROSE` makes
sentences that a roboticist has to decode. Each entry says what to write instead.
"""

import ast
import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("module_agent", "coordinator", "sim")
FILES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
# A changelog names what was renamed.
PROSE_FILES = [*FILES, *(page for page in PAGES if page.name != "CHANGELOG.md")]

NAMES = {
    r"[Rr]adio": "messenger",
    r"[Rr]obot_?[Ll]ink": "module group",
    r"[Ll]eft_?[Oo]ut": "excluded modules",
    r"[Rr]obot_?[Ss]o_?[Ff]ar": "preview",
    r"[Tt]orque_?[Qq]uestions?": "information requests",
    r"[Dd]rive_?[Aa]head": "motor compensation",
    r"[Ff]loater|[Ff]loating|let_go|LetGo": "gravity compensation, release",
    r"[Ww]atcher|[Ww]atching": "monitor, monitoring",
    r"[Jj]udgement|[Ll]edger|[Vv]erdicts?": "diagnosis, finding log, identifiability",
    r"[Ss]een_?[Ii]nformation|[Ee]yes": "instrumental variables, motion source",
    r"[Ff]ree_?[Mm]otions?": "gauge freedom",
    r"[Kk]nown_?[Pp]resence|[Kk]nown_?[Ww]eight": "preconditions, gravity model",
    r"[Ww]hole_?[Mm]otion": "simultaneous motion",
    r"[Nn]eighbours?": "motion listener",
    r"KAPPA|FELT|BEARING": "the quantity, spelled out",
    r"_?(MOST|LEAST)_\w+": "MAX_, MIN_",
    r"nobody|somebody|whoever": "who it is",
}
PROSE = (
    "whoever",
    "nobody",
    "somebody",
    "beside",
    "whom",
    "whose make",
    "is other",
    "let go",
    "snatch",
    "bears what",
)


def names(path: Path) -> set[str]:
    """Names that a file defines: functions, classes, arguments, assigned variables and attributes."""
    found = {path.stem}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.arg):
            found.add(node.arg)
        elif isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            found.add(node.id if isinstance(node, ast.Name) else node.attr)
    return found


def check_names(path: Path) -> None:
    patterns = {better: re.compile(rf"(^|_)({pattern})($|_|(?=[A-Z]))") for pattern, better in NAMES.items()}
    wrong = {n: better for n in names(path) for better, pattern in patterns.items() if pattern.search(n)}
    assert not wrong, f"{path}: say instead {wrong}"


def test_no_name_is_private_vocabulary() -> None:
    for path in FILES:
        check_names(path)


def prose(path: Path) -> str:
    """Everything that a person reads in a file: all of a page; comments and strings of code."""
    text = path.read_text()
    if path.suffix != ".py":
        return text
    kinds = (tokenize.COMMENT, tokenize.STRING)
    return "\n".join(
        t.string for t in tokenize.generate_tokens(io.StringIO(text).readline) if t.type in kinds
    )


def test_prose_has_no_word_that_has_to_be_decoded() -> None:
    pattern = re.compile(rf"\b({'|'.join(PROSE)})\b", re.IGNORECASE)
    wrong = {str(p.relative_to(ROOT)): sorted(set(pattern.findall(prose(p)))) for p in PROSE_FILES}
    wrong = {path: words for path, words in wrong.items() if words}
    assert not wrong, wrong


def test_the_lists_find_what_they_name(tmp_path: Path) -> None:
    path = tmp_path / "sample.py"
    path.write_text('"""Whoever reads this."""\nMOST_ROWS = 3\n\n\nclass TorqueQuestions:\n    radio = 1\n')
    assert {"MOST_ROWS", "TorqueQuestions", "radio"} <= names(path)
    with pytest.raises(AssertionError, match="MAX_, MIN_"):
        check_names(path)
    assert re.search(r"\bwhoever\b", prose(path), re.IGNORECASE)
