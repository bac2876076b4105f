from pathlib import Path

import pytest

from train.studies.page import write


def test_a_page_is_printed_written_and_not_lost_where_it_cannot_be_written(tmp_path, capsys):
    page = tmp_path / "a" / "page.md"
    write(page, "found ×\n")
    assert page.read_text(encoding="utf-8") == "found ×\n"
    assert capsys.readouterr().out == f"found ×\n\nwritten: {page}\n"
    with pytest.raises(OSError, match="No space left"):
        write(Path("/dev/full"), "found\n")
    assert capsys.readouterr().out == "found\n\n"
