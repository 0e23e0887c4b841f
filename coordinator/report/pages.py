"""A document as a page: HTML in one file without references, Markdown with a folder of figures, or JSON.

An HTML page follows the reader's choice of light or dark: figures are drawn in the colours of `PALETTE`,
which the page replaces by variables that its style sets for both.
"""

import re
from html import escape
from pathlib import Path

from coordinator.report.document import (
    Block,
    Bullets,
    Cell,
    Column,
    Conclusion,
    Document,
    Figure,
    Paragraph,
    Section,
    Table,
    linked,
)
from module_agent.model.errors import UsageError
from module_agent.model.files import write_json, write_text

# The colours of figures: on a light page, as drawn, and on a dark one.
PALETTE = {
    "ink": ("#1d2430", "#e4e8ee"),
    "muted": ("#667080", "#9aa5b4"),
    "grid": ("#d5dae1", "#353d49"),
    "paper": ("#fdfdfe", "#15191f"),
    "body": ("#b9c3d0", "#4a5666"),
    "measured": ("#2b5fa8", "#7db2ff"),
    "predicted": ("#c4441c", "#ff9466"),
    "residual": ("#2c7d52", "#6fd19b"),
    "axis": ("#b3246b", "#ff86bd"),
}
SUFFIXES = (".html", ".md", ".json")
_OUTCOMES: dict[str, str] = {"seen": "seen", "seen in part": "part", "not seen": "unseen"}
_ROWS_A_PAGE = 24
# A longer text is prose.
_NAME = 40
_COLOUR = re.compile("|".join(light for light, _ in PALETTE.values()), re.IGNORECASE)
_VARIABLES = {light: f"var(--{name})" for name, (light, _) in PALETTE.items()}


def _variables(dark: bool) -> str:
    return "".join(f"--{name}:{pair[dark]};" for name, pair in PALETTE.items())


_STYLE = f"""
:root {{ color-scheme: light dark; {_variables(False)} }}
@media (prefers-color-scheme: dark) {{ :root {{ {_variables(True)} }} }}
body {{ font: .94rem/1.5 system-ui, "DejaVu Sans", sans-serif; color: var(--ink); background: var(--paper);
  max-width: 62rem; margin: 0 auto; padding: 1.5rem 1.2rem 4rem; overflow-wrap: break-word; }}
h1 {{ font-size: 1.7rem; line-height: 1.2; margin: 0 0 .3rem; }}
h2 {{ font-size: 1.2rem; margin: 2.2rem 0 .6rem; break-after: avoid;
  padding-bottom: .2rem; border-bottom: 1px solid var(--grid); }}
p {{ margin: .5rem 0; break-inside: avoid; }} h2 + p {{ break-after: avoid; }}
.subtitle {{ color: var(--muted); margin: 0 0 1rem; }}
a {{ color: var(--measured); }}
nav {{ font-size: .9rem; }} nav a {{ margin-right: 1rem; white-space: nowrap; }}
ul {{ margin: .5rem 0; padding-left: 1.3rem; }} li {{ margin: .15rem 0; }}
.scroll {{ overflow-x: auto; margin: .9rem 0 1.2rem; break-inside: avoid; }}
.long {{ break-inside: auto; }} tr {{ break-inside: avoid; }}
table {{ border-collapse: collapse; font-size: .87rem; font-variant-numeric: tabular-nums; }}
caption {{ text-align: left; font-weight: 600; padding-bottom: .3rem;
  white-space: nowrap; }}
th, td {{ text-align: left; padding: .2rem .9rem .2rem 0; border-bottom: 1px solid var(--grid);
  vertical-align: top; }}
th {{ color: var(--muted); font-weight: 500; vertical-align: bottom; }}
td.name {{ white-space: nowrap; }} td.prose {{ min-width: 8rem; }}
.n {{ text-align: right; white-space: nowrap; }} th.n {{ white-space: normal; }}
th[colspan] {{ text-align: center; }}
figure {{ margin: 1rem 0 1.4rem; break-inside: avoid; }}
figure svg {{ width: 100%; height: auto; display: block; }}
figcaption {{ font-size: .87rem; color: var(--muted); }}
.conclusion {{ border-left: .3rem solid; padding: .2rem .8rem; break-inside: avoid; }}
.conclusion.seen {{ border-color: var(--residual); }} .conclusion.part {{ border-color: var(--predicted); }}
.conclusion.unseen {{ border-color: var(--axis); }}
.outcome {{ white-space: nowrap; }} .outcome.seen {{ color: var(--residual); }}
.outcome.part {{ color: var(--predicted); }} .outcome.unseen {{ color: var(--axis); }}
@page {{ margin: 14mm; }}
@media print {{ :root {{ color-scheme: light; font-size: 12px; {_variables(False)} }}
  body {{ max-width: none; padding: 0; background: none; }} }}
"""


def write_page(path: Path, document: Document) -> None:
    """Write a document in the format of the file's suffix; Markdown has its figures in a folder next to it.

    Raises:
        UsageError: a suffix other than `SUFFIXES`.
        OSError: the file cannot be written.
    """
    check_suffix(path)
    if path.suffix == ".html":
        write_text(path, html_page(document))
    elif path.suffix == ".json":
        write_json(path, document)
    else:
        folder = path.with_name(f"{path.stem}_figures")
        text, drawings = markdown_page(document, folder.name)
        if drawings:
            folder.mkdir(exist_ok=True)
        for name, svg in drawings.items():
            write_text(folder / name, svg)
        write_text(path, text)


def check_suffix(path: Path) -> Path:
    """Return the path if a page can be written to it.

    Raises:
        UsageError: a suffix other than `SUFFIXES`.
    """
    if path.suffix not in SUFFIXES:
        raise UsageError(f"{path}: a report ends in {', '.join(SUFFIXES)}, not in {path.suffix or 'nothing'}")
    return path


# ---------------------------------------------------------------------- HTML


def html_page(document: Document) -> str:
    """Return the document as one HTML file, which needs no other file and no script."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(document.title)}</title><style>{_STYLE}</style></head>\n<body>"
        f'<h1>{escape(document.title)}</h1><p class="subtitle">{escape(document.subtitle)}</p>'
        f"{_navigation(document)}\n"
        + "\n".join(_html_section(section) for section in document.sections)
        + "\n</body></html>\n"
    )


def _navigation(document: Document) -> str:
    """Return links to all sections; none if a table has them."""
    if linked(document):
        return ""
    links = "".join(f'<a href="#{_anchor(s.title)}">{escape(s.title)}</a>' for s in document.sections)
    return f"<nav>{links}</nav>"


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def _html_section(section: Section) -> str:
    blocks = "\n".join(map(_html_block, section.blocks))
    return f'<section id="{_anchor(section.title)}"><h2>{escape(section.title)}</h2>\n{blocks}</section>'


def _html_block(block: Block) -> str:
    match block:
        case Paragraph():
            return f"<p>{escape(block.text)}</p>"
        case Bullets():
            return "<ul>" + "".join(f"<li>{escape(item)}</li>" for item in block.items) + "</ul>"
        case Table():
            return _html_table(block)
        case Figure():
            drawing = themed(block.svg)
            return (
                f'<figure role="img" aria-label="{escape(block.alt)}">{drawing}'
                f"<figcaption>{escape(block.caption)}</figcaption></figure>"
            )
        case Conclusion():
            return (
                f'<p class="conclusion {_OUTCOMES[block.outcome]}"><strong>{block.outcome}</strong>: '
                f"{escape(block.reason)}</p>"
            )


def _html_table(table: Table) -> str:
    kinds = [_kind(table, k) for k in range(len(table.columns))]
    heads = "".join(
        f"<th{kind}>{escape(c.heading)}</th>" for kind, c in zip(kinds, table.columns, strict=True)
    )
    rows = "".join(
        "<tr>"
        + "".join(
            f"<td{kind}{_span(table, at, k)}>{_html_cell(column, cell)}</td>"
            for k, (kind, column, cell) in enumerate(zip(kinds, table.columns, row, strict=True))
            if not (column.spans and at and cell == "")
        )
        + "</tr>"
        for at, row in enumerate(table.rows)
    )
    # A table that is longer than a page begins where it stands, and goes on over the next ones.
    long = " long" if len(table.rows) > _ROWS_A_PAGE else ""
    return (
        f'<div class="scroll{long}"><table><caption>{escape(table.caption)}</caption><thead>{_groups(table)}'
        f"<tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>"
    )


def _kind(table: Table, column: int) -> str:
    """Return the class of a column's cells: numbers, prose, or names that do not wrap."""
    if not table.is_text(column):
        return ' class="n"'
    if any(len(str(row[column] or "")) > _NAME for row in table.rows):
        return ' class="prose"'
    return "" if column else ' class="name"'


def _span(table: Table, row: int, column: int) -> str:
    """Return how many rows a cell spans, as the attribute; empty for one."""
    if not table.columns[column].spans:
        return ""
    below = [other[column] == "" for other in table.rows[row + 1 :]]
    count = 1 + (below.index(False) if False in below else len(below))
    return f' rowspan="{count}"' if count > 1 else ""


def _html_cell(column: Column, cell: Cell) -> str:
    shown = escape(column.shown(cell))
    if column.link:
        return f'<a href="#{_anchor(str(cell))}">{shown}</a>'
    outcome = _OUTCOMES.get(cell) if isinstance(cell, str) else None
    return f'<span class="outcome {outcome}">{shown}</span>' if outcome else shown


def _groups(table: Table) -> str:
    """Return the row of headings above neighbouring columns, empty if no column has one."""
    spans: list[tuple[str, int]] = []
    for column in table.columns:
        if spans and spans[-1][0] == column.group:
            spans[-1] = (column.group, spans[-1][1] + 1)
        else:
            spans.append((column.group, 1))
    if not any(group for group, _ in spans):
        return ""
    return "<tr>" + "".join(f'<th colspan="{n}">{escape(group)}</th>' for group, n in spans) + "</tr>"


def themed(svg: str) -> str:
    """Return a drawing whose colours of `PALETTE` are the page's variables, to be put into an HTML page."""
    drawing = svg[svg.index("<svg") :]
    return _COLOUR.sub(lambda colour: _VARIABLES[colour.group().lower()], drawing)


def on_paper(svg: str) -> str:
    """Return a drawing with the ground of a light page, to be read as a file of its own anywhere."""
    begins = svg.index(">", svg.index("<svg")) + 1
    return f"{svg[:begins]}<style>svg {{ background: {PALETTE['paper'][0]} }}</style>{svg[begins:]}"


# ---------------------------------------------------------------------- Markdown


def markdown_page(document: Document, folder: str) -> tuple[str, dict[str, str]]:
    """Return the document as Markdown, and the drawings that it refers to in `folder`, by file name."""
    drawings: dict[str, str] = {}
    lines = [f"# {document.title}", "", document.subtitle, ""]
    targets = linked(document)
    for section in document.sections:
        lines += [f'<a id="{_anchor(section.title)}"></a>', ""] if section.title in targets else []
        lines += [f"## {section.title}", ""]
        for block in section.blocks:
            if isinstance(block, Figure):
                name = f"{_anchor(section.title)}-{len(drawings) + 1}.svg"
                drawings[name] = on_paper(block.svg)
                lines += [f"![{block.alt}]({folder}/{name})", "", f"*{block.caption}*", ""]
            else:
                lines += [*_markdown_block(block), ""]
    return "\n".join(lines), drawings


def _markdown_block(block: Paragraph | Bullets | Table | Conclusion) -> list[str]:
    match block:
        case Paragraph():
            return [block.text]
        case Bullets():
            return [f"- {item}" for item in block.items]
        case Conclusion():
            return [f"> **{block.outcome}**: {block.reason}"]
        case Table():
            heads = [f"{c.group}: {c.heading}" if c.group else c.heading for c in block.columns]
            aligned = ["---" if block.is_text(k) else "---:" for k in range(len(block.columns))]
            rows = [
                [_markdown_cell(column, cell) for column, cell in zip(block.columns, row, strict=True)]
                for row in block.rows
            ]
            return [f"**{block.caption}**", "", *(_row(cells) for cells in (heads, aligned, *rows))]


def _markdown_cell(column: Column, cell: Cell) -> str:
    shown = column.shown(cell)
    return f"[{shown}](#{_anchor(str(cell))})" if column.link else shown


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
