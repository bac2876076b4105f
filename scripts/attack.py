"""Attack a classifier through the lighting, the shape, the colors or the pixels of a mesh."""

import re

from train.cli import Command


def list_parameters(words: list[str]) -> list[str]:
    """Replace attack=lighting+geometry by the list attack=[lighting,geometry].

    With reload=FOLDER and without attack=, the command only shows a saved
    adversary. attack=[] is then added, which means no attack.
    """
    keys = {word.partition("=")[0] for word in words}
    rewritten = []
    for word in words:
        found = re.fullmatch(r"attack=(?!\[)(.*)", word)
        rewritten.append(f"attack=[{found[1].replace('+', ',')}]" if found else word)
    return [*rewritten, "attack=[]"] if "reload" in keys and "attack" not in keys else rewritten


main = Command(
    name="attack",
    settings="train.command_settings:AttackExperimentSettings",
    about=__doc__,
    examples=[
        "pnb-attack attack=lighting network=efficientnet_lite0 meshes=[orange.glb]",
        "pnb-attack attack=lighting+geometry",
        "pnb-attack reload=runs/attacks/first/0_orange/example_000",
    ],
    common=[
        *("network", "label", "target", "out"),
        *("attack.max_steps", "attack.optimizer", "attack.margin"),
        *("meshes", "scene.views", "scene.light", "scene.backgrounds"),
    ],
    groups=["attack"],
    rewrite=list_parameters,
)

if __name__ == "__main__":
    main()
