"""Weights, attacks and renders are as they were recorded, so that a refactoring changes none.

Rounded values in float64 hold on every machine. They are in portable.json. Hashes of all bits hold
on the machine that recorded them: frozen.json has SHA-256 hashes by case, for each machine by its
CPU, instruction set and versions of libraries. On another machine the tests are skipped. To use
them there, record at the commit before a change, and verify after the change:

    RECORD_FROZEN=1 python -m pytest -q tests/test_frozen.py    # or a part, by -k
    python -m pytest -q tests/test_frozen.py -k render          # or attack, or weights

A change that is meant to change bits or values records anew, and its commit says so. Tensors are
hashed by type, shape and bytes in their order, not by name. The tables below have everything by
which the library is called, so that a renamed keyword or key is edited there.
"""

import hashlib
import json
import os
import platform
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info
from torch import Tensor, nn

import augment
import renderer
from augment.attack_settings import EOTSettings
from augment.scene.objects import Conditions
from renderer.light.skylight import coefficients as skylight

RECORDS = Path(__file__).with_name("frozen.json")
PORTABLE = Path(__file__).with_name("portable.json")
DECIMALS = 5  # Values in portable.json are rounded to these.
MAX_PORTABLE_VALUES = 40  # portable.json has so many values of each tensor.
# These cases trace rays in float32, whose hits depend on the machine.
TRACED = {"bounces", "shadows", "bounces_gradients"}
LIBRARIES = ("torch", "numpy", "scipy", "embreex", "pillow")
# This rasterizer gives the same on every machine. "numba" has a case of its own.
SOFTWARE = {"rasterizer": "numpy"}
SIZE = 24

ABOVE = renderer.OrthographicCamera(60.0, 22.91831180523293, 2.2)
ASIDE = renderer.OrthographicCamera(80.21409131831524, 143.2394487827058, 2.6, 0.2, -0.1)
NEAR = renderer.PerspectiveCamera(63.02535746439056, -40.10704565915762, 2.2, distance=4.0)
RING = renderer.orbit_cameras(3, 2.2, fov=40.0)
VARNISHED_METAL = renderer.Gloss(roughness=0.4, metallic=0.3, specular_factor=0.8)


@dataclass(frozen=True)
class RenderCase:
    """A call of `render`, with the names of the arguments whose gradients are recorded."""

    mesh: str
    cameras: Any
    light: str
    options: dict[str, Any]
    differentiated: tuple[str, ...] = ()


ALL_LEAVES = ("light", "vertices", "albedo")
RENDERS = {
    "compiled": RenderCase("lemon:2", RING, "st_peters", {"rasterizer": "numba"}),
    "shadows": RenderCase("pear:0", ASIDE, "environment", {"shadows": True}),
    "bounces": RenderCase(
        "cup:0", NEAR, "uniform", {"bounces": 2, "normals": "flat", "encoding": "srgb"}
    ),
    "sky": RenderCase("mushroom:3", RING, "skylight", {"albedo_scale": 0.7, "background": 0.1}),
    "exported": RenderCase("bottle:1.glb", ASIDE, "grace", {"encoding": "srgb"}),
    "textured": RenderCase("tent", NEAR, "grace", {"encoding": "srgb"}, ("light", "albedo")),
    "flat_gradients": RenderCase("sweet_pepper:0", ABOVE, "grace", {"normals": "flat"}, ALL_LEAVES),
    "smooth_gradients": RenderCase("peach:0", NEAR, "eucalyptus", {"encoding": "srgb"}, ALL_LEAVES),
    "gloss_gradients": RenderCase("apple:1", NEAR, "grace", {"gloss": VARNISHED_METAL}, ALL_LEAVES),
    "bounces_gradients": RenderCase("lamp:0", ABOVE, "uniform", {"bounces": 1}, ALL_LEAVES),
}


# Meshes, cameras and options of `precompute_transfer`.
OPERATORS: dict[str, tuple[str, Any, dict[str, Any]]] = {
    "one_color": ("ball:0", ABOVE, {"normals": "flat"}),
    "colors": ("orange:3", RING, {"encoding": "srgb", "albedo_scale": 1.3, "samples": 3}),
    "shadows": ("plate:0", NEAR, {"shadows": True}),
    "bounces": ("cup:1", ASIDE, {"bounces": 2}),
}
LIGHTS_OF_OPERATORS = ("grace", "skylight", "environment")

CUP = augment.ObjectSettings("solid:cup:0", at=[0.9, 0.6], scale=0.6, azimuth=30.0)
LEMON = augment.ObjectSettings("solid:lemon:1", at=[-0.9, 0.4], scale=0.4)
WITH_PROPS = augment.ObjectSettings("solid:pear:0", "orange", albedo_scale=0.9, others=[CUP, LEMON])
PROJECTOR = augment.ProjectorSettings(pixels=6, polar=50.0, azimuth=20.0, power=2.0, pattern=0.5)
LAMPS = augment.LampsSettings([[2.0, 1.0, 2.0], [-2.0, 0.5, 1.5]], power=8.0, start=3.0)
DISCS = augment.LampsSettings(
    [[2.0, 1.0, 2.0], [0.5, -2.0, 2.5]], power=8.0, radius=0.4, start=[[4, 3, 2], [1, 2, 3]]
)


# Meshes, views and options of `build_scene`.
SCENES: dict[str, tuple[list[Any], int, dict[str, Any]]] = {
    "grid": (
        [("solid:orange:0", "orange"), ("solid:apple:0", "apple")],
        2,
        {"backgrounds": [0.2, 0.8]},
    ),
    "props": ([WITH_PROPS], 2, {"ground": [0.6, 0.5, 0.4], "shadows": True, "fov": 40.0}),
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
    "all_lights": ([WITH_PROPS], 1, {"lamps": LAMPS, "projector": PROJECTOR, "shadows": True}),
}

CLASSES = ["orange", "apple", "pear", "bottle"]
ORANGES = [("solid:orange:0", "orange"), ("solid:orange:1", "orange")]
SCENE_OPTIONS = {"samples": 2, "encoding": "linear", "normals": "flat", **SOFTWARE}
ATTACK_SETTINGS = {"max_steps": 4, "margin": 0.5, "quantized": False, "allow_negative": False}
StepSettings = augment.StepSettings


@dataclass(frozen=True)
class AttackCase:
    """A call of `attack` on two oranges, with arguments that replace those of all."""

    attacked: dict[str, Any]
    scene: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    target: str | None = None


ATTACKS = {
    "lighting_l2": AttackCase(
        {"lighting": StepSettings("l2", 0.8, step_size=0.3)}, settings={"quantized": True}
    ),
    "skylight": AttackCase(
        {"skylight": augment.SkylightSettings(zenith=30.0, step_size=0.3)}, {"normals": "smooth"}
    ),
    "projector": AttackCase(
        {"projector": StepSettings(step_size=1.0)}, {"projector": PROJECTOR, "encoding": "srgb"}
    ),
    "lamps": AttackCase({"lamps": StepSettings(step_size=2.0)}, {"lamps": LAMPS, "shadows": True}),
    "places": AttackCase({"positions": StepSettings("l2", 1.0, step_size=0.3)}, {"lamps": DISCS}),
    "albedo": AttackCase(
        {"albedo": StepSettings("linf", 0.2, "sign", 0.03)},
        {"shadows": True, "ground": [0.5, 0.4, 0.3]},
    ),
    "pixels": AttackCase(
        {"pixels": StepSettings("linf", 0.03, "sign", 0.01)}, target="least_likely"
    ),
    "shared_views": AttackCase(
        {
            "lighting": StepSettings(step_size=0.2),
            "geometry": StepSettings(radius=0.01, step="sign", step_size=0.005),
        },
        {"views": 3, "shared": True, "fov": 35.0},
        {"backtracking": True},
    ),
    "expectation": AttackCase(
        {"lighting": StepSettings("linf", 0.1, "sign", 0.04)},
        {"backgrounds": [0.1, 0.9]},
        {"restarts": 2, "eot": EOTSettings(draws=2)},
    ),
}

SMALL = """
data=shapes data.train_per_class=10 data.test_per_class=4 size=16 model.depth=10 model.width=1
train.epochs=2 train.batch_size=16 train.precision=float32 train.device=cpu train.threads=1
renderer.rasterizer=numpy renderer.samples=2 scene.backgrounds=[0.2,0.8]
"""
RUNS = {
    "demonstration": """
experiment=paper compare=[none] model.dropout=0.0 train.schedule=one_cycle augment.examples=4
augment.attack.max_steps=3 augment.attack.step_size=0.3
""",
    "harden": """
experiment=harden augment=adversarial augment.examples=6 augment.regenerate_every=30
augment.init=random augment.warm_start=true +attack@augment.attack=[lighting,albedo]
augment.attack.max_steps=3 augment.vary.shift=0.1 augment.vary.exposure=[0.5,1.5]
augment.vary.camera.noise=0.02 model.dropout=0.3 train.epochs=3 train.images_per_epoch=60
train.augmentation=augmix train.ranking_weight=0.5 train.label_smoothing=0.1 train.ema_decay=0.8
train.flips=alternating scene.views=1 meshes=[solid:orange:0,solid:orange:1]
hard_negatives=[{mesh:'solid:ball:0',label:apple}]
""",
}
# Folders of the runs that were made, by the names of RUNS.
FOLDERS: dict[str, Path] = {}


def listed(cameras: Any) -> list[renderer.Camera]:
    """Return one camera or several as a list, so that images have a views dimension."""
    return [cameras] if isinstance(cameras, renderer.Camera) else cameras


def rendered(
    case: RenderCase, folder: Path, names: Iterable[str], dtype: torch.dtype, options: dict
) -> list[Tensor]:
    """Return images, and their gradients by the arguments with some names."""
    mesh = mesh_named(case.mesh, folder)
    shape = (mesh.textures or [mesh.faces])[0].shape
    draws = torch.Generator().manual_seed(2)
    albedo = 0.2 + 0.6 * torch.rand(shape, generator=draws)
    vertices = torch.from_numpy(mesh.vertices)
    given = {"light": light_named(case.light, folder), "vertices": vertices, "albedo": albedo}
    leaves = {name: given[name].to(dtype).requires_grad_() for name in names}
    options = {"light": given["light"]} | options | leaves
    images = renderer.render(mesh, listed(case.cameras), size=SIZE, **options)
    return [images, *gradients(images, list(leaves.values()))]


@pytest.mark.parametrize("name", RENDERS)
def test_render(name, tmp_path, verify):
    case = RENDERS[name]
    options = SOFTWARE | case.options
    verify(*rendered(case, tmp_path, case.differentiated, torch.float32, options))


@pytest.mark.parametrize("name", sorted(RENDERS.keys() - TRACED))
def test_values_of_a_render(name, tmp_path, verify_values):
    case = RENDERS[name]
    names = dict.fromkeys(("light", *case.differentiated))
    verify_values(*rendered(case, tmp_path, names, torch.float64, case.options | SOFTWARE))


def render_by_operators(name: str, lights: Tensor, folder: Path) -> list[Tensor]:
    """Return images of all cameras, the gradient of the lights, and the radiance of one camera."""
    mesh, cameras, options = OPERATORS[name]
    operators = renderer.precompute_transfer(
        mesh_named(mesh, folder), listed(cameras), SIZE, **SOFTWARE | options
    )
    images = torch.stack([operator.image(lights, 0.3) for operator in operators])
    radiance = operators[0].radiance(lights.detach())
    return [images, *gradients(images, [lights]), radiance]


@pytest.mark.parametrize("name", OPERATORS)
def test_render_by_operators(name, tmp_path, verify):
    lights = torch.stack([light_named(light, tmp_path) for light in LIGHTS_OF_OPERATORS])
    verify(*render_by_operators(name, lights.requires_grad_(), tmp_path))


@pytest.mark.parametrize("name", sorted(OPERATORS.keys() - TRACED))
def test_values_of_a_render_by_operators(name, tmp_path, verify_values):
    lights = torch.stack([light_named(light, tmp_path) for light in LIGHTS_OF_OPERATORS])
    lights = lights.double().requires_grad_()
    verify_values(*render_by_operators(name, lights, tmp_path))


@pytest.mark.parametrize("name", SCENES)
def test_render_of_a_scene(name, verify):
    meshes, views, options = SCENES[name]
    scene = augment.build_scene(meshes, SIZE, views, **SCENE_OPTIONS | options)
    examples = torch.arange(len(scene))
    lights = scene.lights.clone().requires_grad_()
    relit = scene.render(Conditions(lights), examples)
    relit_gradients = gradients(relit, [lights])

    vertices = scene.vertices[scene.object_of].clone().requires_grad_()
    largest_face_count = max(len(item.mesh.faces) for item in scene.objects)
    albedo = torch.zeros(len(scene), largest_face_count, 3).requires_grad_()
    conditions = Conditions(lights, vertices=vertices, albedo=albedo)
    reshaded = scene.render(conditions, examples)
    reshaded_gradients = gradients(reshaded, [lights, vertices, albedo])
    verify(relit, *relit_gradients, reshaded, *reshaded_gradients)


@pytest.mark.parametrize("name", ATTACKS)
def test_attack(name, verify):
    case = ATTACKS[name]
    scene_options = SCENE_OPTIONS | case.scene
    scene = augment.build_scene(ORANGES, SIZE, **scene_options)
    settings = augment.AttackSettings(**case.attacked, **ATTACK_SETTINGS | case.settings)
    result = augment.attack(classifier(), scene, case.target, settings, seed=5, force=True)
    assert (result.images - result.images_before).abs().max() > 1e-3
    in_views = result.images_in_views_before, result.images_in_views, result.logits_in_views
    verify(*in_views, result.minimum.values, result.minimum.cost, result.steps)


@pytest.mark.parametrize("name", ["demonstration/none", "demonstration", "harden"])
def test_weights(name, trained, verify):
    run, _, compared = name.partition("/")
    verify(*weights(trained(run) / compared))


@pytest.fixture
def trained(call, monkeypatch, tmp_path_factory) -> Callable[[str], Path]:
    """Return a function that gives the folder of one of RUNS.

    The run is made when a first test asks for it.
    """
    monkeypatch.setattr("train.results.page.report_of", lambda folders, out: "no report")

    def run(name: str) -> Path:
        if name not in FOLDERS:
            folder = tmp_path_factory.mktemp("frozen") / name
            arguments = [*SMALL.split(), *RUNS[name].split(), f"out={folder}"]
            if name != "demonstration":
                arguments.append(f"network={run('demonstration')}")
            assert call("train", *arguments) == 0
            FOLDERS[name] = folder
        return FOLDERS[name]

    return run


@pytest.fixture
def verify(request) -> Callable[..., None]:
    """Return a function that compares a hash of tensors with the recorded one, or records it."""
    records = json.loads(RECORDS.read_text()) if RECORDS.exists() else {}
    recording = os.environ.get("RECORD_FROZEN")
    if not recording and fingerprint() not in records:
        command = "RECORD_FROZEN=1 python -m pytest tests/test_frozen.py"
        pytest.skip(f"nothing is recorded for {fingerprint()}: {command}")

    def compare(*tensors: Tensor) -> None:
        case = request.node.name
        assert all(tensor.isfinite().all() for tensor in tensors)
        if recording:
            records.setdefault(fingerprint(), {})[case] = digest(tensors)
            RECORDS.write_text(json.dumps(records, indent=1, sort_keys=True) + "\n")
        recorded = records[fingerprint()].get(case)
        if recorded is None:
            pytest.skip(f"{case} is not recorded for {fingerprint()}")
        assert digest(tensors) == recorded

    return compare


@pytest.fixture
def verify_values(request) -> Callable[..., None]:
    """Return a function that compares values of float64 tensors with records, or records them."""
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
    """Return the mean magnitude and some values of a float64 tensor, rounded."""
    assert tensor.dtype == torch.float64
    flat = tensor.detach().flatten()
    value_count = min(MAX_PORTABLE_VALUES, len(flat))
    chosen = torch.linspace(0, len(flat) - 1, value_count).long()
    values = [flat.abs().mean().item(), *flat[chosen].tolist()]
    return [round(value, DECIMALS) for value in values]


@cache
def fingerprint() -> str:
    """Describe the processor and the libraries that decide about the last bits."""
    file = Path("/proc/cpuinfo")
    text = file.read_text() if file.exists() else ""
    facts = re.findall(r"^(model name|cpu family|model)\s*: (.*)$", text, re.M)
    processor = " ".join(dict(facts).values()) or platform.processor()
    versions = {}
    for name in LIBRARIES:
        for found in distributions(name=name):
            versions[name] = found.version
    instructions = torch.backends.cpu.get_cpu_capability()
    # OPENBLAS_CORETYPE changes the instructions that NumPy and SciPy use. Other libraries, such as
    # OpenCV, have an OpenBLAS of their own, which other tests may have loaded.
    libraries = [info for info in threadpool_info() if "opencv" not in info["filepath"]]
    kernels = {info.get("architecture", "") for info in libraries} - {""}
    versions["OpenBLAS"] = " ".join(sorted(kernels))
    return ", ".join([processor, instructions, *map(" ".join, versions.items())])


def digest(tensors: Iterable[Tensor]) -> str:
    content = hashlib.sha256()
    for tensor in tensors:
        plain = tensor.detach().contiguous()
        content.update(f"{plain.dtype}{tuple(plain.shape)}".encode() + plain.numpy().tobytes())
    return content.hexdigest()


def weights(folder: Path) -> list[Tensor]:
    tensors = []
    for name in ("best.pt", "last.pt"):
        state = torch.load(folder / name, weights_only=True)["model"]
        tensors += state.values()
    return tensors


def gradients(images: Tensor, leaves: list[Tensor]) -> list[Tensor]:
    """Differentiate a cost in which every value of the images has its own weight."""
    if not leaves:
        return []
    weight = torch.linspace(-1, 1, images.numel()).view_as(images)
    return list(torch.autograd.grad((weight * images).sum(), leaves))


def classifier() -> augment.Classifier:
    with torch.random.fork_rng():
        torch.manual_seed(3)
        layers = [nn.Conv2d(3, 8, 3, stride=2), nn.ReLU(), nn.Conv2d(8, 16, 3, stride=2), nn.ReLU()]
        network = nn.Sequential(*layers, nn.Flatten(), nn.Linear(400, len(CLASSES)))
    with torch.no_grad():
        network[-1].weight.mul_(60)
        network[-1].bias[0] -= 0.8
    return augment.Classifier(network, SIZE, CLASSES)


def textured_tent() -> renderer.Mesh:
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 0, 0.8], [-1, 0, 0.8], [1, 1, 0], [-1, 1, 0]])
    plain = renderer.Mesh.plain(vertices, [[0, 1, 2], [0, 2, 3], [3, 2, 4], [3, 4, 5]])
    uvs = (vertices[plain.faces][..., :2] + 1) / 2
    texture = np.random.default_rng(1).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    ids = np.zeros(4, dtype=np.int32)
    return replace(plain, corner_uvs=np.float32(uvs), texture_ids=ids, textures=(texture,))


def mesh_named(name: str, folder: Path) -> renderer.Mesh:
    """Make a mesh by its name.

    NAME:SEED is a solid. NAME:SEED.glb writes it to a file and reads the file. tent is a
    textured roof.
    """
    if name == "tent":
        return textured_tent()
    kind, seed = name.removesuffix(".glb").split(":")
    mesh = renderer.solid(kind, int(seed))
    if name.endswith(".glb"):
        renderer.export_mesh(mesh, folder / "mesh.glb")
        return renderer.load_mesh(folder / "mesh.glb")
    return mesh


def light_named(name: str, folder: Path) -> Tensor:
    """Make the coefficients of a light by its name, which may be that of a preset."""
    if name == "skylight":
        polar = torch.tensor(0.9).rad2deg()
        azimuth = torch.tensor(2.0).rad2deg()
        return 0.02 * skylight(polar, azimuth, torch.tensor(3.5))
    if name == "environment":
        radiance = np.random.default_rng(4).gamma(0.3, size=(16, 32, 3))
        np.save(folder / "map.npy", radiance.astype(np.float32))
        return renderer.load_light(str(folder / "map.npy"))
    return renderer.load_light(name)
