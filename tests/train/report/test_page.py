"""The report, of runs in every state, as a file and in a browser."""

import io
import json
import re
import shlex
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
import torch
from PIL import Image

from augment.service import AttackExamples
from renderer.errors import InputError
from train.attack_examples import write_attack_examples
from train.report import plots
from train.report.command import training_command
from train.report.page import report_of, write_report
from train.report.summary import summarize
from train.run_folder import decisive_settings, locked
from train.settings import ExperimentSettings, compose, read_settings
from train.tables import fraction

HOSTILE = "<script>alert(1)</script>|*x*"


class Page(HTMLParser):
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
    line = {
        "example": 0, "label": [HOSTILE], "predicted_before": ["a"], "confidence_before": [0.5], "predicted": ["b"],
        "confidence": [0.5], "success": True, "success_before": False, "steps": 3,
    }  # fmt: skip
    lines = [line, line | {"example": 1, "steps": 0, "success_before": True}]
    (attack / "attack.jsonl").write_text("".join(json.dumps(each) + "\n" for each in lines))
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
    assert re.search(r"<td[^>]*>[^<]*/going</td><td>interrupted</td><td>1</td>", text)
    assert re.search(r"<td[^>]*>[^<]*/failed</td><td>failed: &lt;script", text)
    assert re.search(r"<td[^>]*>[^<]*/weights</td><td>interrupted</td><td>0</td>", text)
    assert re.search(r"<td[^>]*>[^<]*/begun</td><td>in training</td><td>0</td>", text)
    for name in ("damaged", "old"):
        assert re.search(rf"/{name}</td><td[^>]*>cannot be read: [^<]*/{name}", text)
    assert "2 of 8 runs finished" in text
    assert re.search(r'alt="training accuracy by epoch, at the end: [^"]*unfinished: going 0.50"', text)
    assert "1 attacks" in text and "Attacks succeed on 1 of 1 examples; 1 more were wrong before any step" in text
    assert re.search(r'alt="orange before: [^"]*; a ball in its light"', text)


@pytest.mark.parametrize(
    "overrides", [[], ["augment=none", "seed=3"], ["attack@augment.attack=[lighting,geometry]", "label=apple"]]
)
def test_the_command_makes_the_same_settings_again(tmp_path, made_up_run, overrides):
    config = summarize(made_up_run(tmp_path / "run", "adversarial", None, *overrides)).config
    words = shlex.split(training_command(config))[3:]
    again = read_settings(ExperimentSettings, compose("train", words))
    before, after = ({**decisive_settings(settings), "data.images": None} for settings in (config, again))
    assert after == before


def test_paths_below_the_current_folder_are_relative(tmp_path, made_up_run, monkeypatch):
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    paths = [here / "a" / "data.npz", tmp_path / "there" / "orange.glb", f"/else{here}/data.glb"]
    made_up_run(here / "run", "none", None, f"data.path={paths[0]}", f"scene.meshes=['{paths[1]}','{paths[2]}']")
    report = write_report([here / "run"], here)
    text = report.read_text()
    assert "data.path=a/data.npz" in text and str(paths[1]) in text and paths[2] in text
    assert str(here) not in text.replace(paths[2], "")


def test_where_nothing_can_be_read_one_sentence_says_why(tmp_path):
    """A run that cannot be read beside one that can is named in the page."""
    with pytest.raises(InputError, match="holds no run and no attack"):
        write_report([tmp_path], tmp_path)
    assert report_of([tmp_path / "no"], tmp_path).startswith("no report: runs: ")
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "metrics.jsonl").write_bytes(b"\xff{\n")
    with pytest.raises(InputError, match=rf"^runs: nothing there can be read: {tmp_path}/a/metrics.jsonl"):
        write_report([tmp_path], tmp_path)
    (tmp_path / "b" / "metrics.jsonl").write_text("")
    assert "/a</td><td" in write_report([tmp_path], tmp_path).read_text()


def test_a_fault_of_the_report_is_printed_with_its_traceback_and_ends_no_training(finished, tmp_path, monkeypatch):
    monkeypatch.setattr(plots, "curves", lambda *_: 1 / 0)
    first, *frames, last = report_of([finished], tmp_path).strip().splitlines()
    assert first.startswith("no report: Traceback") and last == "ZeroDivisionError: division by zero"
    assert any(frame.endswith(", in _epochs") for frame in frames)


# ------------------------------------------------------------------------------------- headline


def write_examples(folder: Path, epoch: int, before: list[float], after: list[float]) -> None:
    """Two gray renders of orange that are predicted as apple or orange with these probabilities."""
    images, lights = torch.full((2, 2, 3, 8, 8), 0.5), torch.zeros(2, 2, 49, 3)
    probabilities = torch.tensor([before, after])[:, None].expand(2, 2, 2)
    (folder / "renders").mkdir(exist_ok=True)
    examples = AttackExamples(*images, *lights, *probabilities, torch.ones(2, dtype=torch.int64))
    write_attack_examples(folder / "renders" / f"epoch_{epoch:03d}.safetensors", examples, ["apple", "orange"])


@pytest.fixture
def arm(made_up_run, tmp_path):
    """The folders of an arm's runs, a seed for each pair of true and false positives among ten."""

    def make(name: str, *counts: tuple[int, int], overrides: tuple[str, ...] = ()) -> list[Path]:
        folders = []
        for seed, (hits, false_positives) in enumerate(counts):
            auc = {"value": 0.9, "low": 0.8, "high": 1.0}
            scores = {"recall": fraction(hits, 10), "false_positive_rate": fraction(false_positives, 10), "auc": auc}
            settings = [f"seed={seed}", "evaluate.photos=/data/a", *overrides]
            folders.append(made_up_run(tmp_path / f"{name}{seed}", name, {"photographs": scores}, *settings))
        return folders

    return make


def test_the_headline_shows_changed_predictions_and_the_mean_scores_over_seeds_of_every_arm(arm, tmp_path):
    folders = [*arm("none", (2, 0), (4, 0)), *arm("random", (5, 1)), *arm("adversarial", (7, 2))]
    write_examples(folders[-1], 1, [0.125, 0.875], [0.75, 0.25])
    write_examples(folders[-1], 2, [0.75, 0.25], [0.75, 0.25])  # wrong before, too
    page = write_report(folders, tmp_path / "out")
    assert Page(page.read_text()).alts[0] == (
        "Orange before and after its light changed, classified as orange, then apple; orange, then apple. "
        "recall on photographs: none 0.30, random 0.50, adversarial 0.70. "
        "FPR on photographs: none 0.00, random 0.10, adversarial 0.20. "
        "AUC on photographs: none 0.90, random 0.90, adversarial 0.90."
    )
    with Image.open(tmp_path / "out" / "report.png") as image:
        assert image.width == 1440


def test_all_of_many_runs_are_shown_or_named_in_a_page_of_bounded_size(made_up_run, tmp_path):
    """Half of them failed; of the others, five seeds share their settings."""
    one, count = made_up_run(tmp_path / "one", "adversarial"), 70
    config = (one / "config.yaml").read_text()
    for number in range(count):
        folder = tmp_path / "runs" / f"run{number:04d}"
        folder.mkdir(parents=True)
        if number % 2:
            (folder / "failed.txt").write_text("no room")
            continue
        rate, seed = 0.001 * (1 + number // 10), number // 2 % 5
        changed = config.replace("seed: 0", f"seed: {seed}").replace(": 0.05\n", f": {rate}\n")
        (folder / "config.yaml").write_text(changed)
        shutil.copy(one / "metrics.jsonl", folder)
    text = write_report([tmp_path / "runs"], tmp_path / "out").read_text()
    assert len(text) < 10 * 2**20 and f"{count // 2} of {count} runs finished" in text
    assert all(f"/run{number:04d}" in text for number in range(count))


# ------------------------------------------------------------------------------------- in a browser


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


@pytest.mark.parametrize("width", [1280, 400])
@pytest.mark.parametrize("scheme, paper", [("light", (255, 255, 255)), ("dark", (22, 24, 28))])
def test_a_browser_shows_the_page_without_overflow_wide_and_narrow_light_and_dark(page, browser, width, scheme, paper):
    view, urls = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme), []
    view.on("request", lambda request: urls.append(request.url))
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
    assert [url for url in urls if not url.startswith("data:")] == [page.as_uri()]
    view.close()
