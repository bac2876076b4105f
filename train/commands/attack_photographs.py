"""pnb-attack for photographs: attack a network through the light of a projector on them."""

from pathlib import Path

from renderer.errors import InputError
from train.command_settings import AttackExperimentSettings
from train.device import choose_device
from train.results.overwrite import remove_attack, require_replaceable
from train.results.relit import MODELED, RELIT, attack_folder
from train.run_config import write_config
from train.run_folder import sole_writer
from train.saved_networks import load_chosen
from train.settings import published
from train.system import command_line, shortened
from train.user_errors import keyed, writable_folder

# Warnings about at most 3 unreadable files are printed if --verbose is not set.
MAX_UNREADABLE = 3


def run(settings: AttackExperimentSettings) -> None:
    """Attack a network by the light of a projector on photographs, and print the results."""
    relighting = settings.attack.relighting
    if relighting is None or settings.unlabeled is None:
        raise InputError(
            "attack=relighting needs unlabeled=FOLDER, and unlabeled=FOLDER needs "
            "attack=relighting: set both"
        )
    device = choose_device(settings.device)
    with keyed(name="network"):
        classifier = load_chosen(settings).to(device)
    out = writable_folder(settings.out, "out")
    require_replaceable(out, "out", settings.overwrite)
    with sole_writer("out", out):
        remove_attack(out)
        with keyed("unlabeled"):
            scores = attack_folder(
                classifier,
                published(Path(settings.unlabeled)),
                relighting,
                out,
                sensor_noise=settings.attack.sensor_noise,
                batch_size=settings.attack.batch_size,
                seed=settings.seed,
            )
        write_config(out, settings, command=command_line("attack"))
    print(f"{scores.summary_table()}\n")
    print(f"{MODELED}\n")
    unreadable = [f"warning: {path} cannot be read" for path in scores.unreadable]
    for line in shortened(unreadable, MAX_UNREADABLE):
        print(line)
    print(f"predictions and pictures: {out / RELIT}")
