"""Figures on disk. Needs matplotlib."""

from pathlib import Path

from renderer.errors import InputError


def pyplot():
    """matplotlib.pyplot without a display; InputError where it is not installed."""
    try:
        import matplotlib
    except ImportError as error:
        raise InputError("matplotlib is not installed: pip install '.[benchmark]'") from error
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    return plt


def save(figure, path: Path, dpi: int = 110) -> None:
    """Write the figure and let go of it."""
    figure.savefig(path, dpi=dpi)
    pyplot().close(figure)
