"""What photos.csv says about one image of a folder. This module does not import torch."""

from dataclasses import dataclass, field
from pathlib import PurePosixPath

# Separator of the names of sources in the column hard_negatives of photos.csv.
SEPARATOR = ";"
# pnb-lab writes a file of this name to its folder of renders.
DESCRIPTION = "lab.json"
# Table with the source and the object of each photograph of a folder.
TABLE = "photos.csv"


@dataclass(frozen=True)
class Photograph:
    """An image file of a folder of photographs.

    Attributes:
        path: Path relative to the folder.
        label: Class of the photographed object. It begins with "other_" if the
            network lacks the class.
        source: Name of the collection that the image comes from. None if it is
            unknown.
        hard_negatives: Names of other sources. If the image is a positive, it
            is ranked against the negatives of its own source and of these
            sources.
        mesh: Name of the photographed object. None if it is unknown.
    """

    path: PurePosixPath
    label: str
    source: str | None
    hard_negatives: tuple[str, ...] = ()
    mesh: str | None = field(default=None, repr=False)


def split_sources(cell: str) -> tuple[str, ...]:
    """Split a cell of the column hard_negatives into the names of sources."""
    return tuple(name.strip() for name in cell.split(SEPARATOR) if name.strip())
