"""The pages in docs/ are what the studies' Markdown makes, so that neither is edited without the other."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
STUDIES = ROOT / "train" / "studies"
PAGES = {
    "accuracy/study": "accuracy",
    "growth/study": "performance",
    "interruptions/study": "interruptions",
    "load/study": "load",
    "placed_lights": "performance",
    "reliability/study": "reliability",
    "renderer_speed/study": "performance_renderer",
    "renderer_speed/vertices": "performance_renderer",
    "training_speed/study": "performance",
    "transport/study": "transport",
    **{f"paper/{path.stem}": "paper" for path in STUDIES.glob("paper/*.md")},
}


def test_every_study_with_markdown_has_a_page():
    assert {path.relative_to(STUDIES).with_suffix("").as_posix() for path in STUDIES.rglob("*.md")} == PAGES.keys()


@pytest.mark.parametrize(("template", "page"), PAGES.items())
def test_the_committed_page_has_the_words_of_its_study_in_their_order(template, page):
    words, at = " ".join((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8").split()), 0
    told = " ".join((STUDIES / f"{template}.md").read_text(encoding="utf-8").split())
    for part in map(str.strip, re.split(r"\{[^{}]*\}", told)):
        assert part in words[at:], part
        at = words.index(part, at) + len(part)
