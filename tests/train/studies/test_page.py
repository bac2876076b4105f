from pathlib import Path

import pytest

from train.studies.page import joined, with_section, write


def test_a_page_is_printed_written_and_not_lost_where_it_cannot_be_written(tmp_path, capsys):
    page = tmp_path / "a" / "page.md"
    write(page, "found ×\n")
    assert page.read_text(encoding="utf-8") == "found ×\n"
    assert capsys.readouterr().out == f"found ×\n\nwritten: {page}\n"
    with pytest.raises(OSError, match="No space left"):
        write(Path("/dev/full"), "found\n")
    assert capsys.readouterr().out == "found\n\n"


@pytest.mark.parametrize("heading", ["## First", "## Middle", "## Last"])
def test_a_section_takes_the_place_of_the_one_before(heading):
    titles = ["## First", "### Middle\n\nbelow the first", "## Middle", "## Last"]
    old, new = [f"{title}\n\n| old \\1 |" for title in titles], f"{heading}\n\n| new \\1 |\n\n### Below"
    changed = [new if title == heading else each for title, each in zip(titles, old, strict=True)]
    if heading == "## First":
        del changed[1]  # it is a part of the first section
    assert with_section(joined(["# Page", *old]), new) == joined(["# Page", *changed])


def test_a_section_that_is_new_comes_last():
    old = "# Page\n\n## Old\n\ntext\n"
    assert with_section(old, "## New\n\ntext\n") == f"{old}\n## New\n\ntext\n"
