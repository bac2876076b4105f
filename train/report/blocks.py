"""What a page is made of: sections of sentences, tables, images, galleries and code, whatever the format."""

from collections.abc import Sequence
from dataclasses import dataclass

from train.report.tables import Table


@dataclass(frozen=True)
class Illustration:
    """A file's bytes. alt: what it shows, in words. kind: svg, png or jpeg. width: CSS pixels to show it at."""

    data: bytes
    kind: str
    alt: str
    width: int
    caption: str = ""


@dataclass(frozen=True)
class Gallery:
    """Images side by side, as many as there is room for, under a title."""

    title: str
    images: Sequence[Illustration]


@dataclass(frozen=True)
class Code:
    """Text as it is, folded away under a title."""

    title: str
    text: str


Block = str | Table | Gallery | Code


@dataclass(frozen=True)
class Section:
    title: str
    blocks: Sequence[Block]
