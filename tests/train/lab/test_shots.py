from functools import partial

import numpy as np
import pytest

from train.lab import shots as lab_shots
from train.lab.patterns import FAMILIES, draw_pattern
from train.lab.shots import FOV, draw_shots

FAMILY_NAMES = list(FAMILIES)


@pytest.fixture(scope="module")
def shots():
    """With coarse patterns."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lab_shots, "draw_pattern", partial(draw_pattern, resolution=8))
        return list(draw_shots(120, FAMILY_NAMES, (0.2, 2.5), seed=3, environments={}))


def test_every_family_has_as_many_setups_evenly_from_dim_to_bright(shots):
    assert [shot.family for shot in shots] == [name for name in FAMILY_NAMES for _ in range(20)]
    for start in range(0, 120, 20):
        brightness = np.array([shot.brightness for shot in shots[start : start + 20]])
        edges = np.geomspace(0.2, 2.5, 21)
        assert (edges[:-1] <= brightness).all() and (brightness <= edges[1:]).all()


def test_shots_follow_from_the_seed_and_differ_from_each_other():
    shots, again, other = (list(draw_shots(12, FAMILY_NAMES, (0.2, 2.5), seed, {})) for seed in (3, 3, 4))
    for shot, same in zip(shots, again, strict=True):
        for name, value in vars(shot).items():
            np.testing.assert_array_equal(value, getattr(same, name), name)
    assert len({tuple(shot.camera) for shot in shots + other}) == 24


def test_the_camera_the_projector_and_the_object_stay_within_their_ranges(shots):
    for shot in shots:
        back, towards = shot.camera - shot.aim, shot.projector - shot.center
        assert 18 <= np.degrees(np.arcsin(back[2] / np.linalg.norm(back))) <= 60
        assert 1.2 <= np.linalg.norm(back) * np.tan(np.radians(FOV / 2)) <= 1.9  # the object fits the view
        assert np.abs(shot.aim - shot.center).max() <= 0.25
        across = towards[:2] @ back[:2] / np.linalg.norm(towards[:2]) / np.linalg.norm(back[:2])
        assert towards[2] > 0 and across >= np.cos(np.radians(70)) - 1e-9  # above, on the camera's side
        np.testing.assert_allclose(shot.rotation @ shot.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(shot.rotation) == pytest.approx(1)  # turned, not mirrored
        assert shot.rotation[2, 2] >= 0.5 - 1e-9  # tilted by at most 60 degrees
        assert shot.ambient.max() <= 0.06 and shot.table.max() <= 0.16
