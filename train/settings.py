"""Settings of training. This module imports neither torch nor NumPy; see `renderer.settings`."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from augment.augmentation_settings import MAX_EXAMPLES, AugmentationSettings, views_of
from augment.settings import ObjectSettings, RendererSettings, SceneSettings, read_normalized_light
from renderer.errors import MAX_SCALE, MAX_SEED, InputError, composed, is_whole, require_range
from renderer.settings import MAX_SIZE, MAX_VIEWS, Settings, setting, setting_like, settings_from

# Label of a hard negative (an object of another class than the positive class) for
# which the classifier has no class.
OTHER = "other"
# A folder whose name begins with "other_" has photographs of a class that the
# network lacks.
OTHER_PREFIX = "other_"
# Sub-folder of a training run with the scores on photographs, if the setting
# photos gives the folder of photographs no name.
PHOTOGRAPHS = "photographs"
# Sub-folder of a training run with test renders, which the training does not use.
KEPT_ASIDE = "kept_aside"
# Sub-folder of a training run with the scores on its test renders.
LABORATORY = "laboratory"
# Number of different patterns that projectors throw in the test renders of a run.
KEPT_ASIDE_PATTERNS = 5
# Sub-folder for a first training on photographs, which the setting `photographs_first`
# asks for.
PHOTOGRAPHS_FIRST = "photographs_first"
# Names that the setting photos must not give to folders of photographs,
# because a training run has other sub-folders or scores of these names.
RESERVED = ("renders", "test", "before", KEPT_ASIDE, PHOTOGRAPHS_FIRST)
# Value of data.name for photographs without classes.
UNLABELED = "unlabeled"
# Choices of data.name.
DATA_SETS = ("cifar100", "npz", "folder", UNLABELED, "shapes")
# Properties of photographs. Those with the same value can be scored as one group.
GROUPS = ("source", "mesh", "class")
# Smallest images in pixels per side. Random crops pad images by reflection, which
# needs this size.
MIN_SIZE = 5
MAX_IMAGES = 10**6
PROBABILITY = (1e-6, 1 - 1e-6)
TASKS = ("classification", "detection", "segmentation")
# Number of renders if neither this number nor that of the views is set.
RENDERS = 100
# Explanation of a list of meshes in settings.
MESHES = (
    "Objects: mesh files, solid:NAME:SEED, or mappings {mesh, label, up: auto|y|z, "
    "albedo_scale, color, gloss: [roughness, metallic, specular factor] or file, "
    "azimuth}, or lists of such objects on the same ground, [{mesh, label}, {mesh, label, "
    "at: [x, y], scale, azimuth}, ...], of which the first is attacked."
)
# Explanation of the class of meshes in settings.
LABEL = "Class of the meshes, by name or index. null: the class that the name of each file tells."
# Values of the setting `network`.
NETWORKS = (
    "efficientnet_lite0 to 2, torchvision:NAME, timm:NAME, hf:FOLDER_OR_NAME, run:FOLDER, "
    "squeezenet_caffe or python:package.module:function, or a file of TorchScript, torch.export "
    "(.pt2) or ONNX (.onnx)"
)
# Default name of an output folder: the time at which the command starts. Hydra
# replaces "${now:...}".
TIME_FOLDER = "${now:%Y-%m-%d}/${now:%H-%M-%S-%f}"
# Settings and recorded facts that do not change the result of a training run, such as
# its folder and its device. Two runs that differ only in these settings are equal.
CIRCUMSTANCES = (
    *("sweep", "out", "device", "launcher", "compare", "command", "working_folder", "hashes"),
    *("hardware", "versions", "inputs", "images", "test_images", "overwrite", "train.cache"),
    *("train.resume", "train.device", "train.threads", "train.compile", "train.checkpoint_every"),
)
# Default of model.name.
WIDERESNET = "wideresnet"
# Training settings that need a network with whose weights the training begins.
NEEDS_INITIAL = ("distillation_weight", "soup", "eval_mode", "consistency_weight", "interpolate")
# Value of train.freeze with which only the last layer is trained, as by Kirichenko
# et al. (2023).
ALL_BUT_LAST = "all_but_last"
# Choices of train.augmentation that are transforms of torchvision.
TRANSFORMS = ("color_jitter", "exposure_jitter", "trivial_augment", "augmix", "color_jitter+augmix")
# Augmentation by the light of a projector; see `train.training.augmentations`.
RELIGHT = "relight"
# Augmentation by low light with the noise of a camera, alone or for every second image.
LOW_LIGHT, RELIGHT_AND_LOW_LIGHT = "low_light", "relight+low_light"
# Augmentation by the stripes of a scanner.
STRIPES = "stripes"
# Augmentations that show images in a light, with this light in words.
LIGHTS = {
    RELIGHT: "in the light of a projector",
    LOW_LIGHT: "in low light",
    RELIGHT_AND_LOW_LIGHT: "in the light of a projector or in low light",
    STRIPES: "in the light of a scanner",
}
# Choices of train.optimizer.
OPTIMIZERS = ("sgd", "adamw")
# Choices of train.flips.
FLIPS = ("random", "alternating")
# Choices of train.schedule.
SCHEDULES = ("step", "cosine", "one_cycle")


def text(about: str) -> Any:
    """Create a field, by default None, for one or several names, which may look like numbers."""
    return setting(None, about, is_text=True)


def weight(term: str) -> Any:
    """Create a field for the weight of a term of the loss, by default 0."""
    return setting(0.0, f"Weight of {term}", within=(0, MAX_SCALE))


@dataclass
class DataSettings(Settings):
    """Settings of the data set. Each kind of data set uses some of these settings."""

    name: str = setting("shapes", "The data set.", choices=DATA_SETS)
    validation: float | None = setting(
        None, "Validation fraction. null: what `network` left out, or 0.1.", above=0, below=1
    )
    path: str = setting("", "File or folder of the data.", may_be_empty=True)
    test_fraction: float = setting(0.1, "Test fraction without a folder `test`.", above=0, below=1)
    workers: int = setting(2, "Processes that read images above 64 pixels.", within=(0, 1024))
    train_per_class: int = setting(300, "Training images of each shape.", within=(1, MAX_IMAGES))
    test_per_class: int = setting(60, "Test images of each shape.", within=(1, MAX_IMAGES))
    seed: int = setting(0, "Seed of the shapes.", within=(0, MAX_SEED))

    def __post_init__(self) -> None:
        """Check all values, and that data sets of the user have a path."""
        super().__post_init__()
        if self.name in ("npz", "folder") and not self.path:
            raise InputError(f"path is not set: give the path of the data set {self.name}", "path")


@dataclass
class TrainingSceneSettings(SceneSettings):
    """Settings of the scene of training renders. The defaults are those of the paper."""

    backgrounds: list[Any] = setting_like(SceneSettings, "backgrounds", [0.0, 0.25, 0.5, 0.75, 1.0])
    views: int | None = setting(
        None, "Cameras per mesh. null: as many as augment.examples needs.", within=(1, MAX_VIEWS)
    )


@dataclass
class EvaluationSettings(Settings):
    """Settings of the images on which the trained network is scored, besides `photos`.

    The accuracy on the test set of the data is always computed.
    """

    skip_unreadable: bool = setting(False, "Skip photographs that cannot be read.")
    laboratory_setups: int = setting(
        0, "Path-traced setups to score if photos is null, a multiple of 5.", within=(0, MAX_IMAGES)
    )

    def __post_init__(self) -> None:
        """Check all values."""
        super().__post_init__()
        if self.laboratory_setups % KEPT_ASIDE_PATTERNS:
            raise self.wrong("laboratory_setups", f"must be a multiple of {KEPT_ASIDE_PATTERNS}")


@dataclass(kw_only=True)
class NetworkSettings(Settings):
    """Settings that choose a network, and describe it if it is a network of the user."""

    network: str | None = setting(None, f"The network: {NETWORKS}.")
    size: Any = setting(
        None,
        "Pixels per side, or [height, width]. null: those of the network, or 224.",
        within=(1, MAX_SIZE),
    )
    weights: str | None = setting(None, "File of the network's weights. null: its own.")
    classes: Any = text(
        "Names of the classes in the order of the outputs, [a,b], or a text file with a name in "
        "each line. null: the names that the network knows, otherwise 0, 1 and so on."
    )
    normalization: Any = text(
        "Normalization before the classifier: imagenet, or [MEAN,STD] in units of [0, 1], such as "
        "[[0,0,0],[1,1,1]] for none. null: that of the network, and none before a file's."
    )
    prompt: str | None = setting(None, "Zero-shot prompt; {} is the class. null: a photo of a {}.")
    normalize_light: Any = setting(
        None,
        "Normalize the light of each image before the network sees it: true, or "
        "{white_balance, percentile, level, gamma, average}. A training sees such images, too, and "
        "its network remembers it. null: as the network does. This is not `normalization`.",
    )
    trust: bool = setting(
        False,
        "Load a file of TorchScript or torch.export. It is a program that can run any code, like "
        "a python: function: set this only if you made it or trust its author. State dicts, "
        "safetensors and ONNX are data, and may come from strangers.",
    )

    def __post_init__(self) -> None:
        """Check all values, and convert those that YAML reads as another type."""
        super().__post_init__()
        if isinstance(self.classes, list):
            # The name of a class can be a number, which YAML reads as one.
            self.classes = [str(name) if is_whole(name) else name for name in self.classes]
        # Files record a mapping. True takes the defaults, and a mapping some fields.
        light = read_normalized_light(self.normalize_light)
        self.normalize_light = None if light is None else asdict(light)


@dataclass(kw_only=True)
class TaskSettings(NetworkSettings):
    """Settings that choose a network, and say what its outputs mean and what computes them."""

    task: str | None = setting(None, "What the outputs are. null: their type tells.", choices=TASKS)
    threshold: float | None = setting(None, "Threshold of scores. null: 0.4.", within=PROBABILITY)
    iou: float | None = setting(None, "Least intersection over union. null: 0.5.", within=(0.01, 1))
    decode: str | None = setting(
        None,
        "Python function package.module:function from the outputs of the network in a file, such "
        "as ONNX, to boxes, as in nb.Detection.",
    )
    device: str = setting("auto", "auto, cpu, cuda or cuda:N.")


@dataclass
class ModelSettings(Settings):
    """Settings of the architecture of the network to train."""

    name: str = setting(WIDERESNET, "wideresnet, torchvision:NAME or python:module:function.")
    depth: int = setting(16, "Depth of the WideResNet.")
    width: int = setting(4, "Width of the WideResNet.")
    dropout: float = setting(0.3, "Dropout of the WideResNet.", minimum=0, below=1)

    @property
    def shape(self) -> dict[str, Any]:
        """Arguments of `build_network` that build the network. They are stored with its weights."""
        if self.name == WIDERESNET:
            return {"depth": self.depth, "width": self.width, "dropout": self.dropout}
        return {"name": self.name}


@dataclass
class TrainSettings(Settings):
    """Settings of the training of the network. The defaults are those of the paper."""

    epochs: int = setting(150, "Number of passes over the training images.", within=(1, 10**6))
    images_per_epoch: int | None = setting(
        None, "Number of training images, drawn anew for each epoch. null: all.", within=(1, 10**9)
    )
    batch_size: int = setting(128, "Images per training step.", within=(1, 10**6))
    optimizer: str = setting("sgd", "adamw decays neither biases nor norms.", choices=OPTIMIZERS)
    learning_rate: float = setting(0.125, "Highest learning rate.", above=0, maximum=MAX_SCALE)
    feature_norm: float | None = setting(
        None, "Norm of features that this rate is for. null: any norm.", above=0, maximum=MAX_SCALE
    )
    momentum: float = setting(0.9, "Nesterov momentum.", minimum=0, below=1)
    weight_decay: float = setting(5e-4, "Weight decay.", within=(0, MAX_SCALE))
    clip_gradient: float | None = setting(
        None, "Largest norm of the gradient of a batch. null: any.", above=0, maximum=MAX_SCALE
    )
    freeze: str | None = setting(
        None, "Last module that stays as is. all_but_last: only the last layer learns. null: none."
    )
    schedule: str = setting("step", "step: times 0.2 at 30%, 60% and 80%.", choices=SCHEDULES)
    flips: str = setting("random", "Flips of random images, or in alternate epochs.", choices=FLIPS)
    augmentation: str = setting(
        "none",
        "relight: light of a projector. low_light: few photons. relight+low_light: both in turn. "
        "stripes: light of a scanner.",
        choices=("none", *TRANSFORMS, "pgd", *LIGHTS),
    )
    relight_gain: float = setting(
        3.0, "Largest factor of a channel for relight, and 1 / the smallest.", within=(1, 100)
    )
    relight_steps: int = setting(
        0, "Gradient steps that find the factors. 0: random factors.", within=(0, 1000)
    )
    label_smoothing: float = setting(0.0, "Label smoothing.", minimum=0, below=1)
    ranking_weight: float = weight("the loss that ranks `label` above other classes.")
    distillation_weight: float = weight("the divergence from the predictions of `network`.")
    consistency_weight: float = weight("the same divergence on augmented images.")
    interpolate: bool = setting(False, "Mix weights before and after by validation (WiSE-FT).")
    recognize: bool = setting(
        False, "Learn to recognize the light of the augmentation, for network=lit:A+B."
    )
    ema_decay: float = setting(0.0, "Decay of averaged weights. 0: none.", minimum=0, below=1)
    soup: bool = setting(False, "Keep the mean of all epochs, which all start with `network`.")
    eval_mode: bool | None = setting(
        None, "Train with statistics of `network`, no dropout. null: true for other libraries."
    )
    precision: str = setting("auto", "bfloat16, float16, float32, or auto: by the hardware.")
    device: str = setting("auto", "auto, cpu, cuda or cuda:N.")
    threads: int | None = setting(
        None, "CPU threads. null: all cores, or one for small batches.", within=(1, 1024)
    )
    compile: str = setting(
        "auto", "Compile the training step. auto: on one GPU.", choices=("auto", "always", "never")
    )
    deterministic: bool = setting(False, "Compute the same bits every time on a GPU, too.")
    checkpoint_every: int = setting(1, "Epochs between checkpoints.", within=(1, 10**6))
    resume: bool = setting(False, "Resume from the last checkpoint in `out`.")
    cache: str | None = setting("auto", "Folder of rendered data sets. null: none.")

    def __post_init__(self) -> None:
        """Check all values, and that attacked images have a loss."""
        super().__post_init__()
        for name in ("relight_steps", "interpolate"):
            if getattr(self, name) and not self.consistency_weight:
                raise self.wrong(name, "needs a consistency loss: set its weight")
        if self.relight_steps and RELIGHT not in self.augmentation:
            raise self.wrong("relight_steps", "needs the light of a projector: set relight")
        if self.recognize and self.augmentation not in LIGHTS:
            raise self.wrong("recognize", f"needs a light: set augmentation={' or '.join(LIGHTS)}")


@dataclass
class ExperimentSettings(NetworkSettings):
    """Settings of one training run: all settings of the command pnb-train."""

    network: str | None = setting(None, f"Initial network: {NETWORKS}. null: random weights.")
    size: int | None = setting(
        None, "Pixels per side. null: those of the network, or 32.", within=(MIN_SIZE, MAX_SIZE)
    )
    meshes: list[Any] = setting(["solid:orange:0", "solid:orange:1"], MESHES)
    hard_negatives: list[Any] = setting(
        [],
        "Objects of other classes than the label, or of one of several labels. "
        "A mapping {mesh, label} names its class. A file alone is of no class.",
    )
    # The type is str | dict[str, str] | None, which OmegaConf does not support.
    photos: Any = text("Photographs to score: a folder, or {photographs: A, lab: B}.")
    unlabeled: str | None = setting(None, "Folder of photographs to train on, for data=unlabeled.")
    out: str = setting(f"runs/{TIME_FOLDER}", "Folder of the run.")
    sweep: str = setting("runs/sweep", "Folder of the runs of a --multirun.")
    overwrite: bool = setting(False, "Start anew in a folder that holds a run or other results.")
    seed: int = setting(0, "Seed of all random draws.", within=(0, MAX_SEED))
    label: Any = text("Positive class, or several. null: those of meshes or photographs.")
    compare: list[str] = setting([], "Other kinds of renders to train first, for the same table.")
    photographs_first: bool = setting(
        False, "First train with experiment=photographs in a sub-folder, and begin with its result."
    )
    data: DataSettings = setting(DataSettings, "The data set.")
    augment: AugmentationSettings = setting(AugmentationSettings, "The training renders.")
    scene: TrainingSceneSettings = setting(TrainingSceneSettings, "The scene of the renders.")
    renderer: RendererSettings = setting(
        lambda: RendererSettings(samples=8, normals="flat"), "The renderer, by default the paper's."
    )
    model: ModelSettings = setting(ModelSettings, "The architecture. model=NAME sets model.name.")
    train: TrainSettings = setting(TrainSettings, "How the network is trained.")
    evaluate: EvaluationSettings = setting(EvaluationSettings, "What the network is scored on.")

    def __post_init__(self) -> None:
        """Check all values, and compute the number of renders."""
        if self.network == "":
            raise InputError("network is empty: give a run or torchvision:NAME", "network")
        super().__post_init__()
        for name in NEEDS_INITIAL:
            value = getattr(self.train, name)
            if value and not self.network:
                key = f"train.{name}"
                raise InputError(f"{key}={value} needs an initial network: set network", key)
        if self.data.name == UNLABELED and not self.unlabeled:
            raise InputError("unlabeled is not set: give a folder of photographs", "unlabeled")
        folders = self.photos.values() if isinstance(self.photos, dict) else [self.photos or ""]
        if not all(isinstance(folder, str) for folder in folders):
            raise self.wrong("photos", "must be a folder, or a mapping of names to folders")
        reserved = (*RESERVED, *self.compare)
        for name in self.scored_folders:
            # Each name becomes the name of a sub-folder of the run.
            if not re.fullmatch(r"\w[\w-]*", name) or name in reserved:
                advice = f"choose letters, digits, _ and -, and none of {', '.join(reserved)}"
                raise InputError(f"photos has the name {name!r} for a folder: {advice}", "photos")
        renders_meshes = self.augment.renders and self.augment.mode != "folder"
        if renders_meshes:
            prepare_attack(self, self.augment.attack.parameters)
        if self.label is None:
            # The classes of the meshes will become the label when the classes of the network
            # are known. `with_class_names` then creates these settings again.
            return
        # A generated hard negative whose name is a positive class is removed.
        positives = {simplified(name) for name in self.labels}
        self.hard_negatives = [
            item
            for item in self.hard_negatives
            if not (isinstance(item, str) and simplified(solid_name(item)) in positives)
        ]
        if renders_meshes:
            require_range("meshes × views × backgrounds", self.render_count, 1, MAX_EXAMPLES)

    @property
    def labels(self) -> list[str]:
        """Names of the positive classes. Empty if the label is not set."""
        return [] if self.label is None else label_names(self.label)

    @property
    def scored_folders(self) -> dict[str, Path]:
        """Folders of photographs, each with the name of the sub-folder of its scores as a key."""
        named = {PHOTOGRAPHS: self.photos} if isinstance(self.photos, str) else self.photos or {}
        return {str(name): published_folder(Path(folder)) for name, folder in named.items()}

    @property
    def object_count(self) -> int:
        """Number of objects to render: meshes of positive classes, and hard negatives.

        Hard negatives alone are not rendered: without a mesh, the number is 0.
        """
        return len(self.meshes) + len(self.hard_negatives) if self.meshes else 0

    @property
    def views(self) -> int:
        """Number of views of each object: `scene.views`, or as many as the renders need."""
        backgrounds = len(self.scene.backgrounds)
        return self.scene.views or views_of(self.render_count, self.object_count, backgrounds)

    @property
    def render_count(self) -> int:
        """Number of renders: `augment.examples`, or one for each object, view and background."""
        if self.augment.examples is not None:
            return self.augment.examples
        if self.scene.views is None:
            return RENDERS
        return self.scene.views * self.object_count * len(self.scene.backgrounds)

    @property
    def negative_objects(self) -> dict[str, ObjectSettings]:
        """Settings of each hard negative by its key, such as "hard_negatives[0]".

        A hard negative that names no class gets the class "other".
        """
        return read_objects(self.hard_negatives, OTHER, "hard_negatives")

    @property
    def objects(self) -> dict[str, ObjectSettings]:
        """Settings of each mesh and each hard negative by its key, such as "meshes[0]".

        A mesh that names no class is of the positive class if there is one.
        With several positive classes, it is of the class that the name of its
        solid tells: "solid:orange" is an orange.
        """
        labels = self.labels
        default_label = labels[0] if len(labels) == 1 else ""
        # An empty label is unknown, and follows from the name of a solid.
        objects = read_objects(self.meshes, default_label, "meshes") | self.negative_objects
        for key, item in objects.items():
            item.label = solid_name(item.mesh) if item.label == "" else item.label
            if item.label == "":
                raise InputError(f"{key} has no class: give {{mesh, label: CLASS}}", key)
        missing = set(labels) - {item.label for item in objects.values()}
        if missing and len(labels) > 1:
            raise self.wrong("label", f"has no mesh of {min(missing)}: add one to meshes")
        return objects


def prepare_attack(settings: Any, attacked: Collection[str]) -> None:
    """Add to the scene and the renderer in some settings what attacked parameters need."""
    settings.scene = settings.scene.with_lights(attacked)
    # The gradient of an attack on the pose needs the silhouettes of objects.
    if "pose" in attacked:
        settings.renderer = replace(settings.renderer, silhouettes=True)


def read_objects(items: Sequence[Any], label: str, key: str) -> dict[str, ObjectSettings]:
    """Read a list of objects in the settings of a scene.

    Keys are `key` followed by "[0]" and so on. An item without a class gets `label`.
    """
    named = {f"{key}[{index}]": item for index, item in enumerate(items)}
    return {name: read_object(item, label, name) for name, item in named.items()}


def read_object(item: Any, label: str, key: str) -> ObjectSettings:
    """Read one object in the settings of a scene.

    `item` is a file, "solid:NAME", a mapping with fields of `ObjectSettings`, which can have its
    own class, or a list of them on the same ground. Only the first of a list gets `label`.
    """
    return settings_from(ObjectSettings, {"label": label, **as_mapping(item)}, key)


def as_mapping(item: Any) -> dict[str, Any]:
    """Convert a mesh, a mapping or a list to a mapping. A label that is a number becomes a text."""
    first, *others = item or [None] if isinstance(item, list) else [item]
    values = dict(first) if isinstance(first, dict) else {"mesh": first}
    if is_whole(values.get("label")):
        values["label"] = str(values["label"])
    if others:
        values["others"] = [*values.get("others", ()), *map(as_mapping, others)]
    return values


def solid_name(mesh: str) -> str:
    """Return the name of a generated mesh: NAME of "solid:NAME" or "solid:NAME:SEED".

    It is empty for a file.
    """
    kind, *words = mesh.split(":")
    return words[0] if kind == "solid" and words else ""


def simplified(name: str) -> str:
    """Write a name in lower case and NFC, with spaces for "_" and "-", to compare spellings."""
    return " ".join(composed(name).lower().replace("_", " ").replace("-", " ").split())


def in_words(label: str) -> str:
    """Write the label of an object in words: "other_sweet_pepper" becomes "sweet pepper"."""
    return label.removeprefix(OTHER_PREFIX).replace("_", " ")


def in_light(augmentation: str) -> str:
    """Write in words in which light photographs are tested. By default, it is a projector's."""
    return LIGHTS.get(augmentation, LIGHTS[RELIGHT])


def is_of_no_class(label: object) -> bool:
    """Return whether the label of an object names no class: "", "other", or "other_NAME"."""
    return label in (None, "", OTHER) or str(label).startswith(OTHER_PREFIX)


def label_names(label: str | int | Sequence[str | int]) -> list[str]:
    """List the names of the positive classes in the setting `label`.

    There must be a name, and no name twice. A whole number is a name, too.
    """
    listed: Any = [label] if isinstance(label, str) or is_whole(label) else label
    is_list = isinstance(listed, Sequence)
    is_valid = is_list and all(isinstance(item, str) or is_whole(item) for item in listed)
    names = [composed(str(name)) for name in listed] if is_valid else []
    if not names or len(set(names)) < len(names):
        raise InputError(f"label={label}: give a class, or a list of several, each once", "label")
    return names


def published_folder(run: Path) -> Path:
    """Find a path below pretrained/, also if the current folder does not contain pretrained/.

    The library is installed with the folder pretrained/, which has networks and test images. A
    clone of the repository has this folder, too. The result is `run` itself if it exists, or if
    neither has it.
    """
    package = Path(__file__).parent
    is_published = run.parts[:1] == ("pretrained",)
    candidates = [run, package / run, package.parent / run] if is_published else [run]
    return next((path for path in candidates if path.exists()), run)


def dotted(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each value in nested settings with its dotted key, such as "train.epochs"."""
    for key, value in node.items():
        if isinstance(value, dict):
            yield from dotted(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
