"""pnb-lab: path-traced renders of objects in the light of projectors and environment maps."""

from pathlib import Path

from train.command_settings import LabSettings
from train.laboratory.laboratory import write_laboratory
from train.results.overwrite import require_replaceable
from train.settings import label_names


def run(settings: LabSettings) -> None:
    """Render a test set of objects in unusual lighting, and print the number of renders."""
    require_replaceable(Path(settings.out), "out", settings.overwrite)
    count = write_laboratory(settings)
    classes = " and ".join(label_names(settings.label))
    print(f"{settings.out}: {count} renders of {classes} and others in {settings.setups} setups")
