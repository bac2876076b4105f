"""The data set that a run's settings name."""

from renderer.errors import require_choice, require_range
from renderer.settings import MAX_SIZE
from train import console
from train.data.cache import TensorCache, cache_folder
from train.data.rendered_shapes import load_shapes
from train.data.sets import DataSet, load_cifar100, load_folder, load_npz, load_unlabeled
from train.settings import MIN_SIZE, ExperimentSettings
from train.system.processes import first_process_first
from train.system.user_errors import keyed, keys_of, renamed

# Pixels per side of the images of a folder, where neither data.size nor the network begun with
# says it.
SIZE = 32
SOURCES = ("cifar100", "npz", "folder", "unlabelled", "shapes")


def load_data(settings: ExperimentSettings, size: int | None = None) -> DataSet:
    """Load the data set of a run.

    Args:
        settings: The settings of the run.
        size: The pixels per side of the images that the run's network takes, if it begins with
            a trained one. The images of a folder and rendered solids take this size.

    Returns:
        The data set.

    Raises:
        InputError: The data cannot be had. The message names the key.
    """
    name = settings.data.name
    require_choice("data.name", name, SOURCES)
    console.info("data: %s", name)
    with first_process_first(), renamed(**keys_of("data", settings.data)):
        data = _load(name, settings, size)
    with keyed("data.path"):
        require_range("image size", data.size, MIN_SIZE, MAX_SIZE)
    return data


def _load(name: str, settings: ExperimentSettings, network_size: int | None) -> DataSet:
    """Load the data set of a name, one of SOURCES."""
    data = settings.data
    if name == "cifar100":
        return load_cifar100(data.path)
    if name == "npz":
        return load_npz(data.path)
    size = data.size or network_size or SIZE
    if name == "shapes":
        cache = TensorCache(cache_folder(settings.train.cache))
        return load_shapes(data.train_per_class, data.test_per_class, size, data.seed, cache)
    skip = settings.evaluate.skip_unreadable
    if name == "folder":
        return load_folder(data.path, size, data.test_fraction, skip, data.workers)
    return load_unlabeled(data.path, size, data.test_fraction, skip, data.workers)
