import io

import pytest

from renderer.errors import InputError
from train.command_line import outputs
from train.command_line.outputs import writable_file, writable_folder


def test_what_can_be_written_is_left_as_it_was(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").write_text("old")
    assert writable_folder(tmp_path / "there", "out") == tmp_path / "there"
    assert writable_folder(tmp_path / "a" / "b", "out") == tmp_path / "a" / "b"
    assert writable_file(tmp_path / "there" / "file", "out").read_text() == "old"
    assert writable_file(tmp_path / "c" / "new", "out") == tmp_path / "c" / "new"
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "there", tmp_path / "there" / "file"]


def test_a_relative_folder_is_tried_where_the_process_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    writable_folder("a/b", "out")
    with pytest.raises(InputError, match=r"out=file/b cannot be written to \(Not a directory\): choose another folder"):
        writable_folder("file/b", "out")


@pytest.mark.parametrize("name", ["/proc/none", "/dev/null/a", "/dev/full", "x" * 300])
def test_what_cannot_be_written_is_refused_by_key_and_name(name):
    for try_it in (writable_folder, writable_file):
        with pytest.raises(InputError, match=r"^out=.* cannot be written.*: choose another fil|fol"):
            try_it(name, "out")


def test_a_full_disk_is_noticed_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(outputs.tempfile, "TemporaryFile", lambda dir: io.FileIO("/dev/full", "w"))
    with pytest.raises(InputError, match=rf"out={tmp_path} cannot be written to \(No space left on device\)"):
        writable_folder(tmp_path, "out")
