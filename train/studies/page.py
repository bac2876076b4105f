"""What the pages of all studies share: how they are joined and written, and the machine that they name."""

import os
import platform
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch


def joined(blocks: Iterable[str]) -> str:
    """A page of Markdown blocks: headings, paragraphs, tables, figures."""
    return "\n\n".join(block.strip() for block in blocks) + "\n"


def write(path: Path, text: str) -> None:
    """Write a page, and say where."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    print(f"written: {path}")


def machine(device: torch.device) -> str:
    """One line: GPU, where that is the device, processor, threads, versions, and how busy the machine was."""
    gpu = f"{torch.cuda.get_device_name(device)}; " if device.type == "cuda" else ""
    threads = torch.get_num_threads()
    versions = f"Python {platform.python_version()}, torch {torch.__version__}, NumPy {np.__version__}"
    load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores at the start"
    return f"{gpu}{_processor()}, {threads} thread{'s' if threads > 1 else ''} of the CPU; {versions}; {load}"


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())
