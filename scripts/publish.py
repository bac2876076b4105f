"""Write a run's network as half-precision safetensors with a card: python scripts/publish.py run=... out=..."""

from dataclasses import dataclass
from pathlib import Path

from train.command_line.entry_points import script
from train.command_line.outputs import writable_folder
from train.report.card import publish_run


@dataclass
class Settings:
    """conf/publish.yaml."""

    run: str
    out: str


def main(settings: Settings) -> None:
    publish_run(Path(settings.run), writable_folder(settings.out, "out"))
    print(f"published in {settings.out}")


if __name__ == "__main__":
    script(main, Settings)
