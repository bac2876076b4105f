"""The documentation site has a page for each public name."""

import re
from collections import Counter
from pathlib import Path

import norm_balls

ROOT = Path(__file__).parents[1]


def test_each_public_name_is_in_one_group_of_the_reference():
    listed = Counter()
    for page in (ROOT / "docs" / "api").glob("*.rst"):
        _, _, names = page.read_text().partition(".. autosummary::")
        listed.update(re.findall(r"^   (\w+)$", names, re.MULTILINE))
    assert listed == Counter(norm_balls.__all__)
