"""Load the data set that the settings of a run name."""

from renderer.errors import require_choice, require_range
from renderer.settings import MAX_SIZE
from train import console
from train.data.cache import TensorCache, cache_folder
from train.data.rendered_shapes import load_shapes
from train.data.sets import DataSet, load_cifar100, load_folder, load_npz, load_unlabeled
from train.settings import MIN_SIZE, ExperimentSettings
from train.system.processes import main_process_first
from train.system.user_errors import keyed, keys_of
from train.training.initial import Initial

# Pixels per side of images whose size is given neither by data.size nor by the
# initial network.
SIZE = 32
# Values of data.name.
SOURCES = ("cifar100", "npz", "folder", "unlabelled", "shapes")


def load_data(settings: ExperimentSettings, initial: Initial | None = None) -> DataSet:
    """Load the data set of a run.

    Args:
        settings: Settings of the run.
        initial: Network that the run begins with. If data.size is null, the
            images of a folder and rendered solids have the size of its images.
            None for random weights.

    Returns:
        Data set with images of the run's size.

    Raises:
        InputError: If the data cannot be read. The message names the key.
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
    """Load the data set that `name` stands for.

    Args:
        name: A name in `SOURCES`.
        settings: Settings of the run, with the path and the size of the data.
        initial: Network that the run begins with. If the settings give no size,
            the images get the size of its images. None for random weights.
    """
    data = settings.data
    if name == "cifar100":
        return load_cifar100(data.path)
    if name == "npz":
        return load_npz(data.path)
    size = data.size or (initial.size if initial else SIZE)
    if name == "shapes":
        cache = TensorCache(cache_folder(settings.train.cache))
        return load_shapes(data.train_per_class, data.test_per_class, size, data.seed, cache)
    skip = settings.evaluate.skip_unreadable
    if name == "folder":
        return load_folder(data.path, size, data.test_fraction, skip, data.workers)
    return load_unlabeled(data.path, size, data.test_fraction, skip, data.workers)
