"""Write labeled renders as a data set: folders of classes, COCO, YOLO or WebDataset."""

import re

from train.cli import Command


def name_light(words: list[str]) -> list[str]:
    """Replace light=NAME by scene.light=NAME, without the lights that are drawn in its place."""
    is_given = any(re.match(r"(scene\.)?light=", word) for word in words)
    is_drawn = any(word.startswith("augment.vary.environments=") for word in words)
    named = [re.sub(r"^light=", "scene.light=", word) for word in words]
    return [*named, "augment.vary.environments=[]"] if is_given and not is_drawn else named


main = Command(
    name="render",
    settings="train.command_settings:RenderSettings",
    about=__doc__,
    examples=[
        "pnb-render meshes=[orange.glb,apple.glb] format=coco count=1000 out=renders",
        "pnb-render --multirun shard=0,1 shards=2 launcher=joblib count=1000 out=renders",
    ],
    common=["out", "format", "count", "meshes", "size", "network", "scene.light", "maps"],
    groups=["attack@augment.attack", "launcher"],
    rewrite=name_light,
)

if __name__ == "__main__":
    main()
