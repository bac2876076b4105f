"""What the scripts of the paper's tables share: recognised pictures to attack, and the page that they write."""

import argparse
import json
import math
import platform
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill

import numpy as np
import torch
from torch import Tensor

from augment.attacks.run import logits_of
from augment.classifiers import Classifier
from augment.objects import ObjectSettings, load_object
from augment.scene import Scene
from augment.seeding import generator
from renderer.camera import OrthographicCamera
from renderer.image import PictureSettings
from renderer.lights import load_light
from renderer.mesh import Mesh
from renderer.visibility import choose
from train.cli import command_line

DOCS = Path(__file__).parents[2] / "docs"
FIELDS_OF_VIEW = (2.0, 3.0)  # the paper's appendix on rendering quality
GREYS = (0.0, 0.25, 0.5, 0.75, 1.0)
AS_THEY_ARE = ("#", "|", "!", "```")  # headings, tables, pictures and code
SECTIONS = ("norm_balls", "transfer", "unseen_views", "rendering_quality", "gallery", "run_time")


@dataclass(frozen=True)
class Subject:
    """A mesh to attack and the class that it shows."""

    name: str
    mesh: Mesh
    label: str
    gain: float = 1.0


def arguments(description: str, **defaults: int) -> argparse.ArgumentParser:
    """The options that all scripts have, and whole numbers of their own."""
    parser = argparse.ArgumentParser(description=description)
    help_meshes = "files, FILE:GAIN for textures that are too dark, or solid:NAME:SEED"
    parser.add_argument("--meshes", nargs="+", required=True, help=help_meshes)
    parser.add_argument("--label", default="orange", help="the class that the meshes show")
    parser.add_argument("--classifier", default="efficientnet_lite0")
    parser.add_argument("--weights", default=None, help="the classifier's local weights file")
    parser.add_argument("--light", default="grace")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=DOCS, help="folder of paper.md")
    for name, value in defaults.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=int, default=value)
    return parser


def subjects(options: argparse.Namespace) -> list[Subject]:
    """The meshes of the command line."""
    found = []
    for entry in options.meshes:
        path, _, gain = (entry, "", "") if entry.startswith("solid:") else entry.partition(":")
        item = ObjectSettings(path, options.label, gain=float(gain or 1))
        found.append(Subject(Path(path).stem, load_object(item).mesh, options.label, item.gain))
    return found


def random_scene(subject: Subject, classifier: Classifier, light: str, count: int, draws: torch.Generator) -> Scene:
    """Views at π/3 off the zenith (the paper's) and any azimuth, with a field of view of 2 or 3, on a grey."""
    azimuths = (2 * math.pi * torch.rand(count, generator=draws)).tolist()
    fields = torch.randint(len(FIELDS_OF_VIEW), (count,), generator=draws).tolist()
    greys = torch.tensor(GREYS)[torch.randint(len(GREYS), (count,), generator=draws)]
    cameras = [
        [OrthographicCamera(math.pi / 3, azimuth, FIELDS_OF_VIEW[field])]
        for azimuth, field in zip(azimuths, fields, strict=True)
    ]
    return scene_of(subject, classifier, light, cameras, greys)


def scene_of(
    subject: Subject,
    classifier: Classifier,
    light: str,
    cameras: Sequence[Sequence[OrthographicCamera]],
    greys: Tensor,
) -> Scene:
    """A subject before cameras (E × V), each example on a grey (E,)."""
    size = classifier.size
    return Scene.of_mesh(
        subject.mesh,
        cameras,
        greys.view(-1, 1, 1, 1).expand(-1, 3, size, size),
        load_light(light),
        PictureSettings(size, samples=2, normals="smooth"),
        choose(),
        subject.gain,
    )


def recognised(scene: Scene, classifier: Classifier, label: str) -> Tensor:
    """(E,) whether the classifier gives all views of an example the label."""
    examples = torch.arange(len(scene))
    with torch.no_grad():
        images = torch.cat([scene.render(scene.conditions(part), part) for part in examples.split(16)])
    return (logits_of(classifier, images, 32).argmax(2) == classifier.label(label)).all(1)


def recognised_scene(subject: Subject, classifier: Classifier, light: str, count: int, seed: int) -> Scene:
    """`count` random examples of a subject that the classifier recognises, drawn until there are as many."""
    draws, cameras, greys = generator(seed, subject.name), [], []
    for _ in range(20):
        scene = random_scene(subject, classifier, light, count, draws)
        kept = recognised(scene, classifier, subject.label).nonzero().squeeze(1).tolist()
        cameras += [scene.cameras[index] for index in kept]
        greys += [float(scene.backgrounds[index, 0, 0]) for index in kept]
        if len(cameras) >= count:
            return scene_of(subject, classifier, light, cameras[:count], torch.tensor(greys[:count]))
    raise SystemExit(f"{classifier.name} recognises too few pictures of {subject.name}: {len(cameras)} of {20 * count}")


def write_section(out: Path, name: str, title: str, text: str, records: Iterable[Mapping]) -> None:
    """Write out/paper/NAME.jsonl and NAME.md, and paper.md anew from all sections that there are."""
    folder = out / "paper"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    (folder / f"{name}.md").write_text(f"## {title}\n\n{wrapped(text.strip())}\n")
    there = [folder / f"{section}.md" for section in SECTIONS if (folder / f"{section}.md").is_file()]
    head = (
        "# The paper's tables and figures\n\nEach section is written by the script that it names; do not edit.\n"
        'Renders of orange_sketchfab show "An Orange" by thisisepic, Sketchfab, CC BY-SA 4.0.\n'
    )
    (out / "paper.md").write_text("\n".join([head, *(path.read_text() for path in there)]))


def wrapped(text: str) -> str:
    """Markdown whose paragraphs and lists have lines of at most 120 characters."""
    return "\n\n".join(
        block if block.startswith(AS_THEY_ARE) else "\n".join(map(_filled, re.split("\n(?=- )", block)))
        for block in text.split("\n\n")
    )


def _filled(paragraph: str) -> str:
    hanging = "  " if paragraph.startswith("- ") else ""
    return fill(
        " ".join(paragraph.split()), 120, subsequent_indent=hanging, break_long_words=False, break_on_hyphens=False
    )


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def command() -> str:
    """This run's command line as Markdown, without where the page goes."""
    words = sys.argv[1:]
    if "--out" in words:
        at = words.index("--out")
        del words[at : at + 2]
    return f"```bash\nPYTHONPATH=. {command_line(words)}\n```"


def versions() -> str:
    """What the numbers were made with, as a sentence."""
    return (
        f"Made with torch {torch.__version__} and NumPy {np.__version__} on {platform.machine()}, "
        f"{torch.get_num_threads()} threads."
    )
