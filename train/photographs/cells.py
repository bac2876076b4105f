"""Cells of tables of which no spreadsheet runs one as a formula."""

import re
from pathlib import PurePath

FORMULA = re.compile(r"'*[=+\-@\t\r]")  # how a name begins that is taken for one, or that has been made text


def as_cell(value: object) -> object:
    """A name that a spreadsheet would take for a formula begins with an apostrophe: it is text then. Else as it is."""
    is_formula = isinstance(value, str | PurePath) and FORMULA.match(str(value))
    return f"'{value}" if is_formula else value


def as_written(cell: str) -> str:
    """What `as_cell` was given, as text."""
    return cell[1:] if cell.startswith("'") and FORMULA.match(cell) else cell
