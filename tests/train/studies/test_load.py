import signal
import sys

import numpy as np
import pytest

from renderer.mesh import load_mesh
from train.studies.load import loads
from train.studies.load.observed import observe
from train.studies.load.study import LoadSettings, run


@pytest.mark.parametrize("count", [2, 1000, 30_000])
def test_a_sphere_has_about_as_many_faces_as_asked_for(tmp_path, count):
    assert loads.faces(tmp_path, count)[-1] == "scene.meshes=[sphere.ply]"
    mesh = load_mesh(tmp_path / "sphere.ply")
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1, rtol=1e-6)
    assert len(mesh.faces) == pytest.approx(count, rel=0.1, abs=100)


def test_a_command_is_observed_on_a_terminal_to_its_end_and_until_ctrl_c(tmp_path):
    talks = (
        "import sys, time; full = b'x' * 10**8; time.sleep(0.3); print(' 50%|###  |');"
        "print(sys.stderr.isatty(), file=sys.stderr); sys.exit(3)"
    )
    whole = observe(["-c", talks], tmp_path, patience=60)
    assert (whole.status, whole.said, whole.progress) == (3, "True", True) and whole.memory > 10**8
    bar = observe(["-c", "from tqdm import tqdm; [*tqdm(range(9))]"], tmp_path, patience=60)
    assert bar.progress and 0 < bar.memory < whole.memory
    waits = observe(["-c", "while True: pass"], tmp_path, patience=1)
    assert waits.status == 128 + signal.SIGINT and 1 <= waits.cpu < 60 and 0 < waits.after_signal < 60


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="no terminals")
def test_the_study_writes_its_page(tmp_path):
    assert run(LoadSettings(str(tmp_path / "page.md"), 100, 100, 10**5, 300, 20, 60)) == []
    assert (tmp_path / "page.md").read_text().count("| as asked |") == 5
