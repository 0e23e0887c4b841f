"""Documents: what they refuse, and that every page says the same numbers."""

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from coordinator.report.document import (
    Bullets,
    Column,
    Conclusion,
    Curve,
    Document,
    Figure,
    Panel,
    Paragraph,
    Plot,
    Section,
    Table,
    figures,
    tables,
)
from coordinator.report.pages import PALETTE, html_page, markdown_page, themed, write_page
from coordinator.report.plots import (
    PAUSE_S,
    MissingPlots,
    check_plots,
    panel_figure,
    torque_plot,
    without_pauses,
)
from module_agent.model.errors import UsageError


def study() -> Document:
    """A study of one experiment: three methods side by side, a plot and a conclusion."""
    t_s = np.linspace(0.0, 2.0, 50)
    columns = (
        Column(name="quantity"),
        Column(name="printed", unit="mm", group="published", form=".1f"),
        Column(name="its method", unit="mm", group="here", form=".2f"),
        Column(name="ours", unit="mm", group="here", form=".2f"),
    )
    experiment = Section(
        title="Link length & <axis>",
        blocks=(
            Paragraph(text="Two modules, one link | swung by a joint."),
            Table.of("Error", columns, [("mean", 6.6, 7.125, 0.03), ("worst", None, -0.001, 0.16)]),
            Figure(caption="Torque.", alt="a sine", svg=torque_plot(t_s, np.sin(t_s), np.cos(t_s))),
            Conclusion(outcome="seen in part", reason="the mean agrees, the worst was not printed"),
        ),
    )
    notes = Section(title="Notes", blocks=(Bullets(items=("one", "two")),))
    return Document(title="A study", subtitle="of one experiment", sections=(experiment, notes))


def test_a_document_is_read_back_from_its_json(tmp_path: Path) -> None:
    document = study()
    write_page(tmp_path / "study.json", document)
    assert Document.model_validate_json((tmp_path / "study.json").read_bytes()) == document
    # Numbers stay numbers, unrounded.
    rows = json.loads((tmp_path / "study.json").read_text())["sections"][0]["blocks"][1]["rows"]
    assert rows == [["mean", 6.6, 7.125, 0.03], ["worst", None, -0.001, 0.16]]


def test_html_and_markdown_show_the_same_cells_in_the_form_of_their_column() -> None:
    document = study()
    page = html_page(document)
    html_rows = [re.findall(r"<td[^>]*>([^<]*)</td>", row) for row in re.findall(r"<tr>(.*?)</tr>", page)]
    text, _ = markdown_page(document, "figures")
    lines = [line for line in text.splitlines() if line.startswith("| ")][2:]
    shown = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
    assert [row for row in html_rows if row] == shown
    # No sign for what rounds to zero; a dash where there is nothing.
    assert shown == [["mean", "6.6", "7.12", "0.03"], ["worst", "–", "0.00", "0.16"]]
    assert '<th colspan="2">here</th>' in page


def test_text_is_escaped_and_the_conclusion_has_its_reason() -> None:
    page = html_page(study())
    assert "<h2>Link length &amp; &lt;axis&gt;</h2>" in page
    assert "<strong>seen in part</strong>: the mean agrees" in page
    assert '<a href="#link-length-axis">' in page
    assert '<section id="link-length-axis">' in page


def test_a_figure_follows_the_page_between_light_and_dark() -> None:
    (figure,) = figures(study().section("Link length & <axis>"))
    assert PALETTE["measured"][0] in figure.svg
    drawing = themed(figure.svg)
    assert "var(--measured)" in drawing
    for light, _ in PALETTE.values():
        assert light not in drawing
    # What is left would be unreadable on one of the two pages.
    assert not re.search(r"(fill|stroke): ?#(000000|ffffff)", drawing)


def test_markdown_refers_to_the_figures_that_are_written(tmp_path: Path) -> None:
    write_page(tmp_path / "study.md", study())
    (name,) = re.findall(r"!\[a sine\]\((.*?)\)", (tmp_path / "study.md").read_text())
    assert ElementTree.parse(tmp_path / name).getroot().tag.endswith("svg")


def panels() -> Plot:
    """Two panels: a signal with many points, and a few points with their level."""
    t_s = tuple(np.linspace(0.0, 1.0, 2000))
    few = (0.0, 1.0)
    return Plot(
        caption="A signal & its level.",
        x_label="time [s]",
        panels=(
            Panel(y_label="velocity [rad/s]", curves=(Curve(label="measured", x=t_s, y=t_s),)),
            Panel(
                y_label="length [mm]",
                title="one arm",
                curves=(
                    Curve(label="points", x=few, y=(484.0, 484.1), style="points"),
                    Curve(label="truth", x=few, y=(484.0, 484.0), style="level"),
                ),
            ),
        ),
    )


def test_a_plot_shows_every_label_once_and_every_panel_with_its_units() -> None:
    figure = panel_figure(panels())
    texts = [
        "".join(one.itertext())
        for one in ElementTree.fromstring(figure.svg).iter()
        if one.tag.endswith("text")
    ]
    for text in ("measured", "points", "truth", "velocity [rad/s]", "length [mm]", "time [s]", "one arm"):
        assert texts.count(text) == 1, text
    assert figure.alt == "A signal & its level: measured; points; truth, over time [s]"
    # No offset that is written elsewhere.
    assert any(text.startswith("484.0") for text in texts)
    assert not re.search(r"(fill|stroke): ?#(000000|ffffff)", themed(figure.svg))


def test_a_plot_without_data_is_refused() -> None:
    empty = Panel(y_label="length [mm]", curves=(Curve(label="measured", x=(), y=()),))
    for none in (empty, Panel(y_label="length [mm]", curves=())):
        with pytest.raises(ValueError, match=r"A signal & its level\. The panel length \[mm\]"):
            panel_figure(panels().model_copy(update={"panels": (none,)}))


def test_a_table_of_contents_leads_to_sections_in_place_of_the_row_of_links(tmp_path: Path) -> None:
    columns = (Column(name="experiment", link=True), Column(name="outcome"))
    rows = [("Link length & <axis>", "seen in part")]
    contents = Section(title="Summary", blocks=(Table.of("All", columns, rows),))
    document = study().model_copy(update={"sections": (contents, *study().sections)})
    page = html_page(document)
    assert "<nav>" not in page
    assert '<a href="#link-length-axis">Link length &amp; &lt;axis&gt;</a>' in page
    assert '<section id="link-length-axis">' in page
    assert '<span class="outcome part">seen in part</span>' in page
    text, drawings = markdown_page(document, "figures")
    assert "[Link length & <axis>](#link-length-axis)" in text
    assert '<a id="link-length-axis"></a>' in text
    # A drawing in a file of its own is legible on a dark ground too.
    assert all(f"background: {PALETTE['paper'][0]}" in drawing for drawing in drawings.values())


def test_the_same_document_gives_the_same_bytes() -> None:
    assert html_page(study()) == html_page(study())


@pytest.mark.parametrize(
    ("form", "cell", "shown"),
    [
        (".1f", -0.04, "0.0"),
        ("+.1f", 2.7, "+2.7"),
        ("+.1f", -0.04, "+0.0"),
        ("d", 3, "3"),
        (".4g", None, "–"),
    ],
)
def test_numbers_are_shown_in_any_form_and_zeros_without_a_minus(
    form: str, cell: float | None, shown: str
) -> None:
    assert Column(name="length", form=form).shown(cell) == shown


def test_an_empty_cell_of_a_spanning_column_is_part_of_the_one_above() -> None:
    columns = (Column(name="item", spans=True), Column(name="by"), Column(name="error", unit="mm"))
    rows = [
        ("one", "thesis", 4.0),
        ("", "ours", 1.0),
        ("two", "thesis", 3.0),
        ("", "ours", 2.0),
        ("", "", 1.0),
    ]
    section = Section(title="Items", blocks=(Table.of("Items", columns, rows),))
    page = html_page(Document(title="A study", sections=(section,)))
    assert re.findall(r'<td class="name" rowspan="(\d)">(\w+)</td>', page) == [("2", "one"), ("3", "two")]
    counts = [len(re.findall("<td", row)) for row in re.findall(r"<tr>(.*?)</tr>", page)[1:]]
    # The last row has its own cell without a text: only columns that span merge.
    assert counts == [3, 2, 3, 2, 2]


def test_a_row_without_a_cell_for_every_column_is_refused() -> None:
    with pytest.raises(ValueError, match="Error: a row of 1 cells, 2 columns"):
        Table.of("Error", (Column(name="a"), Column(name="b")), [(1.0,)])


def test_a_suffix_that_is_no_report_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"a report ends in \.html, \.md, \.json, not in \.pdf"):
        write_page(tmp_path / "study.pdf", study())


def test_a_section_that_is_not_there_is_answered_with_those_that_are() -> None:
    with pytest.raises(KeyError, match="Notes"):
        study().section("Results")
    assert tables(study().section("Notes")) == []


def test_pauses_between_motions_are_cut_and_nothing_else() -> None:
    t_s = np.array([3.0, 3.1, 3.2, 9.0, 9.1])
    time_s, parts = without_pauses(t_s)
    np.testing.assert_allclose(time_s, [0.0, 0.1, 0.2, 0.2 + PAUSE_S, 0.3 + PAUSE_S])
    assert [part.tolist() for part in parts] == [[0, 1, 2], [3, 4]]


def test_without_matplotlib_it_says_which_extra_is_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coordinator.report.plots.find_spec", lambda name: None)
    with pytest.raises(MissingPlots, match=r"x5-self-model\[report\]"):
        check_plots()
