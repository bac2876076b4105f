"""The report, of runs in every state, as a file and in a browser."""

import json
import os
import shlex
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
from PIL import Image

from renderer.errors import InputError
from train.report import plots
from train.report.report_page import report_of, write_report
from train.runs.run_config import write_config
from train.runs.run_lock import locked

HOSTILE = "<script>alert(1)</script>|*x*"
COMMAND = "python -m train experiment=best"


class Page(HTMLParser):
    """The page's tags, addresses, alternative texts, and cells of tables."""

    def __init__(self, text: str):
        super().__init__()
        self.tags, self.addresses, self.alts, self.rows = [], [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href")]
        self.alts += [dict(attrs).get("alt")] if tag == "img" else []
        self.rows += [[]] if tag == "tr" else []

    def handle_data(self, data):
        if self.tags[-1:] == ["td"] and data.strip():
            self.rows[-1].append(data)


@pytest.fixture(scope="module")
def page(finished, made_up_run, tiny, tmp_path_factory) -> Path:
    """Of a finished run, two of another arm, and such as are still going, failed, damaged, or from elsewhere."""
    folder = tmp_path_factory.mktemp("all")
    shutil.copytree(finished, folder / "finished")
    write_config(folder / "finished", tiny(), command=COMMAND)
    for seed in (0, 1):
        made_up_run(folder / f"plain{seed}", "none", None, f"seed={seed}")
    made_up_run(folder / "old", "none", {"photographs": {"recall": {"value": 0.5}}})
    for name in ("going", "damaged", "failed", "weights", "begun"):
        (folder / name).mkdir()
    (folder / "weights" / "best.pt").write_bytes(b"")
    for name in ("config.yaml", "train.log"):
        (folder / "begun" / name).touch()
    lines = '{"epoch": 1, "train/accuracy": 0.5}\n{"epoch": 2, "train/accuracy": 0.75}\n{"epo'
    (folder / "going" / "metrics.jsonl").write_text(lines)
    (folder / "damaged" / "metrics.jsonl").write_bytes(b"\xff{\n")
    (folder / "failed" / "failed.txt").write_text(HOSTILE)
    attack = folder / "attacks" / HOSTILE.replace("/", "_")
    attack.mkdir(parents=True)
    line = {
        "example": 0, "label": [HOSTILE], "predicted_before": ["a"], "confidence_before": [0.5], "predicted": ["b"],
        "confidence": [0.5], "success": True, "success_before": False, "steps": 3,
    }  # fmt: skip
    others = (
        line | {"example": 1, "steps": 0, "success_before": True},
        line | {"example": 2, "success": False},
        line | {"example": 3, "success": False, "success_without_noise": True},
    )
    lines = [*map(json.dumps, (line, *others, {"checks": {"random_search": 0.5}}))]
    (attack / "attack.jsonl").write_text("\n".join(lines))
    (folder / "other").mkdir()
    (folder / "other" / "attack.jsonl").write_text(json.dumps(line | {"confidence": "high"}))
    Image.new("RGB", (8, 8)).save(attack / "example_000.png")
    with locked(folder / "begun"):
        return write_report([folder], folder / "out")


def test_a_page_loads_nothing_from_elsewhere_escapes_text_of_files_and_describes_its_images(page):
    text = page.read_text()
    parsed = Page(text)
    assert {address.partition(":")[0] for address in parsed.addresses if address[0] != "#"} == {"data"}
    assert "script" not in parsed.tags and "&lt;script&gt;" in text
    assert parsed.alts and all(parsed.alts)
    assert len(text) < 10 * 2**20


def test_runs_in_every_state_are_shown_or_named(page):
    text = page.read_text()
    parsed = Page(text)
    states = {Path(cells[0]).name: cells[1:] for cells in parsed.rows if cells and "/" in cells[0]}
    assert states["going"] == ["interrupted", "2"] and states["weights"] == ["interrupted", "0"]
    assert states["failed"] == [f"failed: {HOSTILE}", "0"] and states["begun"] == ["in training", "0"]
    for name in ("damaged", "old", "other"):
        assert states[name][0].startswith(f"cannot be read: {page.parents[1]}/{name}")
    assert any(cells[:3] == ["none", "2 seeds", "0.765 ± 0.000"] for cells in parsed.rows)
    assert any(alt.startswith("training accuracy") and "unfinished: going 0.75" in alt for alt in parsed.alts)
    assert any(alt.startswith("Renders before and after, epoch ") for alt in parsed.alts)
    assert any(alt.startswith(f"Example 0, {HOSTILE}: success in 3 steps; ") for alt in parsed.alts)
    sentence = (
        "Attacks succeed on 1 of 3 examples, 2 without a sensor's noise; 1 more were wrong before any step; "
        "random search with as many"
    )
    assert f"{sentence} renders succeeds on 50%." in text
    outcomes = [cells[-1] for cells in parsed.rows if cells[1:2] == [HOSTILE]]
    rest = ["no success in 3 steps", "success only without noise in 3 steps"]
    assert outcomes == ["success in 3 steps", "wrong before any step", *rest]
    assert text.count(f"<pre>cd {shlex.quote(os.getcwd())}\n{COMMAND}</pre>") == 1


def test_a_line_is_drawn_where_it_has_points_that_differ():
    assert plots.curves({"a": [[(1, 0.5)]], "b": [[(1, 1), (2, 1)]]}, "x") is None
    assert plots.curves({"a": [[(1, 0.5)]], "b": [[(1, 0), (2, 1)]]}, "x") is not None


def test_where_nothing_can_be_read_one_sentence_says_why(tmp_path):
    """Runs that cannot be read are named in the page."""
    with pytest.raises(InputError, match="holds no run and no attack"):
        write_report([tmp_path], tmp_path)
    assert report_of([tmp_path / "no"], tmp_path).startswith("no report: runs: ")
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.jsonl").write_bytes(b"\xff{\n")
    assert "/a</td><td" in write_report([tmp_path], tmp_path).read_text()


def test_a_fault_of_the_report_is_printed_with_its_traceback_and_ends_no_training(finished, tmp_path, monkeypatch):
    monkeypatch.setattr(plots, "curves", lambda *_: 1 / 0)
    first, *_, last = report_of([finished], tmp_path).strip().splitlines()
    assert first.startswith("no report: Traceback") and last == "ZeroDivisionError: division by zero"


@pytest.fixture(scope="module")
def browser():
    """The system's Chromium, or playwright's own."""
    api = pytest.importorskip("playwright.sync_api")
    installed = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with api.sync_playwright() as playwright:
        try:
            chromium = playwright.chromium.launch(executable_path=installed, args=["--no-sandbox"])
        except api.Error as error:
            pytest.skip(f"no Chromium: {error.message.splitlines()[0]}")
        yield chromium
        chromium.close()


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (400, "dark")])
def test_a_browser_shows_the_page_without_overflow_wide_and_narrow_light_and_dark(page, browser, width, scheme):
    view, urls = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme), []
    view.on("request", lambda request: urls.append(request.url))
    view.goto(page.as_uri())
    assert view.evaluate("document.documentElement.scrollWidth") <= width
    assert view.evaluate("[...document.images].every(image => image.naturalWidth && image.alt)")
    assert [url for url in urls if not url.startswith("data:")] == [page.as_uri()]
    view.close()
