"""What tests of several modules of training read and draw."""


def read_markdown(text: str) -> dict[str, list[list[str]]]:
    """Read the tables of a Markdown text.

    Returns:
        Rows of cells, the header first, by the heading or line before each
        table. The key of a table without one is "".
    """
    tables = {}
    title = ""
    for paragraph in text.split("\n\n"):
        lines = paragraph.splitlines()
        table = [line for line in lines if line.startswith("|")]
        other_lines = [line for line in lines if not line.startswith("|")]
        if other_lines:
            title = other_lines[-1].removeprefix("### ").removesuffix(":")
        if table:
            tables[title] = _read_rows(table)
    return tables


def _read_rows(lines: list[str]) -> list[list[str]]:
    """Split the lines of one table, whose columns must be aligned, into cells."""
    header, separator, *rows = lines
    assert len({len(line) for line in lines}) == 1
    assert set(separator) == {"|", "-", " "}
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in (header, *rows)]
