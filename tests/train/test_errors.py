import io

import pytest
import torch

from renderer.errors import InputError
from train import errors
from train.errors import one_sentence, writable_file, writable_folder


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (InputError("light=x is not known"), "light=x is not known"),
        (PermissionError(13, "Permission denied", "/a/b"), "/a/b cannot be read or written: Permission denied"),
        (OSError(28, "No space left on device"), "the output cannot be written (No space left on device): make room"),
        (OSError(28, "No space left", "/a/b"), "/a/b cannot be written (No space left): make room and start again"),
        (RuntimeError("[/gloo/x.cc:1] Connection closed by peer"), "another process of this run has ended: "),
        (torch.distributed.DistBackendError("NCCL error"), "another process of this run has ended: "),
        (UnicodeEncodeError("utf-8", "a\udcffb", 1, 2, "no"), r"'a\udcffb' has characters that this system"),
        (MemoryError(), "memory ran out: ask for fewer or smaller images"),
        (torch.OutOfMemoryError("x"), "memory ran out"),
        (RuntimeError("can't allocate memory"), "memory ran out"),
        (ZeroDivisionError(), None),
        (RuntimeError("a mistake of the program"), None),
    ],
)
def test_an_error_is_one_sentence_where_the_user_can_fix_it(error, sentence):
    result = one_sentence(error)
    assert (result is None) == (sentence is None)
    assert result is None or (result.startswith(sentence) and "\n" not in result)


def test_trying_an_output_leaves_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").write_text("old")
    for folder in ("there", "a/b", tmp_path / "c"):
        writable_folder(folder, "out")
    for file in ("there/file", "c/new"):
        writable_file(file, "out")
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "there", tmp_path / "there" / "file"]
    assert (tmp_path / "there" / "file").read_text() == "old"
    for check in (writable_folder, writable_file):
        with pytest.raises(InputError, match=r"^out=[^\n]* cannot be written [^\n]*: choose another (file|folder)$"):
            check("/dev/null/a", "out")


def test_a_full_disk_is_noticed_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(errors.tempfile, "TemporaryFile", lambda dir: io.FileIO("/dev/full", "w"))
    with pytest.raises(InputError, match=rf"out={tmp_path} cannot be written to \(No space left on device\)"):
        writable_folder(tmp_path, "out")
