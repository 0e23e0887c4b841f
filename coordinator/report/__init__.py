"""Reports for people: a document of sections, tables and figures, as HTML, Markdown and JSON."""
