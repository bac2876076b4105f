"""Settings of training. This module imports neither torch nor NumPy; see `renderer.settings`."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from augment.settings import (
    MAX_EXAMPLES,
    AugmentationSettings,
    ObjectSettings,
    RendererSettings,
    SceneSettings,
    count_views,
    read_normalized_light,
)
from renderer.errors import MAX_SCALE, InputError, describe, is_whole, require_range
from renderer.settings import (
    MAX_SIZE,
    MAX_VIEWS,
    Settings,
    setting,
    setting_like,
    settings_from,
)

# Class of a hard negative for which the classifier has no class.
OTHER = "other"
# Sub-folder of a run with the scores on photographs, if evaluate.photos gives no names.
PHOTOGRAPHS = "photographs"
# Sub-folder of a run with renders that are kept aside from the training.
KEPT_ASIDE = "kept_aside"
# Sub-folder of a run with the scores on the renders that are kept aside.
LABORATORY = "laboratory"
# Number of projected patterns of the renders that are kept aside.
KEPT_ASIDE_PATTERNS = 5
# Names that evaluate.photos must not give to folders, because other sub-folders and
# scores of a run have these names.
RESERVED = ("renders", "test", "before", KEPT_ASIDE)
# Default of model.name.
WIDERESNET = "wideresnet"
# Value of train.freeze with which the last layer alone is trained, as by Kirichenko
# et al. (2023).
ALL_BUT_LAST = "all_but_last"
# Choices of data.name.
DATA_SETS = ("cifar100", "npz", "folder", "unlabelled", "shapes")
# Values of data.name that need data.path.
DATA_SETS_WITH_PATH = ("npz", "folder", "unlabelled")
# Choices of train.schedule.
SCHEDULES = ("step", "cosine", "one_cycle")
# Choices of train.flips.
FLIPS = ("random", "alternating")
# Choices of train.augmentation that are transforms of torchvision.
TRANSFORMS = ("color_jitter", "trivial_augment", "augmix", "color_jitter+augmix")
# Augmentation by the light of a projector; see `train.training.relit_batches`.
RELIGHT = "relight"
# Choices of train.augmentation.
AUGMENTATIONS = ("none", *TRANSFORMS, "pgd", RELIGHT)
# Choices of train.optimizer.
OPTIMIZERS = ("sgd", "adamw")
# Choices of train.compile.
COMPILE = ("auto", "always", "never")
# Columns of photos.csv by which scores are grouped.
GROUPS = ("source", "mesh", "class")
# Pixels per side of the smallest images that can be padded by reflection.
MIN_SIZE = 5
MAX_IMAGES = 10**6
MAX_WORKERS = 1024
MAX_SEED = 2**63 - 1
# Folder that is named by the time at which a command starts.
TIME_FOLDER = "${now:%Y-%m-%d}/${now:%H-%M-%S-%f}"

# Settings that say where and how a run is made. They do not decide its result,
# and the names of the runs of a sweep leave them out.
CIRCUMSTANCES = (
    *("run", "sweep", "out", "device", "launcher", "compare", "command", "working_folder"),
    *("hardware", "versions", "inputs", "test_images", "overwrite", "train.cache"),
    *("train.resume", "train.device", "train.threads", "train.compile", "train.checkpoint_every"),
)
INPUTS = (
    *(
        "data.path",
        "weights",
        "classes",
        "augment.folder",
        "augment.vary.environments",
        "augment.vary.camera.slides",
        "train.init_from",
    ),
    *("scene.meshes", "scene.hard_negatives", "scene.backgrounds", "scene.light"),
    *("classifier", "hardened", "meshes", "hard_negatives", "environments", "photos", "laboratory"),
    "photographs",
)


@dataclass
class DataSettings(Settings):
    """The data set. Each choice of conf/data uses some of these settings."""

    name: str = setting("shapes", "The data set.", choices=DATA_SETS)
    validation: float | None = setting(
        None,
        "Fraction of the training images of each class to validate on. "
        "null: what train.init_from left out, otherwise 0.1.",
    )
    path: str = setting("", "File or folder of the data.", may_be_empty=True)
    size: int | None = setting(
        None,
        "Pixels per side. null: the size of train.init_from, otherwise 32.",
        minimum=MIN_SIZE,
        maximum=MAX_SIZE,
    )
    test_fraction: float = setting(
        0.1,
        "Fraction of the images to test on, if the folder has no sub-folder `test`: "
        "of each class, or of photographs without labels 1,000 at most.",
    )
    workers: int = setting(
        2,
        "Processes that read images larger than 64 pixels per side, which stay on disk.",
        minimum=0,
        maximum=MAX_WORKERS,
    )
    train_per_class: int = setting(
        300,
        "Training images per class of shapes.",
        minimum=1,
        maximum=MAX_IMAGES,
    )
    test_per_class: int = setting(
        60,
        "Test images per class of shapes.",
        minimum=1,
        maximum=MAX_IMAGES,
    )
    seed: int = setting(0, "Seed of the shapes.", minimum=0, maximum=MAX_SEED)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.name in DATA_SETS_WITH_PATH and not self.path:
            raise InputError(f"path is not set: give the path of the data={self.name}", "path")


@dataclass
class TrainingSceneSettings(SceneSettings):
    """The scene of the renders: by default, the paper's two meshes in front of five backgrounds."""

    meshes: list[Any] = setting_like(SceneSettings, "meshes", ["solid:orange:0", "solid:orange:1"])
    backgrounds: list[Any] = setting_like(SceneSettings, "backgrounds", [0.0, 0.25, 0.5, 0.75, 1.0])
    views: int | None = setting(
        None,
        "Number of cameras per mesh, at equal azimuths. null: as many as augment.examples needs.",
        minimum=1,
        maximum=MAX_VIEWS,
    )
    hard_negatives: list[Any] = setting(
        [],
        "Objects of other classes than the label, or of one of several labels. "
        "A mapping {mesh, label} names its class. A file alone is of no class.",
    )

    @property
    def objects(self) -> int:
        """Count the meshes and the hard negatives. Return 0 without a mesh."""
        return len(self.meshes) + len(self.hard_negatives) if self.meshes else 0


@dataclass
class ModelSettings(Settings):
    """The network to train."""

    name: str = setting(
        WIDERESNET,
        "wideresnet, torchvision:NAME or python:package.module:function.",
    )
    depth: int = setting(16, "Depth of the WideResNet.")
    width: int = setting(4, "Width of the WideResNet.")
    dropout: float = setting(0.3, "Dropout of the WideResNet.")

    @property
    def shape(self) -> dict[str, Any]:
        """Return the arguments of the network's constructor. They are stored with its weights."""
        if self.name == WIDERESNET:
            return {"depth": self.depth, "width": self.width, "dropout": self.dropout}
        return {"name": self.name}


@dataclass
class TrainSettings(Settings):
    """Training of the network. The defaults are the recipe of the paper."""

    init_from: str | None = setting(
        None,
        "Network with whose weights the training starts: a run folder, a network's file, or a "
        "classifier: efficientnet_lite0, torchvision:NAME, timm:NAME or "
        "python:package.module:function. null: random weights.",
    )
    epochs: int = setting(
        150,
        "Number of passes over the training images.",
        minimum=1,
        maximum=10**6,
    )
    images_per_epoch: int | None = setting(
        None,
        "Number of training images, drawn anew for each epoch. null: all.",
        minimum=1,
        maximum=10**9,
    )
    batch_size: int = setting(128, "Images per training step.", minimum=1, maximum=10**6)
    accumulation_steps: int = setting(
        1,
        "Number of parts into which each batch is divided to save memory.",
        minimum=1,
        maximum=10**6,
    )
    optimizer: str = setting(
        "sgd",
        "Optimizer. adamw decays no biases and norms.",
        choices=OPTIMIZERS,
    )
    learning_rate: float = setting(0.125, "Highest learning rate.", above=0, maximum=MAX_SCALE)
    momentum: float = setting(0.9, "Nesterov momentum.", minimum=0, below=1)
    weight_decay: float = setting(5e-4, "Weight decay.", minimum=0, maximum=MAX_SCALE)
    clip_gradient: float | None = setting(
        None, "Largest norm of the gradient of a batch. null: any.", above=0, maximum=MAX_SCALE
    )
    freeze: str | None = setting(
        None,
        "Name of the last module of the network that stays as it is. "
        "all_but_last: only the last layer learns. null: all layers learn.",
    )
    schedule: str = setting(
        "step",
        "Schedule of the learning rate. step: times 0.2 at 30%, 60% and 80% of the training.",
        choices=SCHEDULES,
    )
    flips: str = setting(
        "random",
        "Horizontal flips: half of the images at random, or each image in every other epoch "
        "(alternating).",
        choices=FLIPS,
    )
    augmentation: str = setting(
        "none",
        "Augmentation of every training image. relight: the light of a projector with random "
        "slides.",
        choices=AUGMENTATIONS,
    )
    relight_gain: float = setting(
        3.0,
        "Largest factor of a channel of a slide for augmentation=relight. Its inverse is the "
        "smallest.",
        minimum=1,
        maximum=100,
    )
    relight_steps: int = setting(
        0,
        "Steps along the gradient that find these factors. 0: random factors.",
        minimum=0,
        maximum=1000,
    )
    label_smoothing: float = setting(0.0, "Label smoothing.", minimum=0, below=1)
    ranking_weight: float = setting(
        0.0,
        "Weight of the loss that ranks the images of `label` in a batch above the others.",
        minimum=0,
        maximum=MAX_SCALE,
    )
    distillation_weight: float = setting(
        0.0,
        "Weight of the divergence from the predictions of the network train.init_from. "
        "On renders, this counts classes other than `label`.",
        minimum=0,
        maximum=MAX_SCALE,
    )
    consistency_weight: float = setting(
        0.0,
        "Weight of the divergence of the predictions for augmented images from those of the "
        "network train.init_from for the same images without augmentation.",
        minimum=0,
        maximum=MAX_SCALE,
    )
    interpolate: bool = setting(
        False,
        "At the end, interpolate between the weights of train.init_from and the trained weights, "
        "by the factor with the lowest loss on unchanged and relit validation images (WiSE-FT).",
    )
    ema_decay: float = setting(
        0.0,
        "Decay of the moving average of the weights, which is validated and kept. 0: none.",
        minimum=0,
        below=1,
    )
    soup: bool = setting(
        False,
        "Start each epoch with train.init_from again, and keep the mean of the networks of all "
        "epochs (a model soup).",
    )
    eval_mode: bool | None = setting(
        None,
        "Train in evaluation mode: with the running statistics of train.init_from and without "
        "dropout. null: only a third-party classifier.",
    )
    precision: str = setting(
        "auto",
        "Precision of the training. auto: bfloat16 if the hardware computes in it, otherwise "
        "float16 on a GPU and float32 on a CPU, where depthwise convolutions always take float32.",
    )
    device: str = setting("auto", "auto, cpu, cuda or cuda:N.")
    threads: int | None = setting(
        None,
        "CPU threads, on which the last bits depend. "
        "null: all cores that the process may use, or one for small batches.",
        minimum=1,
        maximum=1024,
    )
    compile: str = setting(
        "auto",
        "Compile the training step. auto: CUDA graphs on one GPU.",
        choices=COMPILE,
    )
    deterministic: bool = setting(
        False,
        "Compute the same bits every time on a GPU, which is slower. The results of a CPU always "
        "repeat.",
    )
    checkpoint_every: int = setting(
        1,
        "Epochs between two checkpoints. A single process also writes one about every minute.",
        minimum=1,
        maximum=10**6,
    )
    resume: bool = setting(
        False,
        "Resume from the last checkpoint in `run`. run=FOLDER train.resume=true is enough.",
    )
    cache: str | None = setting(
        "auto",
        "Folder of rendered data sets and predictions. auto: ~/.cache/parametric-norm-balls. "
        "null: none.",
    )

    def __post_init__(self) -> None:
        if self.init_from == "":
            raise InputError(
                "init_from is not set: give a run folder, or torchvision:NAME with weights=FILE",
                "init_from",
            )
        super().__post_init__()
        if (self.distillation_weight or self.soup or self.eval_mode) and not self.init_from:
            raise InputError(
                "distillation_weight, soup and eval_mode need a network to begin with: "
                "set init_from",
            )
        if (self.consistency_weight or self.interpolate) and not self.init_from:
            raise InputError(
                "consistency_weight and interpolate need a network to begin with: set init_from",
            )
        if self.relight_steps and not self.consistency_weight:
            raise InputError(
                "relight_steps attacks the predictions of the network init_from: "
                "set consistency_weight",
                "relight_steps",
            )


@dataclass
class EvaluationSettings(Settings):
    """Settings of the photographs on which the trained network is scored.

    Its scores on the test set are computed in any case.
    """

    # OmegaConf has no type for str | dict[str, str] | None.
    photos: Any = setting(
        None,
        "Folder of photographs: a folder per class, or images of `label`. "
        "Several folders: {photographs: A, lab: B}. null: none.",
        is_text=True,
    )
    skip_unreadable: bool = setting(False, "Skip photographs that cannot be read.")
    laboratory_setups: int = setting(
        0,
        "If photos is null: number of draws of light and camera of path-traced renders that are "
        "kept aside, of other instances and patterns than in training. Both networks are scored "
        "on them. A multiple of 5. 0: none.",
        minimum=0,
        maximum=MAX_IMAGES,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.laboratory_setups % KEPT_ASIDE_PATTERNS:
            raise InputError(
                f"laboratory_setups={self.laboratory_setups} "
                f"must be a multiple of the {KEPT_ASIDE_PATTERNS} patterns",
                "laboratory_setups",
            )
        photos = self.photos
        is_mapping = isinstance(photos, dict)
        is_mapping = is_mapping and all(isinstance(folder, str) for folder in photos.values())
        if not (photos is None or isinstance(photos, str) or is_mapping):
            raise InputError(
                f"photos={photos} must be a folder, or a mapping of names to folders",
                "photos",
            )
        for name in self.folders:
            if not re.fullmatch(r"\w[\w-]*", name) or name in RESERVED:
                raise InputError(
                    f"photos: {name} must be "
                    f"a name of letters, digits, _ and -, not one of {RESERVED}",
                    "photos",
                )

    @property
    def folders(self) -> dict[str, Path]:
        """Return the folders of photographs by the name of the sub-folder with their scores."""
        named = self.photos if isinstance(self.photos, dict) else {}
        if isinstance(self.photos, str):
            named = {PHOTOGRAPHS: self.photos}
        return {str(name): published(Path(folder)) for name, folder in named.items()}


@dataclass(kw_only=True)
class NetworkSettings(Settings):
    """Weights, classes, image size and normalization of a user's own network."""

    weights: str | None = setting(
        None,
        "File of the classifier's weights: a state dict or a checkpoint, with any number of "
        "classes. null: its own weights, or a download.",
    )
    classes: Any = setting(
        None,
        "Names of the classifier's classes in the order of its outputs: a text file with a name "
        "in each line, or [a,b]. null: the names that its source knows, otherwise 0, 1 and so on.",
        is_text=True,
    )
    normalization: Any = setting(
        None,
        "Normalization before the classifier: imagenet, or [MEAN,STD] of red, green and blue in "
        "units of [0, 1], such as [[0,0,0],[1,1,1]] for none. null: that of its source, and none "
        "before a file's network.",
        is_text=True,
    )
    normalize_light: Any = setting(
        None,
        "Normalize the light of each image before the network sees it: true, or "
        "{white_balance, percentile, level, gamma}. A training sees such images, too, and its "
        "network remembers it. null: as the network does. This is not `normalization`.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.classes = class_texts(self.classes)
        self.normalize_light = normalized_light_values(self.normalize_light)


def normalized_light_values(value: Any) -> dict[str, float] | None:
    """Read a value of the setting `normalize_light`.

    Args:
        value: True, a mapping of some fields of normalized light, or None.

    Returns:
        All fields by name, as files record them. None without normalized light.
    """
    light = read_normalized_light(value)
    return None if light is None else asdict(light)


def class_texts(classes: Any) -> Any:
    """Convert class names that YAML has read as numbers, such as 0, to texts.

    Args:
        classes: A list of names and whole numbers. Other values are returned
            unchanged.
    """
    if not isinstance(classes, list):
        return classes
    return [str(name) if is_whole(name) else name for name in classes]


@dataclass
class ExperimentSettings(NetworkSettings):
    """Settings of one training run, which the command `pnb-train` reads from Hydra."""

    run: str = setting(f"runs/{TIME_FOLDER}", "Folder of the run.")
    sweep: str = setting(
        "runs/sweep",
        "Folder of the runs of a --multirun, each named by its overrides.",
    )
    overwrite: bool = setting(False, "Start anew in a folder that holds a run or other results.")
    seed: int = setting(0, "Seed of all random draws.", minimum=0, maximum=MAX_SEED)
    label: Any = setting(  # str | list[str], for which OmegaConf has no type
        "orange",
        "Positive class: the class of the meshes, whose recall and false positives are measured. "
        "Or several: [orange, apple]. null: the classes that scene.meshes name.",
        is_text=True,
    )
    compare: list[str] = setting(
        [], "Other kinds of renders to train first, in sub-folders, and to show in the same table."
    )
    photographs_first: bool = setting(
        False,
        "First train with experiment=photographs, in the sub-folder `photographs`, and begin with "
        "its result instead of train.init_from.",
    )
    data: DataSettings = setting(DataSettings, "The data set.")
    augment: AugmentationSettings = setting(
        AugmentationSettings,
        "The renders among the training images.",
    )
    scene: TrainingSceneSettings = setting(TrainingSceneSettings, "The scene of the renders.")
    renderer: RendererSettings = setting(
        lambda: RendererSettings(samples=8, normals="flat"),
        "How images are rendered. The defaults are the paper's.",
    )
    model: ModelSettings = setting(
        ModelSettings,
        "The network. model=NAME is short for model.name=NAME.",
    )
    train: TrainSettings = setting(TrainSettings, "How the network is trained.")
    evaluate: EvaluationSettings = setting(
        EvaluationSettings,
        "What the trained network is scored on.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.label is None:  # The objects are known when the meshes have named their classes.
            return
        self._remove_generated_positives()
        if self.augment.renders and self.augment.mode != "folder":
            if "pose" in self.augment.attack.parameters and not self.renderer.silhouettes:
                raise InputError(
                    "renderer.silhouettes=false: "
                    "an attack on the pose needs renderer.silhouettes=true",
                    "renderer.silhouettes",
                )
            backgrounds = len(self.scene.backgrounds)
            self.augment.examples = self.views * self.scene.objects * backgrounds
            product = "meshes × views × backgrounds"
            require_range(product, self.augment.examples, 1, MAX_EXAMPLES)

    def _remove_generated_positives(self) -> None:
        """Remove hard negatives that show a positive class.

        For the label orange, "solid:orange" is removed. A hard negative in the
        form of a mapping names its own class, and is kept.
        """
        names = {simplified(name) for name in label_names(self.label)}
        self.scene.hard_negatives = [
            item
            for item in self.scene.hard_negatives
            if not (isinstance(item, str) and simplified(solid_name(item)) in names)
        ]

    @property
    def views(self) -> int:
        """Count the views of each mesh with `count_views`."""
        scene = self.scene
        backgrounds = len(scene.backgrounds)
        try:
            return count_views(self.augment.examples, scene.objects, backgrounds, scene.views)
        except InputError as error:
            key = "augment" if error.argument == "examples" else "scene"
            raise error.within(key, [error.argument]) from None

    @property
    def hard_negatives(self) -> dict[str, ObjectSettings]:
        """Return the settings of each hard negative of the scene by its key.

        A hard negative that names no class gets the class OTHER.
        """
        return read_objects(self.scene.hard_negatives, OTHER, "scene.hard_negatives")

    @property
    def objects(self) -> dict[str, ObjectSettings]:
        """Return the settings of each mesh and each hard negative of the scene by its key.

        A mesh that names no class gets the label of the run if the run has one
        label. Otherwise it gets the name of its solid.
        """
        labels = label_names(self.label)
        label = labels[0] if len(labels) == 1 else ""
        meshes = read_objects(self.scene.meshes, label, "scene.meshes")
        negatives = self.hard_negatives
        for key, item in (meshes | negatives).items():
            item.label = item.label or solid_name(item.mesh)
            if not item.label:
                raise InputError(
                    f"{key} must name its class: give {{mesh: {item.mesh}, label: CLASS}}",
                    key,
                )
        named = {item.label for item in (*meshes.values(), *negatives.values())}
        missing = set(labels) - named
        if missing and len(labels) > 1:
            raise InputError(
                f"label={self.label} has no mesh of {min(missing)}: name one in scene.meshes",
                "label",
            )
        return meshes | negatives


def read_objects(items: Sequence[Any], label: str, key: str) -> dict[str, ObjectSettings]:
    """Read a list of objects in the settings of a scene.

    Args:
        items: Each is a file, a solid, or a mapping with fields of
            `ObjectSettings`.
        label: Default class, for the objects that name no class.
        key: Key of the list in the settings, such as "scene.meshes".

    Returns:
        The settings of each object. Its key is the key of the list with the
        position of the object, such as "scene.meshes[0]".
    """
    objects = {}
    for index, item in enumerate(items):
        name = f"{key}[{index}]"
        objects[name] = read_object(item, label, name)
    return objects


def read_object(item: Any, label: str, key: str) -> ObjectSettings:
    """Read one object.

    Args:
        item: A file, a solid, or a mapping with fields of `ObjectSettings`.
        label: Default class, which is used if the object names no class.
        key: Key of the object, for errors.

    Returns:
        The object.

    Raises:
        InputError: If the mapping is wrong.
    """
    values = item if isinstance(item, dict) else {"mesh": item}
    values = {"label": label, **values}
    if is_whole(values["label"]):  # YAML takes the name of a digit for a number
        values["label"] = str(values["label"])
    return settings_from(ObjectSettings, values, key)


def solid_name(mesh: str) -> str:
    """Return the NAME of solid:NAME or solid:NAME:SEED, and "" for a file."""
    # The empty text is the name if `mesh` has no colon.
    kind, name, *_ = [*mesh.split(":"), ""]
    return name if kind == "solid" else ""


def simplified(name: str) -> str:
    """Return a name in lower case, in which "_" and "-" are spaces.

    Args:
        name: Name of a class, a solid or a file.

    Returns:
        Name for comparisons.

    >>> simplified("Sweet_pepper")
    'sweet pepper'
    """
    return " ".join(name.lower().replace("_", " ").replace("-", " ").split())


def label_names(label: str | int | Sequence[str | int]) -> list[str]:
    """List the positive classes.

    Args:
        label: The name of a class, or several. A name may be given as a number.

    Returns:
        The names.

    Raises:
        InputError: If there is none, or one is named twice.

    >>> label_names("orange")
    ['orange']
    """
    listed = [label] if isinstance(label, str) or is_whole(label) else label
    expected = "the name of a class, or several"
    if not isinstance(listed, Sequence):
        raise InputError(f"label is {describe(label)}: give {expected}", "label")
    for name in listed:
        if not (isinstance(name, str) or is_whole(name)):
            raise InputError(f"label holds {describe(name)}: give {expected}", "label")
    names = [str(name) for name in listed]
    if not names or len(set(names)) < len(names):
        raise InputError(
            f"label=[{', '.join(names)}] must name a class, or several, each once",
            "label",
        )
    return names


def published(run: Path) -> Path:
    """Find a network or a folder of the installation.

    Args:
        run: A path. If it does not exist and begins with pretrained/, the file
            or folder of this name in the installation, or in the clone of the
            repository, is used.

    Returns:
        The path that exists. `run` itself if none exists.
    """
    candidates = [run]
    if run.parts[:1] == ("pretrained",):
        candidates += [home / run for home in Path(__file__).parents[:2]]
    return next((path for path in candidates if path.exists()), run)


def dotted(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of nested settings with their dotted keys.

    Args:
        node: Settings as nested dictionaries.
        prefix: Text before each key, such as "train.".

    Yields:
        Pairs such as ("train.epochs", 150).
    """
    for key, value in node.items():
        if isinstance(value, dict):
            yield from dotted(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def mapped(value: Any, change: Callable[[str], str]) -> Any:
    """Return a copy of nested settings in which each text is changed.

    Args:
        value: A text, or nested mappings and lists of texts and other values.
        change: Function that returns the new text for a text. Keys of mappings
            and values that are no text stay the same.
    """
    if isinstance(value, dict):
        return {key: mapped(item, change) for key, item in value.items()}
    if isinstance(value, list):
        return [mapped(item, change) for item in value]
    return change(value) if isinstance(value, str) else value
