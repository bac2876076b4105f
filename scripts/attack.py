"""pnb-attack: attack a classifier through lighting, shape, colors or pixels."""

from train.command import Command
from train.command_settings import AttackExperimentSettings
from train.help import HelpText


def list_parameters(words: list[str]) -> list[str]:
    """Replace attack=lighting+geometry by the list attack=[lighting,geometry].

    With reload=FOLDER, the command shows a saved adversary. The default attack is
    then replaced by an empty list, unless the words contain attack=.

    Args:
        words: Words of the command line.

    Returns:
        Words in which the attack is a list.
    """
    keys = {word.partition("=")[0] for word in words}
    listed = []
    for word in words:
        key, _, value = word.partition("=")
        if key == "attack" and not value.startswith("["):
            word = f"attack=[{value.replace('+', ',')}]"
        listed.append(word)
    if "reload" in keys and "attack" not in keys:
        listed.append("attack=[]")
    return listed


main = Command(
    name="attack",
    settings=AttackExperimentSettings,
    body="train.commands.attack_meshes:run",
    help=HelpText(
        about="Attack a classifier through the lighting, the shape, the colors or the pixels of a "
        "mesh.",
        examples=[
            "pnb-attack attack=lighting classifier=efficientnet_lite0 scene.meshes=[orange.glb]",
            "pnb-attack attack=lighting+geometry",
            "pnb-attack reload=runs/attacks/first/0_orange/example_000",
        ],
        common=[
            *(
                "classifier",
                "label",
                "target",
                "out",
                "attack.max_steps",
                "attack.optimizer",
                "attack.margin",
            ),
            *("scene.meshes", "scene.views", "scene.light", "scene.backgrounds"),
        ],
        groups=["attack"],
    ),
    rewrite=list_parameters,
)

if __name__ == "__main__":
    main()
