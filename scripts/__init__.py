"""The commands besides pnb-train, and what --help says about them.

`python -m scripts NAME` calls a command in a clone. Once the project is installed, this package is
`pnb_scripts`, and the command is `pnb-NAME`.
"""

import os

from train.cli import Command, quoted


def list_parameters(words: list[str]) -> list[str]:
    """Replace attack=lighting+geometry by the list attack=[lighting,geometry].

    With reload=FOLDER and without attack=, the command only shows a saved
    adversary. attack=[] is then added, which means no attack.
    """
    keys = {word.partition("=")[0] for word in words}
    rewritten = []
    for word in words:
        key, _, value = word.partition("=")
        if key == "attack" and not value.startswith("["):
            word = f"attack=[{value.replace('+', ',')}]"
        rewritten.append(word)
    if "reload" in keys and "attack" not in keys:
        rewritten.append("attack=[]")
    return rewritten


def name_folders(words: list[str]) -> list[str]:
    """Replace the paths of folders on a command line by one setting, runs=[...].

    For example, "runs/a runs/b out=page" becomes "out=page runs=[runs/a,runs/b]". A word that
    begins with "-" is an option. A word with "=" is a setting, unless a file or folder of this name
    exists.
    """
    folders: list[str] = []
    other_words: list[str] = []
    for word in words:
        is_option = not word or word.startswith("-")
        is_folder = not is_option and ("=" not in word or os.path.exists(word))
        (folders if is_folder else other_words).append(word)
    runs = [f"runs=[{','.join(map(quoted, folders))}]"] if folders else []
    return [*other_words, *runs]


attack = Command(
    name="attack",
    settings="train.command_settings:AttackExperimentSettings",
    body="train.commands.attack:run",
    about="Attack a classifier through the lighting, the shape, the colors or the pixels of a "
    "mesh.",
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
audit = Command(
    name="audit",
    settings="train.command_settings:AuditSettings",
    body="train.commands.audit:run",
    about="Measure how safe a classifier is in unusual lighting, and what hardening costs.\n\n"
    "Your own network: network=torchvision:NAME weights=FILE classes=FILE, a file of "
    "TorchScript, of torch.export (.pt2) or of ONNX (.onnx), or "
    "network=python:my_network.load, a function in my_network.py. It returns the network, "
    "the pixels per side of its images, and the names of its classes.\n\n"
    "An audit that was stopped continues with the same settings, and with hardened= or photos= "
    "in addition.",
    examples=[
        "pnb-audit network=torchvision:resnet50 meshes=orange.glb",
        "pnb-audit network=efficientnet_lite0 unlabeled=FOLDER",
        "pnb-audit network=torchvision:mobilenet_v3_small weights=mine.pth "
        "classes=mine.txt meshes=orange.glb",
        "pnb-audit network=NAME meshes=[orange.glb] hard_negatives=[solid:lemon] out=audit",
    ],
)
compare = Command(
    name="compare",
    settings="train.commands.compare:CompareSettings",
    body="train.commands.compare:run",
    about="Print a Markdown table of finished runs. With -v, print all tables.",
    examples=["pnb-compare 'runs=[runs/a,runs/b]'"],
)
evaluate = Command(
    name="evaluate",
    settings="train.command_settings:EvaluateSettings",
    body="train.commands.evaluate:run",
    about="Score a network on a folder of photographs.",
    examples=[
        "pnb-evaluate run=pretrained/best photos=photos",
        "pnb-evaluate network=torchvision:resnet18 photos=photos",
    ],
)
fit = Command(
    name="fit",
    settings="train.command_settings:FitSettings",
    body="train.commands.fit:fit",
    about="Find the camera and the lighting of a photograph.",
    examples=["pnb-fit photograph=photo.jpg mask=mask.png mesh=orange.glb"],
)
lab = Command(
    name="lab",
    settings="train.command_settings:LabSettings",
    body="train.commands.lab:render_laboratory",
    about="Path-trace renders of oranges and hard negatives under a projector.",
    examples=["pnb-lab out=lab"],
)
report = Command(
    name="report",
    settings="train.commands.report:ReportSettings",
    body="train.commands.report:run",
    about="Write a page of runs, sweeps and attacks.",
    examples=["pnb-report runs/sweep"],
    rewrite=name_folders,
)
