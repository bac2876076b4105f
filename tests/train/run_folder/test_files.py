"""A run's folder, when others write in it or have written what it holds."""

import json
import re
import shutil
from pathlib import Path

import pytest
from filelock import FileLock
from omegaconf import OmegaConf

from renderer.errors import InputError
from train.command_line.configuration import composed
from train.report.compare import format_comparison
from train.report.summary import format_table, summarize
from train.run_folder.files import LOCK, read_config, read_numbers, sole_writer

SCORES = {"test/accuracy": 0.5, "test/accuracy_last": 0.4, "test/epoch": 1}


@pytest.fixture
def run(finished, tmp_path) -> Path:
    """A finished run's folder, to be damaged."""
    return shutil.copytree(finished, tmp_path / "run")


def test_a_folder_has_one_writer_at_a_time_and_all_asked_for_are_held_or_none(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    held = pytest.raises(InputError, match=rf"run={b} is being written by another process")
    with sole_writer("run", b), held, sole_writer("run", a, b):
        pass
    for folder in (a, b):
        FileLock(folder / LOCK).acquire(blocking=False)


@pytest.mark.parametrize("name, key", [("train", "run"), ("attack", "out"), ("evaluate_photos", "out")])
def test_folders_of_the_same_second_have_different_names(name, key):
    assert re.search(r"\d\d-\d\d-\d\d-\d{6}$", composed(name, [])[key])


# ---------------------------------------------------------------------------------------- config.yaml


def test_what_looks_like_an_interpolation_is_text(tmp_path, monkeypatch):
    monkeypatch.setenv("SECRET", "hunter2")
    texts = ["${oc.env:SECRET}", "${a}", r"\${a}", r"\\${b}", "${", "$", "a${b}c${d}", "$${x}"]
    path = tmp_path / "config.yaml"
    path.write_text(json.dumps({"a": texts, "b": {"c": texts[0]}}))
    config = read_config(path)
    assert list(config.a) == texts and config.b.c == texts[0]
    assert OmegaConf.to_container(config, resolve=True) == json.loads(path.read_text())


def test_tables_of_a_run_show_no_variable_of_the_environment(run, monkeypatch):
    monkeypatch.setenv("SECRET", "hunter2")
    text = (run / "config.yaml").read_text()
    for key, value in [
        ("weight_decay: 0.0005", "weight_decay: ${oc.env:SECRET}"),
        ("arm: adv", "arm: ${oc.env:SECRET}"),
    ]:
        assert key in text
        text = text.replace(key, value)
    (run / "config.yaml").write_text(text)
    shown = format_table([summarize(run)]) + format_comparison([summarize(run)], [])
    assert "hunter2" not in shown and "${oc.env:SECRET}" in shown


BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{n + 1}: &a{n + 1} [{', '.join(9 * [f'*a{n}'])}]\n" for n in range(9))


@pytest.mark.parametrize(
    "content",
    [b"", b"seed", b"- 1", b"a: [", b"\xff\xfe", b"a: 1\na: 2", b"seed: ???", b"[" * 5000, BOMB.encode(), b"#" * 2**21,
     b"!!python/object/apply:os.system [touch hacked]", b"{}", b"seed: 1", b"run: [1]\nseed: {}\n"],
    ids=["empty", "word", "list", "cut", "utf-16", "twice", "unset", "deep", "bomb", "large",
         "code", "none", "few", "odd"],
)  # fmt: skip
def test_a_damaged_configuration_is_one_sentence_that_names_it(run, content):
    (run / "config.yaml").write_bytes(content)
    with pytest.raises(
        InputError, match=rf"^{re.escape(str(run))}\S* .*config\.yaml|config\.yaml is damaged"
    ) as caught:
        summarize(run)
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------------------------------- metrics and scores


@pytest.mark.parametrize(
    "content",
    [b"{\n", b"\xff\n", b"[1]\n", b'"x"\n', b"[" * 100_000 + b"\n", b"1" * 5000 + b"\n", b'{"test/accuracy": "high"}\n',
     b'{"test/accuracy": 0.5}\n', b'{"seconds/attack": {}}\n', b"null\n", b"{}\n"],
)  # fmt: skip
def test_damaged_metrics_are_one_sentence_that_names_them(run, content):
    (run / "metrics.jsonl").write_bytes(content)
    with pytest.raises(InputError, match=r"metrics\.jsonl") as caught:
        summarize(run)
    assert str(run) in str(caught.value) and "\n" not in str(caught.value)


def test_a_last_line_that_was_cut_short_is_no_damage(tmp_path):
    (tmp_path / "lines").write_text('{"epoch": 1}\n{"epo')
    assert read_numbers(tmp_path / "lines") == [{"epoch": 1}]


@pytest.mark.parametrize(
    "content", ["", "[]", "{}", '{"recall": 1}', '{"recall": {"value": 0.5}}', '{"auc": {"value": "a"}}', "\ud800"]
)
def test_a_damaged_summary_of_photographs_is_one_sentence_that_names_it(run, content):
    (run / "photographs" / "summary.json").write_bytes(content.encode("utf-8", "surrogatepass"))
    with pytest.raises(InputError, match=r"summary\.json") as caught:
        summarize(run)
    assert str(run) in str(caught.value) and "\n" not in str(caught.value)
