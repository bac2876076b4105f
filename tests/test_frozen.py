"""Weights, attacks and renders as they were recorded, so that a refactoring proves that it changes none.

There are two layers. Rounded values in float64 hold on every machine (portable.json). Hashes of all bits hold on the
machine that recorded them (frozen.json).

SHA-256 hashes are recorded in frozen.json by case, for each machine by its fingerprint: CPU, instruction set and the
versions of the libraries that compute. On another machine the tests skip. To use them there, record at the commit
before a change, and verify after it:

    RECORD_FROZEN=1 python -m pytest -q tests/test_frozen.py    # all cases, or those that -k selects
    python -m pytest -q tests/test_frozen.py -k render          # or -k attack, -k weights

A change that is meant to change bits or values records anew, and its commit says so. Tensors are hashed by type, shape
and bytes in their order, not by name. The tables below hold everything by which the library is called, so that a
renamed keyword or key is edited there.
"""

import hashlib
import json
import os
import platform
import re
import signal
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache
from importlib.metadata import distributions
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import augment
import renderer
from augment.attack_settings import EOTSettings
from augment.scene.conditions import Conditions
from renderer.light.presets import directional
from renderer.light.skylight import coefficients as skylight

RECORDS = Path(__file__).with_name("frozen.json")
PORTABLE = Path(__file__).with_name("portable.json")
DECIMALS = 5  # of the values in portable.json
SHOWN_VALUES = 40  # of each tensor in portable.json, at equal distances
TRACED = {
    "bounces",
    "shadows",
    "bounces_gradients",
}  # by rays in float32, whose hits depend on the machine
LIBRARIES = ("torch", "numpy", "scipy", "embreex", "pillow")
SOFTWARE = {"rasterizer": "numpy"}  # the same on every machine; "numba" has a case of its own
SIZE = 24

ABOVE = renderer.OrthographicCamera(60.0, 22.91831180523293, 2.2)
ASIDE = renderer.OrthographicCamera(80.21409131831524, 143.2394487827058, 2.6, 0.2, -0.1)
NEAR = renderer.PerspectiveCamera(63.02535746439056, -40.10704565915762, 2.2, distance=4.0)
RING = renderer.orbit_cameras(3, 2.2, fov=40.0)
VARNISHED_METAL = renderer.Gloss(roughness=0.4, metallic=0.3, specular_factor=0.8)

# name: (mesh, cameras, light, keywords of `render`, differentiated arguments)
RENDERS = {
    "flat_linear": ("orange:0", ABOVE, "grace", {"normals": "flat", "samples": 1}, ()),
    "smooth_srgb_perspective": (
        "apple:1",
        NEAR,
        "eucalyptus",
        {"encoding": "srgb", "samples": 3},
        (),
    ),
    "compiled": ("lemon:2", RING, "st_peters", {"rasterizer": "numba"}, ()),
    "shadows": ("pear:0", ASIDE, "environment", {"shadows": True}, ()),
    "bounces": (
        "cup:0",
        NEAR,
        "uniform",
        {"bounces": 2, "normals": "flat", "encoding": "srgb"},
        (),
    ),
    "sky": ("mushroom:3", RING, "skylight", {"albedo_scale": 0.7, "background": 0.1}, ()),
    "subdivided": ("table:0+2000", ABOVE, "lamp", {"normals": "flat", "samples": 3}, ()),
    "exported": ("bottle:1.glb", ASIDE, "grace", {"encoding": "srgb"}, ()),
    "textured": ("tent", NEAR, "grace", {"encoding": "srgb"}, ("light", "albedo")),
    "flat_gradients": (
        "sweet_pepper:0",
        ABOVE,
        "grace",
        {"normals": "flat"},
        ("light", "vertices", "albedo"),
    ),
    "smooth_gradients": (
        "peach:0",
        NEAR,
        "eucalyptus",
        {"encoding": "srgb"},
        ("light", "vertices", "albedo"),
    ),
    "gloss_gradients": (
        "apple:1",
        NEAR,
        "grace",
        {"gloss": VARNISHED_METAL},
        ("light", "vertices", "albedo"),
    ),
    "bounces_gradients": (
        "lamp:0",
        ABOVE,
        "uniform",
        {"bounces": 1},
        ("light", "vertices", "albedo"),
    ),
}
# name: (mesh, cameras, keywords of `precompute_transfer`)
OPERATORS = {
    "one_color": ("ball:0", ABOVE, {"normals": "flat"}),
    "colors": ("orange:3", RING, {"encoding": "srgb", "albedo_scale": 1.3, "samples": 3}),
    "shadows": ("plate:0", NEAR, {"shadows": True}),
    "bounces": ("cup:1", ASIDE, {"bounces": 2}),
}
CUP = augment.PropSettings("solid:cup:0", at=[0.9, 0.6], scale=0.6, azimuth=30.0)
LEMON = augment.PropSettings("solid:lemon:1", at=[-0.9, 0.4], scale=0.4)
AMONG_PROPS = augment.ObjectSettings("solid:pear:0", "orange", albedo_scale=0.9, props=[CUP, LEMON])
PROJECTOR = augment.ProjectorSettings(pixels=6, polar=50.0, azimuth=20.0, power=2.0, pattern=0.5)
LAMPS = augment.LampsSettings([[2.0, 1.0, 2.0], [-2.0, 0.5, 1.5]], power=8.0, start=3.0)
DISCS = augment.LampsSettings(
    [[2.0, 1.0, 2.0], [0.5, -2.0, 2.5]], power=8.0, radius=0.4, start=[[4, 3, 2], [1, 2, 3]]
)
# name: (meshes, views, keywords of `build_scene`)
SCENES = {
    "grid": (
        [("solid:orange:0", "orange"), ("solid:apple:0", "apple")],
        2,
        {"backgrounds": [0.2, 0.8]},
    ),
    "props": ([AMONG_PROPS], 2, {"ground": [0.6, 0.5, 0.4], "shadows": True, "fov": 40.0}),
    "projector": (
        [("solid:mushroom:0", "orange")],
        1,
        {"projector": PROJECTOR, "encoding": "srgb"},
    ),
    "lamps": (
        [("solid:cup:2", "orange")],
        2,
        {"lamps": DISCS, "shared": True, "ground": [0.5, 0.5, 0.5]},
    ),
    "all_lights": ([AMONG_PROPS], 1, {"lamps": LAMPS, "projector": PROJECTOR, "shadows": True}),
}

CLASSES = ["orange", "apple", "pear", "bottle"]
ORANGES = [("solid:orange:0", "orange"), ("solid:orange:1", "orange")]
SCENE = {"samples": 2, "encoding": "linear", "normals": "flat", **SOFTWARE}
SETTINGS = {"max_steps": 4, "margin": 0.5, "quantized": False, "allow_negative": False}
Step, Sky = augment.StepSettings, augment.SkylightSettings
BOTH = {
    "lighting": Step(step_size=0.2),
    "geometry": Step(radius=0.01, step="sign", step_size=0.005),
}
SHAPE, COLOR = (
    {"geometry": Step("linf", 0.02, "sign", 0.01)},
    {"albedo": Step("linf", 0.2, "sign", 0.03)},
)
DRAWS = {"restarts": 2, "eot": EOTSettings(draws=2)}
# name: (what is attacked, keywords of `build_scene`, other keywords of `AttackSettings`, target)
ATTACKS = {
    "lighting_l2": ({"lighting": Step("l2", 0.8, step_size=0.3)}, {}, {"quantized": True}, None),
    "lighting_signed": (
        {"lighting": Step(step_size=0.3)},
        {},
        {"allow_negative": True, "margin": 0.0},
        None,
    ),
    "skylight": ({"skylight": Sky(zenith=30.0, step_size=0.3)}, {"normals": "smooth"}, {}, None),
    "projector": (
        {"projector": Step(step_size=1.0)},
        {"projector": PROJECTOR, "encoding": "srgb"},
        {},
        None,
    ),
    "lamps": ({"lamps": Step(step_size=2.0)}, {"lamps": LAMPS, "shadows": True}, {}, None),
    "places": ({"positions": Step("l2", 1.0, step_size=0.3)}, {"lamps": DISCS}, {}, None),
    "geometry": (SHAPE, {"normals": "smooth", "shadows": True}, {"backtracking": True}, None),
    "albedo": (COLOR, {"shadows": True, "ground": [0.5, 0.4, 0.3]}, {}, None),
    "pixels": ({"pixels": Step("linf", 0.03, "sign", 0.01)}, {}, {}, "least_likely"),
    "shared_views": (BOTH, {"views": 3, "shared": True, "fov": 35.0}, {"backtracking": True}, None),
    "targeted": ({"lighting": Step(step="raw", step_size=0.5)}, {"views": 2}, {}, "pear"),
    "expectation": (
        {"lighting": Step("linf", 0.1, "sign", 0.04)},
        {"backgrounds": [0.1, 0.9]},
        DRAWS,
        None,
    ),
}

SMALL = """
data=shapes data.train_per_class=10 data.test_per_class=4 data.size=16 model.depth=10 model.width=1
train.epochs=2 train.batch_size=16 train.precision=float32 train.device=cpu train.threads=1 renderer.rasterizer=numpy
renderer.samples=2 scene.backgrounds=[0.2,0.8]
"""
RUNS = {
    "demonstration": """
experiment=paper compare=[none] model.dropout=0.0 train.schedule=one_cycle augment.examples=4
augment.attack.max_steps=3 augment.attack.step_size=0.3""",
    "best": """
experiment=best augment.examples=null scene.views=1 scene.meshes=['solid:orange',solid:orange:1]
augment.regenerate_every=30 train.images_per_epoch=60 train.ema_decay=0.8
train.distillation_weight=1.0 augment.random_light.radius=1.0""",
    "harden": """
experiment=harden augment=adversarial augment.examples=6 augment.regenerate_every=30 augment.init=random
augment.warm_start=true +attack@augment.attack=[lighting,albedo] augment.attack.max_steps=3 augment.vary.shift=0.1
augment.vary.exposure=[0.5,1.5] augment.vary.camera.noise=0.02 model.dropout=0.3 train.epochs=3
train.images_per_epoch=60 train.augmentation=augmix train.ranking_weight=0.5 train.label_smoothing=0.1
train.ema_decay=0.8 train.flips=alternating scene.views=1 scene.meshes=[solid:orange:0,solid:orange:1]
scene.hard_negatives=[{mesh:'solid:ball:0',label:apple}]""",
}
FOLDERS: dict[str, Path] = {}  # of the runs that were made


@pytest.mark.parametrize("name", RENDERS)
def test_render(name, tmp_path, verify):
    shown, cameras, light, keywords, wanted = RENDERS[name]
    mesh, light = mesh_named(shown, tmp_path), light_named(light, tmp_path)
    shape, draws = (mesh.textures or [mesh.faces])[0].shape, torch.Generator().manual_seed(2)
    colors = 0.2 + 0.6 * torch.rand(shape, generator=draws)
    leaves = {"light": light, "vertices": torch.from_numpy(mesh.vertices).float(), "albedo": colors}
    leaves = {argument: leaves[argument].requires_grad_() for argument in wanted}
    images = renderer.render(
        mesh, cameras, **{"light": light, "size": SIZE, **SOFTWARE, **keywords, **leaves}
    )
    verify(images, *gradients(images, list(leaves.values())))


@pytest.mark.parametrize("name", OPERATORS)
def test_render_by_operators(name, tmp_path, verify):
    shown, cameras, keywords = OPERATORS[name]
    named = ("grace", "skylight", "environment")
    lights = torch.stack([light_named(light, tmp_path) for light in named]).requires_grad_()
    found = renderer.precompute_transfer(
        mesh_named(shown, tmp_path), cameras, SIZE, **SOFTWARE, **keywords
    )
    images = torch.stack([operator.image(lights, 0.3) for operator in found])
    verify(images, *gradients(images, [lights]), found[0].radiance(lights.detach()))


@pytest.mark.parametrize("name", SCENES)
def test_render_of_a_scene(name, verify):
    meshes, views, keywords = SCENES[name]
    scene = augment.build_scene(meshes, SIZE, views, **SCENE | keywords)
    examples = torch.arange(len(scene))
    lights = scene.lights.clone().requires_grad_()
    relit = scene.render(Conditions(lights), examples)
    moved = scene.vertices[scene.object_of].clone().requires_grad_()
    albedo = torch.zeros(
        len(scene), max(len(item.mesh.faces) for item in scene.objects), 3
    ).requires_grad_()
    reshaded = scene.render(Conditions(lights, vertices=moved, albedo=albedo), examples)
    verify(
        relit, *gradients(relit, [lights]), reshaded, *gradients(reshaded, [lights, moved, albedo])
    )


@pytest.mark.parametrize("name", sorted(RENDERS.keys() - TRACED))
def test_values_of_a_render(name, tmp_path, verify_values):
    shown, cameras, light, keywords, wanted = RENDERS[name]
    mesh = mesh_named(shown, tmp_path)
    shape = (mesh.textures or [mesh.faces])[0].shape
    leaves = {
        "light": light_named(light, tmp_path).double(),
        "vertices": torch.from_numpy(mesh.vertices).double(),
        "albedo": 0.2
        + 0.6 * torch.rand(shape, generator=torch.Generator().manual_seed(2)).double(),
    }
    leaves = {
        argument: leaves[argument].requires_grad_()
        for argument in dict.fromkeys(("light", *wanted))
    }
    images = renderer.render(mesh, cameras, size=SIZE, **keywords | SOFTWARE | leaves)
    verify_values(images, *gradients(images, list(leaves.values())))


@pytest.mark.parametrize("name", sorted(OPERATORS.keys() - TRACED))
def test_values_of_a_render_by_operators(name, tmp_path, verify_values):
    shown, cameras, keywords = OPERATORS[name]
    named = ("grace", "skylight", "environment")
    lights = (
        torch.stack([light_named(light, tmp_path) for light in named]).double().requires_grad_()
    )
    found = renderer.precompute_transfer(
        mesh_named(shown, tmp_path), cameras, SIZE, **SOFTWARE, **keywords
    )
    images = torch.stack([operator.image(lights, 0.3) for operator in found])
    verify_values(images, *gradients(images, [lights]), found[0].radiance(lights.detach()))


@pytest.mark.parametrize("name", ATTACKS)
def test_attack(name, verify):
    changed, shown, others, target = ATTACKS[name]
    scene = augment.build_scene(ORANGES, SIZE, **SCENE | shown)
    settings = augment.AttackSettings(**changed, **SETTINGS | others)
    found = augment.attack(classifier(), scene, target, settings, seed=5, force=True)
    assert (found.images - found.images_before).abs().max() > 1e-3
    verify(
        found.images_before,
        found.images,
        found.logits,
        found.descent.values,
        found.descent.cost,
        found.steps,
    )


@pytest.mark.parametrize("name", ["demonstration/none", "demonstration", "best", "harden"])
def test_weights(name, trained, verify):
    run, _, compared = name.partition("/")
    verify(*weights(trained(run) / compared))


def test_weights_of_a_stopped_and_resumed_run(trained, call, monkeypatch, tmp_path, verify):
    begun = f"train.init_from={trained('demonstration')}"
    arguments = [*SMALL.split(), *RUNS["harden"].split(), begun, f"run={tmp_path}/run"]
    with monkeypatch.context() as patch:

        def save_and_stop(*arguments):
            patch.undo()
            torch.save(*arguments)
            signal.raise_signal(signal.SIGTERM)

        patch.setattr(torch, "save", save_and_stop)  # of the first checkpoint
        assert call("train", *arguments) == 128 + signal.SIGTERM
    stopped = digest(weights(tmp_path / "run"))
    assert call("train", *arguments, "train.resume=true") == 0
    assert digest(weights(tmp_path / "run")) != stopped
    verify(*weights(tmp_path / "run"), case="test_weights[harden]")


@pytest.fixture
def trained(call, monkeypatch, tmp_path_factory) -> Callable[[str], Path]:
    """The folder of one of RUNS, which is made when a first test asks for it."""

    monkeypatch.setattr("train.report.report_page.report_of", lambda folders, out: "no report")

    def run(name: str) -> Path:
        if name not in FOLDERS:
            folder = tmp_path_factory.mktemp("frozen") / name
            begun = [] if name == "demonstration" else [f"train.init_from={run('demonstration')}"]
            assert call("train", *SMALL.split(), *RUNS[name].split(), *begun, f"run={folder}") == 0
            FOLDERS[name] = folder
        return FOLDERS[name]

    return run


@pytest.fixture
def verify(request) -> Callable[..., None]:
    """Compares a hash of tensors with the one recorded for a case, this test's unless it is named; or records it."""
    records = json.loads(RECORDS.read_text()) if RECORDS.exists() else {}
    recording = os.environ.get("RECORD_FROZEN")
    if not recording and fingerprint() not in records:
        pytest.skip(
            f"nothing is recorded for {fingerprint()}: RECORD_FROZEN=1 python -m pytest tests/test_frozen.py"
        )

    def compare(*tensors: Tensor, case: str = request.node.name) -> None:
        assert all(tensor.isfinite().all() for tensor in tensors)
        if recording and case == request.node.name:
            records.setdefault(fingerprint(), {})[case] = digest(tensors)
            RECORDS.write_text(json.dumps(records, indent=1, sort_keys=True) + "\n")
        assert digest(tensors) == records[fingerprint()].get(case)

    return compare


@pytest.fixture
def verify_values(request) -> Callable[..., None]:
    """Compares the values of float64 tensors with those recorded for this test, or records them."""
    records = json.loads(PORTABLE.read_text()) if PORTABLE.exists() else {}

    def compare(*tensors: Tensor) -> None:
        found = [values_of(tensor) for tensor in tensors]
        if os.environ.get("RECORD_FROZEN"):
            records[request.node.name] = found
            PORTABLE.write_text(json.dumps(records, indent=1, sort_keys=True) + "\n")
        for values, expected in zip(found, records[request.node.name], strict=True):
            torch.testing.assert_close(values, expected, rtol=1e-5, atol=1.5 * 10**-DECIMALS)

    return compare


def values_of(tensor: Tensor) -> list[float]:
    """The mean magnitude and some values of a float64 tensor, rounded."""
    assert tensor.dtype == torch.float64
    flat = tensor.detach().flatten()
    chosen = torch.linspace(0, len(flat) - 1, min(SHOWN_VALUES, len(flat))).long()
    return [round(value, DECIMALS) for value in [flat.abs().mean().item(), *flat[chosen].tolist()]]


@cache
def fingerprint() -> str:
    """What the last bits depend on."""
    file = Path("/proc/cpuinfo")
    facts = re.findall(
        r"^(model name|cpu family|model)\s*: (.*)$", file.read_text() if file.exists() else "", re.M
    )
    processor = " ".join(dict(facts).values()) or platform.processor()
    versions = {name: found.version for name in LIBRARIES for found in distributions(name=name)}
    return ", ".join(
        [processor, torch.backends.cpu.get_cpu_capability(), *map(" ".join, versions.items())]
    )


def digest(tensors: Iterable[Tensor]) -> str:
    content = hashlib.sha256()
    for tensor in tensors:
        plain = tensor.detach().contiguous()
        content.update(f"{plain.dtype}{tuple(plain.shape)}".encode() + plain.numpy().tobytes())
    return content.hexdigest()


def weights(folder: Path) -> list[Tensor]:
    """Those of a run's checkpoints, in order."""
    states = (
        torch.load(folder / name, weights_only=True)["model"] for name in ("best.pt", "last.pt")
    )
    return [tensor for state in states for tensor in state.values()]


def gradients(images: Tensor, leaves: list[Tensor]) -> list[Tensor]:
    """Those of a cost in which every value of the images has a weight of its own."""
    weight = torch.linspace(-1, 1, images.numel()).view_as(images)
    return list(torch.autograd.grad((weight * images).sum(), leaves)) if leaves else []


def classifier() -> augment.Classifier:
    """A network of random weights that takes everything for the first class, but not by far."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        convolutions = (
            nn.Conv2d(3, 8, 3, stride=2),
            nn.ReLU(),
            nn.Conv2d(8, 16, 3, stride=2),
            nn.ReLU(),
        )
        last = nn.Linear(400, len(CLASSES))
    with torch.no_grad():
        last.weight.mul_(60)
        last.bias[0] -= 0.8
    return augment.Classifier(nn.Sequential(*convolutions, nn.Flatten(), last), SIZE, CLASSES)


def mesh_named(name: str, folder: Path) -> renderer.Mesh:
    """NAME:SEED is a solid, +N subdivides it, .glb writes it to a file and reads it; a textured tent has two sides."""
    if name == "tent":
        vertices = np.array(
            [[-1, -1, 0], [1, -1, 0], [1, 0, 0.8], [-1, 0, 0.8], [1, 1, 0], [-1, 1, 0]]
        )
        plain = renderer.Mesh.plain(vertices, [[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5]])
        uvs = ((vertices[plain.faces][..., :2] + 1) / 2).astype(np.float32)
        texture = np.random.default_rng(1).integers(0, 256, (8, 8, 3), dtype=np.uint8)
        return replace(
            plain, corner_uvs=uvs, texture_ids=np.zeros(4, dtype=np.int32), textures=(texture,)
        )
    kind, seed, more = re.fullmatch(r"(\w+):(\d+)(.*)", name).groups()
    mesh = renderer.solid(kind, int(seed))
    if more == ".glb":
        renderer.export_mesh(mesh, folder / "mesh.glb")
        return renderer.load_mesh(folder / "mesh.glb")
    return renderer.subdivide(mesh, int(more)) if more else mesh


def light_named(name: str, folder: Path) -> Tensor:
    if name == "skylight":
        return 0.02 * skylight(
            torch.tensor(0.9).rad2deg(), torch.tensor(2.0).rad2deg(), torch.tensor(3.5)
        )
    if name == "lamp":
        return directional(torch.tensor([0.48, 0.6, 0.64]), torch.tensor([1.0, 0.9, 0.7]))
    if name == "environment":
        np.save(
            folder / "map.npy",
            np.random.default_rng(4).gamma(0.3, size=(16, 32, 3)).astype(np.float32),
        )
        return renderer.load_light(str(folder / "map.npy"))
    return renderer.load_light(name)
