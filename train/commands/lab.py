"""pnb-lab: path-traced photographs of objects under projected patterns and maps."""

from pathlib import Path

from train.command_settings import LabSettings
from train.evaluation.laboratory.laboratory import write_laboratory
from train.report.results import require_replaceable


def render_laboratory(settings: LabSettings) -> None:
    """Render the laboratory, and print what was written.

    Args:
        settings: The settings of the command.

    Raises:
        InputError: If the folder holds results, or a setting is wrong.
    """
    require_replaceable(Path(settings.out), "out", settings.overwrite)
    count = write_laboratory(settings)
    print(f"{settings.out}: {count} renders under {settings.setups} setups")
