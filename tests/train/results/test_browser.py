"""Chromium shows the page of an audit without errors, in light and dark, wide and narrow."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.helpers import darker_than, save_plain
from tests.train.helpers import attack_shortly
from train.auditing import lights
from train.command_settings import AuditSettings
from train.commands import audit
from train.commands.audit import run_audit

pytestmark = pytest.mark.slow
CLASSES = ("orange", "other")
# Least contrast of text by WCAG 2.1, level AA, section 1.4.3; and of large text.
CONTRAST = 4.5
CONTRAST_OF_LARGE_TEXT = 3.0
# The lowest contrast of visible text to the page, divided by what its size needs.
LOWEST_CONTRAST = """([needed, neededIfLarge]) => {
  const channels = (text) => text.match(/[\\d.]+/g).map(Number);
  const luminance = (color) => {
    const linear = color.slice(0, 3).map((value) => {
      const c = value / 255;
      return c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
    });
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2];
  };
  const background = (element) => {
    for (let e = element; e; e = e.parentElement) {
      const color = channels(getComputedStyle(e).backgroundColor);
      if (color.length === 3 || color[3] > 0) return color;
    }
    return [255, 255, 255];
  };
  let lowest = Infinity;
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement;
    if (!walker.currentNode.data.trim() || !element.checkVisibility()) continue;
    const style = getComputedStyle(element);
    const [a, b] = [luminance(channels(style.color)), luminance(background(element))];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    const size = parseFloat(style.fontSize);
    const isLarge = size >= 24 || (size >= 18.66 && style.fontWeight >= 700);
    lowest = Math.min(lowest, ratio / (isLarge ? neededIfLarge : needed));
  }
  return lowest;
}"""


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("audit")
    for label in CLASSES:
        for level in (0, 128):
            save_plain(folder / "lab" / label / f"{level}.png", level)
    given = {"network": "original", "meshes": ["solid:orange:0"], "environments": []}
    folders = {"laboratory": str(folder / "lab"), "out": str(folder / "out")}
    settings = AuditSettings(**given, **folders, budget=0.1, device="cpu")
    networks = {
        "classifier": darker_than(0.52, name="original", scale=20),
        "hardened": darker_than(0.45, name="hardened", scale=20),
    }
    kind = lights.KINDS["lighting"]._replace(radii=(0.1, 3.0))
    with pytest.MonkeyPatch.context() as patch:
        attack_shortly(patch, "lighting", steps=3, additional=3)
        patch.setattr(lights, "FRAME_COUNT", 7)
        patch.setitem(lights.KINDS, "lighting", kind)
        patch.setattr(audit, "RANDOM_LIGHT_COUNT", 1)
        return run_audit(settings, networks).path


@pytest.fixture(params=[(1280, "light"), (400, "dark")])
def view(request, page, browser) -> Iterator[Any]:
    """Open the page, and fail at its end if the console has an error."""
    width, scheme = request.param
    opened = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    errors = []
    opened.on("console", lambda message: errors.append(message.text))
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.goto(page.as_uri())
    yield opened
    opened.close()
    assert errors == []


def test_the_slider_changes_the_picture_the_light_and_the_prediction(view):
    before = [view.get_attribute(name, "src") for name in ("#object", "#ball")]
    assert view.text_content("#predicted") == "✓ orange"
    view.focus("#light")
    view.keyboard.press("End")
    after = [view.get_attribute(name, "src") for name in ("#object", "#ball")]
    assert view.text_content("#predicted") == "✗ other"
    assert all(one != other for one, other in zip(before, after, strict=True))


def test_details_open_and_the_page_never_scrolls_sideways(view):
    width = view.viewport_size["width"]
    details = view.locator("details.section")
    assert details.count() > 3
    for index in range(details.count()):
        item = details.nth(index)
        assert item.get_attribute("open") is None
        item.locator("summary").first.click()
        assert item.get_attribute("open") is not None
    assert view.evaluate("document.documentElement.scrollWidth") <= width
    assert view.evaluate("[...document.images].every(image => image.naturalWidth && image.alt)")


def test_text_has_the_contrast_of_wcag_aa(view):
    view.evaluate("document.querySelectorAll('details').forEach(item => { item.open = true })")
    limits = [CONTRAST, CONTRAST_OF_LARGE_TEXT]
    assert view.evaluate(LOWEST_CONTRAST, limits) >= 1


def test_a_page_with_a_slider_has_at_most_a_megabyte(page):
    """The page has a third of the usual frames, which are most of a page."""
    assert page.stat().st_size <= 2**20 / 3
