"""One report as HTML that loads nothing, and as Markdown with its images beside it."""

import base64
import html
import os
import re
import shutil
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from train.command_line.entry_points import one_sentence
from train.report import answer, photographs, sections
from train.report.arms import arms_of, drawn
from train.report.attacks import sections as attack_sections
from train.report.blocks import Block, Code, Gallery, Illustration, Section
from train.report.folders import find
from train.report.headline import headline
from train.report.tables import Table, markdown, shown

PAGE, MARKDOWN, IMAGES, HEADLINE = "report.html", "report.md", "report_files", "report.png"
MIME = {"svg": "image/svg+xml", "png": "image/png", "jpeg": "image/jpeg"}


def write_report(folders: Sequence[Path], out: Path) -> Path:
    """Write report.html, report.md with report_files/, and report.png, of runs and attacks in folders and below them.

    Returns the page. What cannot be read is named in it. InputError as of `find`.
    """
    found = find(folders)
    arms = arms_of(found.runs)
    few, top = drawn(arms), None
    told = [answer.of_attacks(found.attacks)] if found.attacks else []
    if few:
        name = photographs.most_scored(few)
        top = headline(few, name)
        told.insert(0, answer.of_runs(few, name))
    first = Section("In short", [*told, Gallery("", [top] if top else []), *found.problems])
    parts = [first, *sections.of_runs(arms, found.unfinished), *attack_sections(found.attacks)]
    parts = [Section(part.title, [*filter(_holds_something, part.blocks)]) for part in parts]
    parts = [part for part in parts if part.blocks]
    done, every = len(found.runs), len(found.runs) + len(found.unfinished)
    about = f"{done} of {every} runs finished, {len(found.attacks)} attacks"

    out.mkdir(parents=True, exist_ok=True)
    if top:
        (out / HEADLINE).write_bytes(top.data)
    page = _rendered("page.html.jinja", parts, about, _data_uri)
    (out / PAGE).write_text(_from_here(page), encoding="utf-8", errors="replace")
    shutil.rmtree(out / IMAGES, ignore_errors=True)
    text = _rendered("page.md.jinja", parts, about, lambda image: _beside(image, out))
    (out / MARKDOWN).write_text(_from_here(re.sub(r"\n{3,}", "\n\n", text)), encoding="utf-8", errors="replace")
    return out / PAGE


def _holds_something(block: Block) -> bool:
    match block:
        case Gallery(images=content) | Table(rows=content) | Code(text=content):
            return bool(content)
    return bool(block)


def _rendered(template: str, parts: Sequence[Section], about: str, source: Callable[[Illustration], str]) -> str:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("train.report"),
        autoescape=template.endswith("html.jinja"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"shown": shown, "source": source, "md": _escaped, "table": _table, "fenced": _fenced}
    return environment.get_template(template).render(sections=parts, about=about)


def _from_here(text: str) -> str:
    """With paths below the current folder relative to it, so that the commands run in any clone."""
    return re.sub(rf"(?<![\w./-]){re.escape(os.getcwd())}/", "", text)


def _data_uri(image: Illustration) -> str:
    return f"data:{MIME[image.kind]};base64,{base64.b64encode(image.data).decode()}"


def _beside(image: Illustration, out: Path) -> str:
    folder = out / IMAGES
    folder.mkdir(exist_ok=True)
    path = folder / f"{len(list(folder.iterdir())):03d}.{image.kind}"
    path.write_bytes(image.data)
    return f"{IMAGES}/{path.name}"


def _escaped(text: object) -> str:
    """A name from a file as Markdown's text: neither markup nor HTML."""
    plain = " ".join(html.escape(str(text), quote=False).split())
    return re.sub(r"([\\`*_\[\]|#!])", r"\\\1", plain)


def _table(table: Table) -> str:
    header, *rows = ([_escaped(shown(cell)) for cell in row] for row in (table.header, *table.rows))
    return markdown(header, rows)


def _fenced(text: str) -> str:
    longest = max(map(len, re.findall("`+", text)), default=2)
    fence = "`" * max(3, longest + 1)
    return f"{fence}\n{text}\n{fence}"


def report_of(folders: Sequence[Path], out: Path) -> str:
    """What the end of a training says of the report: its path, or why there is none; it never fails the run.

    The reason is one sentence, or the traceback of what is no fault of the user's.
    """
    try:
        return f"report: {write_report(folders, out)}"
    except Exception as error:  # what was trained is whole, whatever became of its report
        return f"no report: {one_sentence(error) or traceback.format_exc()}"
