"""pnb-render: write labeled renders as a data set."""

import re

from train.cli import Command


def name_light(words: list[str]) -> list[str]:
    """Replace light=NAME, a short form of scene.light=NAME, in the command line."""
    return [re.sub(r"^light=", "scene.light=", word) for word in words]


main = Command(
    name="render",
    settings="train.command_settings:RenderSettings",
    body="train.commands.render:run",
    about="Write labeled renders as a data set: folders of classes, COCO, YOLO or WebDataset.",
    examples=[
        "pnb-render meshes=[orange.glb,apple.glb] format=coco count=1000 out=renders",
        "pnb-render --multirun shard=0,1 shards=2 launcher=joblib count=1000 out=renders",
    ],
    common=["out", "format", "count", "meshes", "size", "network", "scene.light", "maps"],
    groups=["launcher"],
    rewrite=name_light,
    sweep="train.commands.render:start",
)

if __name__ == "__main__":
    main()
