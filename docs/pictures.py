"""Style of the pictures in the gallery, and how they are saved."""

import matplotlib.pyplot as plt
import torch
from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst


def set_style(gallery_conf: dict[str, object], name: str) -> None:
    """Set the style of the pictures in the gallery: rows of images without axes."""
    torch.set_num_threads(1)
    plt.rcdefaults()
    style = {
        "figure.constrained_layout.use": True,
        "figure.figsize": (8, 2.2),
        "font.size": 9,
        "image.interpolation": "nearest",
        "xtick.bottom": False,
        "ytick.left": False,
    }
    for side in ("bottom", "left", "right", "top"):
        style[f"axes.spines.{side}"] = False
    plt.rcParams.update(style)


def save_figures(block: object, variables: dict, gallery_conf: dict[str, object]) -> str:
    """Save the figures of a script, also those that `AttackResult.plot` returned."""
    paths = []
    figures = [plt.figure(number) for number in plt.get_fignums()]
    figure = variables["example_globals"].get("figure")
    if isinstance(figure, Figure) and figure not in figures:
        figures.append(figure)
    for drawn in figures:
        paths.append(next(variables["image_path_iterator"]))
        drawn.savefig(paths[-1])
    plt.close("all")
    return figure_rst(paths, gallery_conf["src_dir"])
