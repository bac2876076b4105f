import re
from pathlib import Path

import trimesh

README = (Path(__file__).parents[1] / "README.md").read_text()


def test_the_readmes_python_runs_and_its_gradients_are_not_zero(tmp_path, monkeypatch):
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    trimesh.creation.icosphere(2).export(tmp_path / "orange.glb")
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(example, names)
    assert names["picture"].shape == (3, len(names["operator"].pixels))
    assert names["light"].grad.any() and names["vertices"].grad.any()
