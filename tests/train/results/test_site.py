import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest

ROOT = Path(__file__).parents[3]
PAGES = (
    *("index", "quickstart", "guide", "tour", "networks", "conventions", "results"),
    *("accuracy-and-speed", "changelog", "contributing", "auto_gallery/index"),
    *("auto_gallery/attacks/lighting", "api/index", "api/rendering"),
    *("api/generated/norm_balls.render", "api/generated/norm_balls.AttackSettings"),
)
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """Build the site from a copy of its pages, without running the scripts of the gallery."""
    pytest.importorskip("sphinx_gallery")
    folder = tmp_path_factory.mktemp("site")
    generated = shutil.ignore_patterns("auto_gallery", "generated", "backreferences")
    for path in ROOT.iterdir():
        if path.name in {"docs", "pretrained"}:
            shutil.copytree(path, folder / path.name, ignore=generated)
        elif path.suffix == ".md":
            shutil.copy(path, folder)
        else:
            (folder / path.name).symlink_to(path)
    options = ["-q", "-W", "-D", "sphinx_gallery_conf.plot_gallery=0"]
    command = [sys.executable, "-m", "sphinx", *options, "docs", "html"]
    subprocess.run(command, cwd=folder, check=True)
    return folder / "html"


@pytest.fixture(params=[(1280, "light"), (400, "dark")])
def view(request, browser) -> Iterator[Any]:
    """Open an empty page, and fail at its end if the console had an error."""
    width, scheme = request.param
    opened = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
    errors = []
    opened.on("pageerror", lambda error: errors.append(str(error)))
    opened.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    yield opened
    opened.close()
    assert errors == []


@pytest.mark.parametrize("name", PAGES)
def test_a_page_shows_its_pictures_and_never_scrolls_sideways(site, view, name):
    view.goto((site / f"{name}.html").as_uri())
    # Pictures below the screen are loaded late.
    view.evaluate("[...document.images].forEach(image => { image.loading = 'eager' })")
    view.wait_for_function("[...document.images].every(image => image.complete)")
    assert view.evaluate("[...document.images].every(image => image.naturalWidth > 0)")
    assert view.evaluate("document.documentElement.scrollWidth") <= view.viewport_size["width"]


@pytest.mark.parametrize("name", PAGES)
def test_links_lead_to_a_place_in_the_site(site, browser, name):
    page = browser.new_page()
    page.goto((site / f"{name}.html").as_uri())
    links = page.evaluate("[...document.links].map(link => link.href)")
    page.close()
    inside = [urlsplit(link) for link in links if link.startswith("file:")]
    assert len(inside) > 5
    for link in inside:
        target = Path(unquote(link.path))
        assert target.is_file(), target
        if link.fragment and target.suffix == ".html":
            assert f'id="{unquote(link.fragment)}"' in target.read_text(), link
