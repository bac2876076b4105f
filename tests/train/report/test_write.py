"""The report, of runs in every state, as a file and in a browser."""

import base64
import io
import json
import os
import re
import shlex
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
from PIL import Image

from renderer.errors import InputError
from train.command_line.configuration import composed
from train.report import images, plots
from train.report.command import training_command
from train.report.summary import summarize
from train.report.write import report_of, write_report
from train.run_folder.continuation import decisive_settings
from train.run_folder.files import locked

HOSTILE = "<script>alert(1)</script>|*x*"


class Sources(HTMLParser):
    """The page's tags, addresses and alternative texts."""

    def __init__(self, text: str):
        super().__init__()
        self.tags, self.addresses, self.alts = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for name, value in attrs if name in ("src", "href")]
        self.alts += [dict(attrs).get("alt")] if tag == "img" else []


@pytest.fixture(scope="module")
def page(finished, made_up_run, tmp_path_factory) -> Path:
    """Of a finished run, one of another arm, and such as are still going, failed, damaged, or from elsewhere."""
    folder = tmp_path_factory.mktemp("all")
    shutil.copytree(finished, folder / "finished")
    made_up_run(folder / "plain")
    made_up_run(folder / "old", "none", {"photographs": {"recall": {"value": 0.5}}})
    for name in ("going", "damaged", "failed", "weights", "begun"):
        (folder / name).mkdir()
    (folder / "weights" / "best.pt").write_bytes(b"")
    for name in ("config.yaml", "train.log"):
        (folder / "begun" / name).touch()
    (folder / "going" / "metrics.jsonl").write_text('{"epoch": 1, "train/accuracy": 0.5}\n{"epo')
    (folder / "damaged" / "metrics.jsonl").write_bytes(b"\xff{\n")
    (folder / "failed" / "failed.txt").write_text(HOSTILE)
    attack = folder / "attacks" / HOSTILE.replace("/", "_")
    attack.mkdir(parents=True)
    line = {"example": 0, "label": [HOSTILE], "predicted": ["b"], "confidence": [0.5], "success": True, "steps": 3}
    lines = [line, line | {"example": 1, "steps": 0, "success_before": True}]
    (attack / "attack.jsonl").write_text("".join(json.dumps(each) + "\n" for each in lines))
    with locked(folder / "begun"):
        return write_report([folder], folder / "out")


def test_a_page_loads_nothing_escapes_what_files_say_and_tells_images_in_words(page):
    text = page.read_text()
    found = Sources(text)
    assert {address.partition(":")[0] for address in found.addresses if address[0] != "#"} == {"data"}
    assert "script" not in found.tags and "&lt;script&gt;" in text
    assert found.alts and all(found.alts)
    assert len(text) < 10 * 2**20


def test_runs_in_every_state_are_shown_or_named(page):
    text = page.read_text()
    assert re.search(r"<td[^>]*>[^<]*/going</td><td>interrupted</td><td>1</td>", text)
    assert re.search(r"<td[^>]*>[^<]*/failed</td><td>failed: &lt;script", text)
    assert re.search(r"<td[^>]*>[^<]*/weights</td><td>interrupted</td><td>0</td>", text)
    assert re.search(r"<td[^>]*>[^<]*/begun</td><td>in training</td><td>0</td>", text)
    for name in ("damaged", "old"):
        assert re.search(rf"/{name}</td><td[^>]*>cannot be read: [^<]*/{name}", text)
    assert "2 of 8 runs finished" in text
    assert re.search(r'alt="accuracy, training over epochs, at the end: [^"]*unfinished: going 0.50"', text)
    assert "1 attacks" in text and "in 1 of 2, 1 more being wrong before any step" in text


def test_markdown_says_the_same_and_its_images_are_there(page):
    text = (page.parent / "report.md").read_text()
    images = re.findall(r"!\[.*\]\((.*)\)", text)
    found = Sources(page.read_text())
    assert len(images) == len(found.alts) and "<script>" not in text
    for name, address in zip(images, [each for each in found.addresses if each.startswith("data:")], strict=True):
        assert (page.parent / name).read_bytes() == base64.b64decode(address.partition(",")[2])
    assert re.findall(r"^## (.*)$", text, re.M)[:2] == ["In short", "Arms"]


def test_the_lights_that_fooled_are_shown(page):
    assert re.search(r'alt="orange before: called [^"]*; a ball in its light"', page.read_text())


@pytest.mark.parametrize(
    "overrides", [[], ["augment=none", "seed=3"], ["attack@augment.attack=[lighting,geometry]", "label=apple"]]
)
def test_the_command_makes_the_same_settings_again(tmp_path, made_up_run, overrides):
    config = summarize(made_up_run(tmp_path / "run", "adversarial", None, *overrides)).config
    words = shlex.split(training_command(config))[3:]
    again = composed("train", words)
    expected, found = ({**decisive_settings(each), "data.images": None} for each in (config, again))
    assert {key: value for key, value in found.items() if key in expected} == expected


def test_paths_below_the_current_folder_are_relative(tmp_path, made_up_run, monkeypatch):
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    paths = [here / "a" / "data.npz", tmp_path / "there" / "orange.glb", f"/else{here}/data.glb"]
    made_up_run(here / "run", "none", None, f"data.path={paths[0]}", f"scene.meshes=['{paths[1]}','{paths[2]}']")
    report = write_report([here / "run"], here)
    for text in (report.read_text(), report.with_suffix(".md").read_text()):
        assert "data.path=a/data.npz" in text and str(paths[1]) in text and paths[2] in text
        assert str(here) not in text.replace(paths[2], "")


def test_where_there_is_nothing_one_sentence_says_so(tmp_path):
    with pytest.raises(InputError, match="holds no run and no attack"):
        write_report([tmp_path], tmp_path)
    assert report_of([tmp_path / "no"], tmp_path).startswith("no report: runs: ")


def test_where_nothing_can_be_read_one_sentence_says_why(tmp_path):
    """A run that cannot be read beside one that can is named in the page."""
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.jsonl").write_bytes(b"\xff{\n")
    with pytest.raises(InputError, match=rf"^runs: nothing there can be read: {tmp_path}/a/metrics.jsonl"):
        write_report([tmp_path], tmp_path)
    (tmp_path / "b" / "metrics.jsonl").write_text("")
    assert "/a</td><td" in write_report([tmp_path], tmp_path).read_text()


def test_a_fault_of_the_report_is_told_with_its_place_and_raises_nothing(finished, tmp_path, monkeypatch):
    monkeypatch.setattr(plots, "curves", lambda *_: 1 / 0)
    first, *frames, last = report_of([finished], tmp_path).strip().splitlines()
    assert first.startswith("no report: Traceback") and last == "ZeroDivisionError: division by zero"
    assert any(frame.endswith(", in _training") for frame in frames)


@pytest.fixture(scope="module")
def browser():
    """The system's Chromium, or playwright's own."""
    api = pytest.importorskip("playwright.sync_api")
    installed = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with api.sync_playwright() as playwright:
        try:
            found = playwright.chromium.launch(executable_path=installed, args=["--no-sandbox"])
        except api.Error as error:
            pytest.skip(f"no Chromium: {error.message.splitlines()[0]}")
        yield found
        found.close()


@pytest.mark.parametrize("width", [1280, 400])
@pytest.mark.parametrize("scheme, paper", [("light", (255, 255, 255)), ("dark", (22, 24, 28))])
def test_a_browser_shows_it_without_overflow_wide_and_narrow_light_and_dark(page, browser, width, scheme, paper):
    view, asked = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme), []
    view.on("request", lambda request: asked.append(request.url))
    view.goto(page.as_uri())
    assert view.evaluate("document.documentElement.scrollWidth") <= width
    assert view.evaluate("[...document.images].every(image => image.naturalWidth && image.alt)")
    outside = """width => [...document.querySelectorAll("p, h2, h3, img, figcaption, pre, a")]
        .filter(each => each.getBoundingClientRect().right > width).map(each => each.outerHTML)"""
    assert view.evaluate(outside, width) == []
    smallest = """Math.min(...[...document.querySelectorAll("p, td, th, figcaption, pre, a")]
        .map(each => parseFloat(getComputedStyle(each).fontSize)))"""
    assert view.evaluate(smallest) >= 12
    with Image.open(io.BytesIO(view.screenshot())) as shot:
        assert shot.convert("RGB").getpixel((width - 3, 3)) == paper
    assert [url for url in asked if not url.startswith("data:")] == [page.as_uri()]
    view.close()


def test_a_pipe_in_an_images_place_is_left_out(tmp_path):
    os.mkfifo(tmp_path / "contact_sheet.png")
    assert images.from_file(tmp_path / "contact_sheet.png", "answers", 100) == []
