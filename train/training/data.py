"""Load the data set that the settings of a run name."""

from renderer.errors import require_choice, require_range
from renderer.settings import MAX_SIZE
from train import console
from train.data.cache import TensorCache, cache_folder
from train.data.rendered_shapes import load_shapes
from train.data.sets import DataSet, load_cifar100, load_folder, load_npz, load_unlabeled
from train.processes import main_process_first
from train.settings import MIN_SIZE, ExperimentSettings
from train.system.user_errors import keyed, keys_of
from train.training.initial import Initial

# Pixels per side of the images if neither the setting data.size nor the network with
# whose weights a run begins gives a size.
SIZE = 32
# Values of the setting data.name.
SOURCES = ("cifar100", "npz", "folder", "unlabelled", "shapes")


def load_data(settings: ExperimentSettings, initial: Initial | None = None) -> DataSet:
    """Load the data set of a run.

    Without a size in the settings, the images get the size that `initial` takes.
    """
    name = settings.data.name
    require_choice("data.name", name, SOURCES)
    console.debug("data: %s", name)
    with main_process_first(), keyed(**keys_of("data", settings.data)):
        data = _load(name, settings, initial)
    with keyed("data.path"):
        require_range("image size", data.size, MIN_SIZE, MAX_SIZE)
    return data


def _load(name: str, settings: ExperimentSettings, initial: Initial | None) -> DataSet:
    """Load a data set by its name."""
    data = settings.data
    if name == "cifar100":
        return load_cifar100(data.path)
    if name == "npz":
        return load_npz(data.path)
    size = data.size or (initial.size if initial else SIZE)
    if name == "shapes":
        cache = TensorCache(cache_folder(settings.train.cache))
        return load_shapes(
            train=data.train_per_class,
            test=data.test_per_class,
            size=size,
            seed=data.seed,
            cache=cache,
        )
    load_images = load_folder if name == "folder" else load_unlabeled
    return load_images(
        data.path,
        size=size,
        test_fraction=data.test_fraction,
        skip_unreadable=settings.evaluate.skip_unreadable,
        workers=data.workers,
    )
