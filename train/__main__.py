"""Train a network with and without renders, and score it."""

import hashlib
import re
from collections.abc import Collection, Sequence
from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from train.cli import Command, read_settings
from train.settings import CIRCUMSTANCES
from train.system import import_function

# Largest number of characters of one setting in the name of a folder.
MAX_PART = 48
# Largest number of characters of the name of a folder. File systems allow 255.
MAX_NAME = 200
# Pattern of arguments that set something of Hydra itself, such as "hydra/launcher=...".
HYDRAS_OWN = re.compile(r"\+*hydra[./]")


class TrainCommand(Command):
    """The command pnb-train."""

    def run(self, config: DictConfig) -> None:
        """Train one run. With --multirun, Hydra calls this method for each run."""
        with self.handle_errors():
            job = HydraConfig.get()
            if job.mode == RunMode.MULTIRUN:
                config.out = job.runtime.output_dir
                import_function("train.commands.experiment:run_in_sweep")(config)
                return
            if not config.train.resume:
                # Report mistakes in the settings before the import of the module
                # train.commands.experiment, which takes seconds.
                read_settings(self.kind, config)
            import_function("train.commands.experiment:train")(config, list(job.overrides.task))


def name_model(words: list[str]) -> list[str]:
    """Replace model=NAME, a short form of model.name=NAME, in the command line.

    A mapping as in model={...} stays, because it sets several fields.
    """
    return [re.sub(r"^model=(?!\{)", "model.name=", word) for word in words]


def run_name(overrides: Sequence[str], fixed: Collection[str] = (), parent: str = "") -> str:
    """Name the folder of a run by the settings that the command line gives.

    For the arguments seed=0 and augment=none, the name is
    `augment-none+seed-0@074d413a`. It has the settings in alphabetical order,
    and ends with a hash of them. Characters that are special to file systems or
    to Hydra are replaced by "_". `fixed` settings count in the hash, but are not shown. A folder in
    `parent` with the same hash keeps its name.
    """
    # Settings of Hydra itself, such as hydra.job, and CIRCUMSTANCES do not change the result.
    words = [word.partition("=") for word in overrides if not HYDRAS_OWN.match(word)]
    pairs = sorted((key, value) for key, _, value in words if key not in CIRCUMSTANCES)
    ending = "@" + hashlib.sha256(repr(pairs).encode(errors="surrogatepass")).hexdigest()[:8]
    # The folder of an earlier run with these settings, from which training can continue.
    for known in Path(parent).glob(f"*{ending}") if parent else ():
        return known.name
    shown = [f"{key}-{value}" for key, value in pairs if key not in fixed]
    parts = [re.sub(r"[^\w.-]+", "_", text, flags=re.ASCII)[:MAX_PART] for text in shown]
    return ("+".join(parts) or "run")[:MAX_NAME] + ending


# conf/train.yaml names the folders of a sweep by this function.
OmegaConf.register_new_resolver("run_name", run_name, replace=True)
main = TrainCommand(
    name="train",
    settings="train.settings:ExperimentSettings",
    about=__doc__,
    examples=[
        "pnb-train",
        "pnb-train train.epochs=10 scene.views=5",
        "pnb-train experiment=best network=runs/first",
        "pnb-train --multirun seed=0,1,2",
    ],
    common=[
        *("out", "seed", "label", "network", "train.epochs", "train.batch_size"),
        *("train.learning_rate", "train.device", "augment.examples", "meshes"),
        *("scene.views", "photos"),
    ],
    groups=["experiment", "data", "augment", "attack@augment.attack", "launcher"],
    rewrite=name_model,
    sweep="train.commands.experiment:sweep",
)

if __name__ == "__main__":
    main()
