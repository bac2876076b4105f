"""A section of docs/paper.md, measured, and put in its place there."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

from renderer.errors import InputError, require_range
from train.command_line.configuration import read_settings
from train.command_line.entry_points import command_line
from train.command_line.outputs import writable_folder
from train.run_folder.classifier import load_classifier
from train.settings import LARGEST_SEED, SceneSettings, read_object
from train.studies.page import filled, joined, versions, wrapped, write
from train.studies.paper import (
    gallery,
    norm_balls,
    physical_light,
    rendering_quality,
    run_time,
    shaped_light,
    survival,
    transfer,
    unseen_views,
)
from train.studies.paper.section import Section, Study

SECTIONS = {  # in the order of the page
    "norm_balls": norm_balls,
    "physical_light": physical_light,
    "survival": survival,
    "transfer": transfer,
    "unseen_views": unseen_views,
    "shaped_light": shaped_light,
    "rendering_quality": rendering_quality,
    "gallery": gallery,
    "run_time": run_time,
}
HEAD = """# The paper's tables and figures

Each section is written by the command that it names; do not edit.
Renders of orange_sketchfab show "An Orange" by thisisepic, Sketchfab, CC BY-SA 4.0."""


@dataclass
class PaperSettings:
    """conf/reproduce_paper.yaml. section: a choice of conf/section. out: the folder of paper.md."""

    section: dict[str, Any]
    out: str
    label: str
    classifier: str
    weights: str | None
    seed: int
    scene: SceneSettings

    def __post_init__(self) -> None:
        require_range("seed", self.seed, 0, LARGEST_SEED)
        if not self.scene.meshes:
            raise InputError("scene.meshes is empty: name a mesh to attack")


def run(settings: PaperSettings) -> None:
    """Measure a section, write its data and its figures to out/paper, and put its text into out/paper.md."""
    out = writable_folder(settings.out, "out")
    name = str(settings.section.get("name"))
    if name not in SECTIONS:
        raise InputError(f"section.name={name}: choose section={', '.join(SECTIONS)}")
    module = SECTIONS[name]
    section_settings = read_settings(module.Settings, OmegaConf.create(settings.section), "section")
    items = [read_object(item, settings.label, index) for index, item in enumerate(settings.scene.meshes)]
    torch.set_num_threads(section_settings.threads)
    classifier = load_classifier(settings.classifier, settings.weights)
    study = Study(classifier, items, settings.scene.light, settings.label, settings.seed)
    section = module.measure(study, section_settings)
    _write_files(out / "paper", name, section)
    told = filled(str(module.__file__), study=study, settings=section_settings, **section.values)
    text = joined([module.TITLE, wrapped(told), f"```bash\n{command_line()}\n```", versions()])
    page = out / "paper.md"
    write(page, with_section(page.read_text("utf-8") if page.is_file() else "", module.TITLE, text))


def _write_files(folder: Path, name: str, section: Section) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.jsonl").write_text("".join(json.dumps(record) + "\n" for record in section.records), "utf-8")
    for figure, draw in section.figures.items():
        draw(folder / figure)


def with_section(page: str, title: str, text: str) -> str:
    """The page with a section's text, which begins with its title, in place of the one before."""
    there = {block.partition("\n")[0]: block for block in re.split("^## ", page, flags=re.M)[1:]} | {title: text}
    return joined([HEAD, *(f"## {there[each.TITLE]}" for each in SECTIONS.values() if each.TITLE in there)])
