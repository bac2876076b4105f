"""Settings of the commands besides pnb-train.

This module imports neither torch nor NumPy; see `renderer.settings`.
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from itertools import accumulate
from pathlib import Path
from typing import Any

from augment import augmentation_settings as augmentation
from augment.attack_settings import PARAMETER_NAMES, AttackSettings, RelightingSettings
from augment.settings import AUTO, PYTHON, RendererSettings, SceneSettings
from renderer import errors
from renderer import settings as base
from renderer.errors import MAX_SCALE, MAX_SEED, InputError, is_number
from renderer.settings import REQUIRED, Settings, pair, setting, setting_like
from train import settings as common
from train.settings import LABEL, MESHES, NETWORKS, PROBABILITY, TIME_FOLDER, TaskSettings, text

SCALES = (1 / MAX_SCALE, MAX_SCALE)
# Default environment maps of an audit.
ENVIRONMENTS = ("grace", "eucalyptus", "st_peters")
# Patterns of projectors in training images.
TRAINED_PATTERNS = ("solid", "gradient", "stripes", "checkers", "half", "spots")
# Patterns of projectors in test images. Training uses none of these patterns.
OTHER_PATTERNS = ("rings", "window", "leaves", "text", "colors")
# Name of the pattern that projects image files of the user.
SLIDES = "slides"
PATTERNS = (*TRAINED_PATTERNS, *OTHER_PATTERNS, SLIDES)
# Layouts of the data sets of pnb-render, and the maps that it writes for each render.
DATA_SET_FORMATS = ("imagefolder", "coco", "yolo", "webdataset")
DATA_SET_MAPS = ("mask", "depth", "normals")
OF_NETWORK = tuple(field.name for field in fields(TaskSettings))
# Settings of pnb-attack that count for photographs, besides those of the network.
OF_RELIGHTING = (
    *("seed", "out", "overwrite", "unlabeled"),
    *("attack.relighting", "attack.batch_size", "attack.sensor_noise"),
)
# Settings of pnb-render that it shares with other commands, and that count without a network.
# Attacked parameters are then drawn from their norm-balls.
OF_RENDERS = (
    *("size", "device", "augment.vary", "augment.random_light", "augment.attack.allow_negative"),
    *(f"augment.attack.{name}" for name in PARAMETER_NAMES),
)
# The objects that pnb-lab renders by default: six oranges, and ten other objects.
LAB_MESHES = [
    *(f"solid:orange:{seed}" for seed in range(101, 107)),
    *("solid:apple:101", "solid:apple:102", "solid:pear:101", "solid:sweet_pepper:101"),
    *("solid:lemon:101", "solid:lemon:102", "solid:peach:101", "solid:peach:102"),
    *("solid:ball:101", "solid:ball:103"),
]


@dataclass
class AttackCommandSettings(AttackSettings):
    """Settings of an attack that only the command pnb-attack has."""

    relighting: RelightingSettings | None = setting(
        None, "Attack on the light of a projector on the photographs in `unlabeled`."
    )
    shared: bool = setting(False, "The views share one lighting, shape or color.")
    force: bool = setting(False, "Also attack images that are misclassified before the attack.")
    checks: bool | None = setting(
        None, "Try random draws, and 3 and 10 times as many steps. null: if there are gradients."
    )
    radius_scales: list[float] = setting(
        [], "Factors of each radius, such as [0.5, 1, 2], to measure success for.", within=SCALES
    )
    verify: str | None = setting(
        "reload", "Render the written files again: reload (here), mitsuba, reload+mitsuba or null."
    )

    @property
    def renderers(self) -> list[str]:
        """Names of the renderers that render the written files again, from `verify`."""
        return self.verify.split("+") if self.verify else []


@dataclass
class AttackSceneSettings(SceneSettings):
    """Settings of the scene that the command pnb-attack attacks."""

    views: int = setting_like(SceneSettings, "views", 1)
    search: int = setting(10, "Cameras tried for a misclassified mesh.", within=(0, base.MAX_VIEWS))


@dataclass
class TransferSettings(Settings):
    """Settings of transfer attacks of pnb-attack.

    The lighting, shape or pattern that fools the attacked classifier is tried on
    other classifiers, views and meshes. The success rate on another classifier
    counts only images that it classified correctly before the attack.
    """

    networks: list[Any] = setting([], "Other networks: as `network`, or {network, weights}.")
    azimuths: list[float] = setting(
        [], "Rotations of the camera about the vertical.", "degrees", within=(-360, 360)
    )
    meshes: list[Any] = setting([], "Other meshes, as `meshes`, in the same lighting.")


@dataclass
class AttackExperimentSettings(TaskSettings):
    """Settings of the command pnb-attack, which attacks one classifier.

    If the attack needs a projector or lamps and the scene has none, the scene gets them with
    default settings. An attack on the pose sets `renderer.silhouettes` to True, because its
    gradient needs the silhouettes of objects.
    """

    network: str = setting("efficientnet_lite0", f"The attacked network: {NETWORKS}.")
    label: Any = text(LABEL)
    target: Any = text("Class to reach, least_likely, or one per view. null: any other class.")
    goal: str | None = setting(
        None, "Goal of an attack on a detector. null: hide.", choices=("hide", "mislabel")
    )
    seed: int = setting(0, "Seed of all random draws.", within=(0, MAX_SEED))
    out: str = setting(f"runs/attacks/{TIME_FOLDER}", "Folder of the adversaries.")
    meshes: list[Any] = setting(["solid:orange:0"], MESHES, is_filled=True)
    unlabeled: str | None = setting(None, "Folder of photographs for attack=relighting.")
    reload: str | None = setting(None, "Folder of an adversary to classify, or to attack further.")
    overwrite: bool = setting(False, "Replace results in the folder `out`.")
    attack: AttackCommandSettings = setting(
        AttackCommandSettings, "What is attacked, and how. attack=NAME+NAME names it."
    )
    transfer: TransferSettings = setting(TransferSettings, "Where else adversaries are tried.")
    scene: AttackSceneSettings = setting(AttackSceneSettings, "The scene.")
    renderer: RendererSettings = setting(
        lambda: RendererSettings(shadows=True), "How images are rendered."
    )

    def __post_init__(self) -> None:
        """Check all values, and add to the scene the lights that are attacked."""
        super().__post_init__()
        # Several views can have a target each.
        names = self.target if isinstance(self.target, list) else [self.target]
        if any(isinstance(name, dict | list) for name in names):
            raise self.wrong("target", "is no class: give one, least_likely, or one per view")
        # The name of a class can be a number, which YAML reads as one.
        if isinstance(self.target, int | float):
            self.target = str(self.target)
        attacked = self.attack.parameters
        # Relighting attacks photographs, so it needs a folder of them.
        if (self.attack.relighting is None) != (self.unlabeled is None):
            raise InputError("attack=relighting and unlabeled=FOLDER: set both, or neither")
        if self.unlabeled is not None and (attacked or self.reload):
            raise InputError("attack=relighting takes no meshes: remove the others", "attack")
        if self.unlabeled is not None:
            counting = (*OF_RELIGHTING, *OF_NETWORK)
            require_counting(self, AttackExperimentSettings(), counting, "for attack=relighting")
        common.prepare_attack(self, attacked)


def require_counting(given: Any, default: Any, names: Iterable[str], use: str) -> None:
    """Refuse settings that differ from their defaults, except for those of some names."""
    defaults = dict(common.dotted(asdict(default)))
    for key, value in common.dotted(asdict(given)):
        counts = any(f"{key}.".startswith(f"{name}.") for name in names)
        if not counts and value != defaults.get(key):
            raise InputError(f"{key}={value} does not count {use}: leave it out", key)


@dataclass
class LabSettings(Settings):
    """Settings of the command pnb-lab, which path-traces test images of objects.

    A mesh is a file, "solid:NAME:SEED" for a generated object, or a mapping with the fields of
    `ObjectSettings`. Its label is a class of the network, or "other_NAME" for an object of no
    class.
    """

    out: str = setting(REQUIRED, "A new folder, for photos= of pnb-evaluate.")
    label: Any = text("Positive class, or several, of which a render shows one. null: orange.")
    meshes: list[Any] = setting(LAB_MESHES, "The objects: by default, 6 oranges and 10 others.")
    setups: int = setting(180, "Draws of lighting, camera and pose.", within=(1, common.MAX_IMAGES))
    patterns: list[str] = setting(
        list(TRAINED_PATTERNS), f"Projected patterns: {', '.join(PATTERNS)}. a+b: two projectors."
    )
    slides: list[str] = setting([], "Image files that the pattern `slides` projects.")
    environments: list[str] = setting(
        [], "Environment maps (.npy, .hdr, .exr) that light setups of their own."
    )
    brightness: list[float] = pair([0.2, 2.5], "radiance of white surfaces in full light.", SCALES)
    azimuth: list[float] = pair(
        [-70, 70], "azimuth of a projector from the camera.", (-180, 180), "degrees"
    )
    elevation: list[float] = pair(
        [25, 70], "elevation of a projector above the table.", (1, 89), "degrees"
    )
    ambient: list[float] = pair([0.01, 0.06], "radiance of the uniform environment.", (0, 1))
    albedo: list[float] = pair([0.04, 0.16], "albedo of table and wall.", (0, 1))
    walls: float = setting(0.0, "Fraction of setups with a wall behind the object.", within=(0, 1))
    roughness: list[float] = pair(
        [0.5, 0.5], "roughness of the object. 0.1 is glossy, 1 is matte.", (0.05, 1)
    )
    exposure: float = setting(1.0, "Factor of the radiance, of which 1 is white.", within=SCALES)
    size: Any = setting(64, "Pixels per side, or [height, width].", within=(1, base.MAX_SIZE))
    spp: int = setting(32, "Paths per pixel and light.", within=(1, 10**5))
    bounces: int = setting(4, "Largest number of bounces of light.", within=(1, 1000))
    seed: int = setting(0, "Seed of all random draws.", within=(0, MAX_SEED))
    overwrite: bool = setting(False, "Replace the renders in the folder `out`.")

    def __post_init__(self) -> None:
        """Check all values, and that each pattern and each environment gets as many setups."""
        self.size = base.as_size("size", self.size, base.MAX_SIZE)
        super().__post_init__()
        if self.label is None and self.meshes != LAB_MESHES:
            raise InputError("label is not set: give the class of the meshes, label=CLASS", "label")
        self.label = "orange" if self.label is None else self.label
        # A pattern such as "leaves+text" needs two projectors, with a family of patterns each.
        families = {family for pattern in self.patterns for family in pattern.split("+")}
        for family in sorted(families):
            errors.require_choice("patterns", family, PATTERNS)
        if SLIDES in families and not self.slides:
            raise self.wrong("patterns", "need image files: set slides to them")
        # Each pattern and each environment lights the same number of setups, and names files.
        sources = [*self.patterns, *(Path(path).stem for path in self.environments)]
        if not sources:
            raise InputError("patterns and environments are empty: give one of them", "patterns")
        if self.setups % len(sources):
            advice = f"must be a multiple of the {len(sources)} patterns and environments"
            raise self.wrong("setups", advice)
        if len(set(sources)) < len(sources):
            raise InputError(f"patterns and environments {sources} must have different names")


@dataclass
class AuditSettings(TaskSettings):
    """Settings of the command pnb-audit, which measures how safe a network is in unusual lighting.

    A mesh is a file, "solid:NAME:SEED" for a generated object, or a mapping with the fields of
    `ObjectSettings`.
    """

    network: str = setting(REQUIRED, f"The audited network: {NETWORKS}.")
    hardened: str | None = setting(None, "A network to compare with, such as run:runs/harden.")
    label: Any = text(LABEL)
    meshes: list[Any] = setting([], "Meshes of the class. []: only `unlabeled` is audited.")
    unlabeled: str | None = setting(
        None, "Folder of photographs, of which 100 × `budget` are relit by a projector."
    )
    hard_negatives: list[Any] = setting([], "Meshes of other classes. []: fruit and balls.")
    photos: str | None = setting(None, "Folder of photographs, as pnb-evaluate takes it.")
    laboratory: str | None = setting(None, "Renders of pnb-lab. null: Mitsuba renders the meshes.")
    environments: list[str] = setting([*ENVIRONMENTS], "Environment lightings, or maps (.hdr ...).")
    budget: float = setting(
        1.0, "Factor of the numbers of views, lightings and renders.", within=(0.01, 100)
    )
    overwrite: bool = setting(False, "Start anew in a folder that holds an audit or other results.")
    seed: int = setting(0, "Seed of all random draws.", within=(0, MAX_SEED))
    out: str = setting(f"runs/audits/{TIME_FOLDER}", "Folder of the audit. A stopped one goes on.")

    def __post_init__(self) -> None:
        """Check all values, and that there is something to audit: meshes or photographs."""
        super().__post_init__()
        if not self.meshes and self.unlabeled is None:
            raise self.wrong("meshes", "is empty: name a mesh, or set unlabeled")
        for key in ("hard_negatives", "photos", "laboratory"):
            if getattr(self, key) and not self.meshes:
                raise InputError(f"{key} is set, but meshes is empty: set meshes, too", key)
        if self.laboratory and self.hard_negatives:
            raise self.wrong("laboratory", "is a folder of renders: give it or hard_negatives")

    def scale(self, count: int) -> int:
        """Multiply a number of views, lightings or renders by the budget; at least 1 is left."""
        return max(1, round(count * self.budget))


@dataclass
class EvaluateSettings(TaskSettings):
    """Settings of the command pnb-evaluate, which scores a network on photographs."""

    photos: str = setting(
        REQUIRED,
        "Folder of photographs: a folder per class, or images of `label`. Of a detector: a file of "
        "COCO, or a folder of images with labels of YOLO. Of a segmenter: images/ and masks/.",
    )
    fit: str = setting(
        "letterbox", "How photographs get the network's size.", choices=("letterbox", "stretch")
    )
    run: str | None = setting(
        None,
        "Folder of a run, instead of `network`. Both may be set if a python: function built the "
        "network of the run.",
    )
    label: Any = text("Positive class, or several. null: that of the run, or all with a folder.")
    out: str = setting(f"runs/photographs/{TIME_FOLDER}", "Folder of the scores.")
    false_positive_rate: float | None = setting(
        None, "False-positive rate on `calibrate` that sets the threshold.", within=PROBABILITY
    )
    calibrate: str | None = setting(None, "A folder like photos. null: the network's threshold.")
    by: str = setting("source", "Groups: a column of photos.csv, or class.", choices=common.GROUPS)
    skip_unreadable: bool = setting(False, "Skip photographs that cannot be read.")
    overwrite: bool = setting(False, "Replace results in the folder `out`.")
    precision: str = setting("auto", "auto (bfloat16 where it is fast), bfloat16 or float32.")

    def __post_init__(self) -> None:
        """Check all values, and that the settings name one network."""
        super().__post_init__()
        require_calibration(self.false_positive_rate, self.calibrate)
        if self.label is not None:
            common.label_names(self.label)  # This call only checks the label.
        # With `run`, `network` may only name the function that built the network of the run.
        builds_run = (self.network or "").startswith(PYTHON)
        if (self.run is None) == (self.network is None) and not (self.run and builds_run):
            raise InputError(f"run={self.run} and network={self.network} do not match: give one")


def require_calibration(rate: float | None, calibrate: str | Path | None) -> None:
    """Check that the two settings that choose a threshold are given together.

    The threshold on the score of a class is chosen so that a given fraction of the negatives in a
    folder of photographs is above it. `rate` is this fraction, and both arguments must be set, or
    none.
    """
    errors.require_range("false_positive_rate", rate, *PROBABILITY)
    if (rate is None) != (calibrate is None):
        raise InputError(f"false_positive_rate={rate}, calibrate={calibrate}: give both or none")


@dataclass
class FitSettings(Settings):
    """Settings of the command pnb-fit.

    It finds the lighting and background of a photograph from a mesh of the object in it.
    """

    photograph: str = setting(REQUIRED, "An image file.")
    mesh: str = setting(REQUIRED, "A mesh file or solid:NAME:SEED, upright as in the photograph.")
    mask: str | None = setting(None, "Image of the photograph's size, white where the object is.")
    box: list[int] = setting([], "Box instead of a mask, [left, top, right, bottom] in pixels.")
    fov: float | None = setting(
        None,
        "Angle across a square 1.6 times as wide as the object. null: orthographic.",
        "degrees",
        within=(0.1, 120),
    )
    albedo_scale: float = setting(
        1.0, "Factor of the albedo. Twice as much halves the light.", within=(1e-3, 1e3)
    )
    encoding: str = setting(
        "srgb", "Encoding of the photograph and of the colors of the mesh.", choices=base.ENCODINGS
    )
    bounces: int = setting(
        3, "Bounces of light between surfaces. 0: no shadows, either.", within=(0, base.MAX_BOUNCES)
    )
    label: str | None = setting(None, "Class in the printed command. null: the name of the mesh.")
    size: int = setting(64, "Pixels per side that are compared.", within=(16, 512))
    out: str = setting("runs/fit", "Folder of the background, the mask, the light and a picture.")
    overwrite: bool = setting(False, "Replace results in the folder `out`.")

    def __post_init__(self) -> None:
        """Check all values, and that either a mask or a box says where the object is."""
        super().__post_init__()
        if bool(self.mask) == bool(self.box):
            raise InputError(f"mask={self.mask} and box={self.box}: give one of them")


@dataclass(kw_only=True)
class RenderSettings(TaskSettings):
    """Settings of the command pnb-render, which writes labeled renders as a data set.

    The renders show the meshes in turn, and their views and backgrounds in random order.
    """

    network: str | None = setting(None, f"Network that each render shall fool: {NETWORKS}.")
    meshes: list[Any] = setting(
        ["solid:orange", "solid:apple", "solid:cup"], MESHES, is_filled=True
    )
    label: Any = text("Class of the meshes. null: what the name of each file tells.")
    format: str = setting("imagefolder", "Layout of the data set.", choices=DATA_SET_FORMATS)
    count: int = setting(100, "Number of renders.", within=(1, MAX_SEED))
    # A mapping would be merged into a default that is a mapping.
    splits: Any = setting(
        None, "Parts of the data set, and their fractions. null: {train: 0.8, val: 0.1, test: 0.1}."
    )
    maps: list[str] = setting(
        list(DATA_SET_MAPS), "Further images of each render.", choices=DATA_SET_MAPS
    )
    seed: int = setting(0, "Seed of all random draws.", within=(0, MAX_SEED))
    shards: int = setting(1, "Parts of the work for --multirun shard=0,1,...", within=(1, None))
    shard: int = setting(0, "Index of the part that this process renders.", within=(0, None))
    out: str = setting(REQUIRED, "Folder of the data set. A stopped command continues in it.")
    augment: augmentation.AugmentationSettings = setting(
        lambda: augmentation.AugmentationSettings(
            mode="random",
            examples=None,
            random_light=augmentation.RandomLightSettings(amplitude=0.1),
            vary=augmentation.VariationSettings(
                shift=0.1,
                scale=[0.6, 1.0],
                instances=True,
                azimuth=25.0,
                environments=[*ENVIRONMENTS],
                background_saturation=0.5,
            ),
        ),
        "What is drawn at random, and the attack if there is a network.",
    )
    scene: SceneSettings = setting(
        lambda: SceneSettings(
            backgrounds=[0.1, 0.3, 0.5, 0.7, 0.9], views=12, fov=30.0, exposure=AUTO
        ),
        "The scene. light=NAME is short for scene.light=NAME.",
    )
    renderer: RendererSettings = setting(
        lambda: RendererSettings(encoding="srgb"), "How images are rendered."
    )

    def __post_init__(self) -> None:
        """Check all values, and compute the number of renders in each part."""
        super().__post_init__()
        if self.shard >= self.shards:
            raise self.wrong("shard", f"must be less than shards={self.shards}")
        if self.splits is None:
            self.splits = {"train": 0.8, "val": 0.1, "test": 0.1}
        elif isinstance(self.splits, dict):
            self.splits = {str(part): fraction for part, fraction in self.splits.items()}
        parts = [*self.splits.values()] if isinstance(self.splits, dict) else []
        if not all(is_number(part) and part >= 0 for part in parts) or not sum(parts):
            raise self.wrong("splits", "must be parts and their fractions, such as {train: 1}")
        if any(name in ("", "..") or Path(name).name != name for name in self.splits):
            raise self.wrong("splits", "must name parts without folders, such as {train: 1}")
        common.prepare_attack(self, self.augment.attack.parameters)
        # The default depends on the network. `require_counting` refuses other modes.
        if self.network and self.augment.mode == "random":
            self.augment.mode = "adversarial"

    def require_counting(self) -> None:
        """Refuse settings that do not count, such as those of a network if there is none."""
        own = {field.name for field in fields(self)}.difference(OF_NETWORK, ["augment"])
        names, use = [*own, *OF_RENDERS], "without network"
        if self.network:
            names, use = [*names, *OF_NETWORK, "augment.attack", "augment.init"], "for pnb-render"
        require_counting(self, RenderSettings(out=self.out, network=self.network), names, use)

    @property
    def split_counts(self) -> dict[str, int]:
        """Number of renders in each part that has one. Together they have `count` renders."""
        total = sum(self.splits.values())
        limits = [0, *(round(self.count * end / total) for end in accumulate(self.splits.values()))]
        counts = zip(self.splits, map(int.__sub__, limits[1:], limits), strict=True)
        return {part: count for part, count in counts if count}


@dataclass
class CompareSettings(Settings):
    """Settings of the command pnb-compare, which prints tables of the metrics of training runs."""

    runs: list[str] = setting(REQUIRED, "Runs, sweeps, or folders above.", is_filled=True)
    by: str = setting_like(EvaluateSettings, "by", "source")


@dataclass
class ReportSettings(Settings):
    """Settings of the command pnb-report, which writes an HTML page about runs and attacks."""

    runs: list[str] = setting(REQUIRED, "Runs, sweeps, attacks, or folders above.", is_filled=True)
    out: str | None = setting(None, "Folder of the page. null: the common parent of the runs.")
    overwrite: bool = setting(False, "Replace results in the folder `out`.")
