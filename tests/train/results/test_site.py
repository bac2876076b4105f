"""Chromium shows the documentation site: its links lead somewhere, and its search finds names."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
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


@pytest.fixture(scope="module")
def address(site) -> Iterator[str]:
    """Serve the site, because the search fetches the pages that it finds."""
    handler = partial(SimpleHTTPRequestHandler, directory=str(site))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


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


def test_the_index_leads_to_the_results(site, view):
    view.goto((site / "index.html").as_uri())
    view.locator("article a[href^='results.html']").first.click()
    assert view.url.startswith((site / "results.html").as_uri())


def test_the_search_finds_a_public_name(address, view):
    view.goto(f"{address}/search.html?q=precompute_transfer")
    found = view.locator("#search-results a").first
    found.wait_for()
    assert "precompute_transfer" in found.get_attribute("href")
