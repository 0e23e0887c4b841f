"""A report as a document: sections of paragraphs, tables with units, figures and conclusions.

The document holds numbers, not text that was made of them: pages (`report.pages`) round them by the form
of their column, and `Document.model_dump_json` is the same report for programs. A section may open with a
sentence and end with conclusions on what was compared; an experiment of a study is one section of this kind.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Cell = float | int | str | None
Outcome = Literal["seen", "seen in part", "not seen"]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Paragraph(_Part):
    """Plain sentences."""

    kind: Literal["paragraph"] = "paragraph"
    text: str


class Bullets(_Part):
    """Sentences that belong together, one below the other."""

    kind: Literal["bullets"] = "bullets"
    items: tuple[str, ...]


class Column(_Part):
    """A column of a table: its heading, the unit of its numbers, and the form that they are shown in.

    group: a heading above this and the neighbouring columns of the same group. right: aligned to the right
    even if the cells are text. link: the cells are titles of sections, and lead there.
    spans: an empty cell is part of the one above.
    """

    name: str
    unit: str = ""
    form: str = ".4g"
    group: str = ""
    right: bool = False
    link: bool = False
    spans: bool = False

    @property
    def heading(self) -> str:
        """The name with the unit in brackets."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def shown(self, cell: Cell) -> str:
        """Return a cell as text: numbers in the column's form, a dash where there is none."""
        if cell is None:
            return "–"
        if isinstance(cell, str):
            return cell
        # The sign of a zero that was rounded says nothing; whole numbers have none.
        sign = self.form[:1] if self.form[:1] in ("+", " ") else ""
        zero = "" if self.form.endswith("d") else "z"
        return f"{cell:{sign}{zero}{self.form.removeprefix(sign)}}"


class Table(_Part):
    """Rows of cells, one for each column."""

    kind: Literal["table"] = "table"
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]

    @classmethod
    def of(cls, caption: str, columns: Sequence[Column], rows: Sequence[Sequence[Cell]]) -> "Table":
        """Return a table.

        Raises:
            ValueError: a row that does not have one cell for every column.
        """
        for row in rows:
            if len(row) != len(columns):
                raise ValueError(f"{caption}: a row of {len(row)} cells, {len(columns)} columns: {row}")
        return cls(caption=caption, columns=tuple(columns), rows=tuple(map(tuple, rows)))

    def is_text(self, column: int) -> bool:
        """Return whether a column holds text only; others are aligned to the right."""
        return not self.columns[column].right and all(
            isinstance(row[column], str | None) for row in self.rows
        )


class Curve(_Part):
    """Values over x; `style` is a line, points, or levels: dashed lines right across."""

    label: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    style: Literal["line", "points", "level"] = "line"


class Panel(_Part):
    """Curves over one x axis; `title` is shown above it. log: for values of several orders of magnitude."""

    y_label: str
    curves: tuple[Curve, ...]
    title: str = ""
    log: bool = False


class Plot(_Part):
    """Panels one below the other that share their x axis; `plots.panel_figure` draws it."""

    caption: str
    x_label: str
    panels: tuple[Panel, ...]


class Figure(_Part):
    """A drawing as SVG in the colours of a light page (`report.plots`).

    alt: what is to be seen, for those who cannot see it.
    """

    kind: Literal["figure"] = "figure"
    caption: str
    alt: str
    svg: str


class Conclusion(_Part):
    """Whether something that was expected is seen in the data, and by what."""

    kind: Literal["conclusion"] = "conclusion"
    outcome: Outcome
    reason: str


Block = Annotated[Paragraph | Bullets | Table | Figure | Conclusion, Field(discriminator="kind")]


class Section(_Part):
    """A heading with what belongs under it."""

    title: str
    blocks: tuple[Block, ...]


class Document(_Part):
    """A report: a title, a sentence below it, and sections."""

    title: str
    subtitle: str = ""
    sections: tuple[Section, ...] = ()

    def section(self, title: str) -> Section:
        """Return the section of a title.

        Raises:
            KeyError: there is none; the message lists those there are.
        """
        for one in self.sections:
            if one.title == title:
                return one
        raise KeyError(f"no section {title!r}, but {', '.join(one.title for one in self.sections)}")


def tables(section: Section) -> list[Table]:
    """Return the tables of a section."""
    return [block for block in section.blocks if isinstance(block, Table)]


def linked(document: Document) -> set[str]:
    """Return the titles of sections that a table leads to."""
    return {
        str(row[k])
        for section in document.sections
        for table in tables(section)
        for k, column in enumerate(table.columns)
        if column.link
        for row in table.rows
    }


def figures(section: Section) -> list[Figure]:
    """Return the figures of a section."""
    return [block for block in section.blocks if isinstance(block, Figure)]
