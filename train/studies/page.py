"""What the pages of all studies share: how they are joined and written, and the machine that they name."""

import os
import platform
import re
from collections.abc import Iterable
from pathlib import Path
from textwrap import fill

import numpy as np
import torch

AS_THEY_ARE = ("#", "|", "!", "```")  # headings, tables, figures and code


def joined(blocks: Iterable[str]) -> str:
    """A page of Markdown blocks: headings, paragraphs, tables, figures; empty ones are left out."""
    return "\n\n".join(block.strip() for block in blocks if block) + "\n"


def filled(module: str, **values: object) -> str:
    """The Markdown beside a module's file, with values in its braces."""
    return Path(module).with_suffix(".md").read_text(encoding="utf-8").format(**values).strip()


def wrapped(text: str) -> str:
    """Markdown whose paragraphs and lists have lines of at most 120 characters."""
    return "\n\n".join(
        block if block.startswith(AS_THEY_ARE) else "\n".join(map(_filled, re.split("\n(?=- )", block)))
        for block in text.split("\n\n")
    )


def _filled(paragraph: str) -> str:
    hanging = "  " if paragraph.startswith("- ") else ""
    return fill(
        " ".join(paragraph.split()), 120, subsequent_indent=hanging, break_long_words=False, break_on_hyphens=False
    )


def with_section(page: str, section: str) -> str:
    """The page with a section in place of the one of the same heading or, where there is none, at its end."""
    heading, new = section.partition("\n")[0], f"{section.strip()}\n\n"
    pattern = re.compile(rf"^{re.escape(heading)}\n.*?(?=^## |\Z)", re.M | re.S)
    text, found = pattern.subn(lambda _: new, page, count=1)
    return joined([text] if found else [page, new])


def write(path: Path | None, text: str) -> None:
    """Print a page, which is not lost then where it cannot be written, and write it where a path says."""
    print(text)
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    print(f"written: {path}")


def write_section(path: Path, section: str) -> None:
    """`write` a page with a section in place of the one of the same heading; a page that is new is on performance."""
    page = path.read_text("utf-8") if path.is_file() else "# Performance\n"
    write(path, with_section(page, section))


def machine(device: torch.device) -> str:
    """One line: GPU, where that is the device, processor, threads, versions, and how busy the machine was."""
    gpu = f"{torch.cuda.get_device_name(device)}; " if device.type == "cuda" else ""
    threads = torch.get_num_threads()
    made = f"Python {platform.python_version()}, torch {torch.__version__}, NumPy {np.__version__}"
    load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores at the start"
    return f"{gpu}{_processor()}, {threads} thread{'s' if threads > 1 else ''} of the CPU; {made}; {load}"


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())


def versions() -> str:
    """What the numbers were made with, as a sentence."""
    return (
        f"Made with torch {torch.__version__} and NumPy {np.__version__} on {platform.machine()}, "
        f"{torch.get_num_threads()} threads."
    )
