"""Settings of the documentation site: `sphinx-build -W --keep-going -b html docs build/site`."""

import dataclasses
import os
import re
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

from docutils.nodes import Element
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.ext.autodoc import Options

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
sys.path.insert(0, str(ROOT / "docs"))  # for pictures.py

import norm_balls as nb  # noqa: E402 (The path is set above.)
from renderer.settings import Settings  # noqa: E402
from train.cli import format_facts  # noqa: E402

project = "Parametric norm-balls"
author = "Parametric norm-balls maintainers"
project_copyright = author
version = installed_version("parametric-norm-balls")
release = version

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["gallery", "auto_gallery/**/*.ipynb"]
templates_path = ["_templates"]
# A name in single backticks links to its page, if it is public.
default_role = "py:obj"

html_theme = "furo"
html_title = f"{project} {version}"
html_show_sourcelink = False
html_favicon = "static/icon.svg"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False

myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
nb_execution_mode = "off"

autosummary_imported_members = True
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

SECTIONS = ("rendering", "light", "attacks", "training")
sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "auto_gallery",
    "filename_pattern": r"\.py$",
    "subsection_order": [f"gallery/{section}" for section in SECTIONS],
    "nested_sections": False,
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "image_scrapers": ("pictures.save_figures",),
    "reset_modules": ("pictures.set_style",),
    "capture_repr": (),
    "download_all_examples": False,
    "notebook_extensions": set(),
    "show_memory": False,
    "show_signature": False,
    "min_reported_time": 1e6,
    "write_computation_times": False,
    "plot_gallery": True,
    # The pages of the reference show the pictures that use a name.
    "backreferences_dir": "api/backreferences",
    "doc_module": ("norm_balls", "renderer", "augment", "train"),
}

# Pages of the site that hold a file outside docs/.
PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "pretrained/README.md": "networks.md",
}

# Sections of the README that are on the page of the quick start.
QUICK_START = ("#try-it", "#attack-a-network", "#audit-a-network", "#harden-a-network")


def link_to_pages(folder: Path, text: str) -> str:
    """Let the links of a Markdown file lead to the pages of the site.

    Args:
        folder: Folder of the file. Its links are relative to it.
        text: Content of the file.

    Returns:
        The content with links that are relative to docs/. Links to folders become text, because
        a folder has no page.
    """

    def replace_target(match: re.Match[str]) -> str:
        text, target, anchor = match.groups()
        path = Path(os.path.normpath(folder / target))
        if path.is_dir():
            return text
        if not path.is_file():
            return match.group()
        name = path.relative_to(ROOT).as_posix()
        page = PAGES.get(name) or os.path.relpath(path, ROOT / "docs")
        if name == "README.md" and anchor in QUICK_START:
            page = "quickstart.md"
        return f"[{text}]({page}{anchor or ''})"

    return re.sub(r"\[([^]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)", replace_target, text)


def link_in_source(app: Sphinx, docname: str, source: list[str]) -> None:
    """Rewrite the links of a page of docs/."""
    source[0] = link_to_pages(ROOT / "docs", source[0])


def link_in_included(app: Sphinx, path: Path, docname: str, source: list[str]) -> None:
    """Rewrite the links of a file that a page includes."""
    # The README is split into two pages.
    text = re.sub(r"\]\(#", "](README.md#", source[0]) if path.name == "README.md" else source[0]
    source[0] = link_to_pages(ROOT / "docs" / path.parent, text)


def list_fields(
    app: Sphinx, what: str, name: str, value: object, options: Options, lines: list[str]
) -> None:
    """Add the explanation of each field to the docstring of a settings class."""
    if not (isinstance(value, type) and issubclass(value, Settings)):
        return
    lines += ["", "Args:"]
    for item in dataclasses.fields(value):
        lines.append(f"    {item.name}: {format_facts(value, item.name)}")


def resolve_public_name(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: Element
) -> Element | None:
    """Let `nb.render` and `renderer.render` lead to the page of `norm_balls.render`."""
    package, _, name = node["reftarget"].rpartition(".")
    if node["refdomain"] != "py" or name not in nb.__all__:
        return None
    if package.partition(".")[0] not in {"nb", "renderer", "augment", "train"}:
        return None
    target = f"norm_balls.{name}"
    domain = env.domains["py"]
    return domain.resolve_xref(env, node["refdoc"], app.builder, "obj", target, node, content)


def write_audit(app: Sphinx, error: Exception | None) -> None:
    """Audit the published detector in few views, and write the page beside the others."""
    if error is None and app.builder.name == "html":
        network = nb.load_run("pretrained/detector")
        report = nb.audit(network, ["solid:orange"], environments=["grace"], budget=0.1)
        report.save(Path(app.outdir) / "audit.html")


def setup(app: Sphinx) -> None:
    """Connect the functions of this file to the events of Sphinx."""
    app.connect("build-finished", write_audit)
    app.connect("source-read", link_in_source)
    app.connect("include-read", link_in_included)
    app.connect("missing-reference", resolve_public_name)
    # Before napoleon, which converts the lines.
    app.connect("autodoc-process-docstring", list_fields, priority=400)
