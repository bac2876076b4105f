"""The picture of an audit page in README.md: the first screen, as Chromium shows it.

    pnb-audit network=run:pretrained/none hardened=run:pretrained/best \\
        meshes=solid:orange laboratory=pretrained/laboratory out=audit
    python -m benchmarks.audit_picture audit/report.html --out docs/audit.png
"""

import argparse
import shutil
from io import BytesIO
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

WIDTH = 1000
HEIGHT = 1060
COLORS = 128  # Colors of the file's palette.


def photograph(page: Path) -> Image.Image:
    """Return the first screen of a page in light mode, `WIDTH` × `HEIGHT` pixels.

    Args:
        page: HTML file.
    """
    with sync_playwright() as playwright:
        # Playwright starts its own Chromium if none is installed.
        chromium = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox"]
        )
        tab = chromium.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        tab.goto(page.resolve().as_uri())
        screenshot = tab.screenshot()
        chromium.close()
    return Image.open(BytesIO(screenshot))


def main() -> None:
    """Write the picture with a small palette."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("page", type=Path, help="page of an audit")
    parser.add_argument("--out", type=Path, default=Path("docs/audit.png"))
    options = parser.parse_args()
    photograph(options.page).convert("RGB").quantize(COLORS).save(options.out, optimize=True)


if __name__ == "__main__":
    main()
