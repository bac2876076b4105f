"""The commands that take something from outside, each with arguments under which it works, and what it reads."""

from dataclasses import dataclass

from train.studies.reliability.corpus import BESIDE, LIGHTS, MESHES, PUBLISHED, RUN

RENDERER = ("renderer.rasterizer=numpy", "renderer.samples=1", "renderer.cache=cache")
TRAINING = (
    *("compare=[]", "data.validation=0.3", "model.depth=10", "model.width=1", "model.dropout=0", "train.epochs=1"),
    *("train.batch_size=16", "train.precision=float32", "train.device=cpu", "train.threads=1", "augment.examples=1"),
    *("augment.attack.max_steps=1", "scene.backgrounds=[0.5]", *RENDERER),
)
DATA = ("data=npz", "data.path=data.npz")
SCENE = ("scene.meshes=[mesh.obj]", "scene.light=light.npy")
ATTACK = ("attack.max_steps=1", "attack.force=true", "attack.checks=false", "device=cpu", *RENDERER)
NETWORKS = (f"{RUN}/best.pt", f"{PUBLISHED}/model.safetensors")
PHOTOGRAPHS = ("photographs/orange/0.png", "photographs/orange/4.jpg", "photographs/photos.csv")


@dataclass(frozen=True)
class Door:
    """A command that works in the corpus's folder.

    config: the name of its configuration. inputs: what it reads, by an override in which {} stands for the file or its
    folder; the first file of each is the one that it is given unless told otherwise. out: the folder that it writes.
    renewed: a file that it makes anew, whatever it holds. meant: damages, by name, that it may take at their word.
    """

    name: str
    config: str
    arguments: tuple[str, ...]
    inputs: dict[str, tuple[str, ...]]
    out: str | None = "out"
    renewed: str | None = None
    meant: tuple[str, ...] = ()

    def command(self, *changed: str) -> list[str]:
        """For `started` and `forked`; changed overrides replace those that the door has for the same keys."""
        own = [*self.arguments, *(key.replace("{}", given(files[0])) for key, files in self.inputs.items())]
        keys = {override.partition("=")[0] for override in changed}
        start = ["-m", "train"] if self.config == "train" else [f"scripts/{self.config}.py"]
        return [*start, *(override for override in own if override.partition("=")[0] not in keys), *changed]


def given(file: str) -> str:
    """What is named on the command line for a file to be read: itself, the mesh that it belongs to, or its folder."""
    return BESIDE.get(file, file.partition("/")[0])


DOORS = [
    Door(
        "train data=npz",
        "train",
        ("run=out", "data=npz", *TRAINING),
        {
            "data.path={}": ("data.npz",),
            "scene.meshes=[{}]": (*MESHES, *BESIDE),
            "scene.light={}": LIGHTS,
            "evaluate.photos={}": PHOTOGRAPHS,
            "train.init_from={}": NETWORKS,
        },
    ),
    Door(
        "train data=folder",
        "train",
        ("run=out", "data=folder", "data.size=16", "data.test_share=0.3", "augment=none", *TRAINING),
        {"data.path={}": ("images/apple/0.png",)},
    ),
    Door(
        "train train.resume=true",
        "train",
        (*DATA, *SCENE, *TRAINING[:5], "train.epochs=2", *TRAINING[6:], "train.resume=true"),
        {"run={}": tuple(f"{RUN}/{name}" for name in ("last.pt", "config.yaml", "metrics.jsonl"))},
        None,
        renewed=f"{RUN}/metrics.jsonl",
    ),
    Door(
        "attack.py",
        "attack",
        ("attack=lighting", *ATTACK, "out=out"),
        {
            "classifier=run:{}": NETWORKS,
            "scene.meshes=[{}]": ("mesh.obj", "mesh.glb", "peel.png"),
            "scene.light={}": ("light.hdr", "light.json"),
            "scene.backgrounds=[{}]": ("background.png",),
        },
    ),
    Door(
        "evaluate_photos.py",
        "evaluate_photos",
        ("out=out", "device=cpu", "precision=float32"),
        {"run={}": NETWORKS, "photos={}": PHOTOGRAPHS},
    ),
    Door(
        "compare_runs.py",
        "compare_runs",
        (),
        {
            "runs=[{}]": tuple(
                f"{RUN}/{name}"
                for name in ("config.yaml", "metrics.jsonl", "photographs/summary.json", "photographs/photographs.csv")
            )
        },
        None,
    ),
    Door(
        "publish.py",
        "publish",
        ("out=out",),
        {"run={}": tuple(f"{RUN}/{name}" for name in ("best.pt", "config.yaml", "metrics.jsonl"))},
        meant=("other classes",),  # a network may be published whatever its classes are called
    ),
    Door("report.py", "report", (f"runs=[{RUN}]", "out=out"), {}),
    Door(
        "fit_skylight.py",
        "fit_skylight",
        ("out=out/fit.safetensors", "zenith_degree=2", "turbidity_degree=1", "held_out=2"),
        {},
    ),
    Door("export_light.py", "export_light", ("out=out/light.exr", "height=8"), {"light={}": LIGHTS}),
    Door(
        "lab.py",
        "lab",
        ("out=out", "lights=1", "patterns=[solid]", "size=8", "samples=1"),
        {"meshes=[solid:orange:1,{mesh: {}, label: other_x}]": ("mesh.obj", "mesh.glb")},
    ),
]
BY_NAME = {door.name: door for door in DOORS}
