"""Convert linear RGB colors of other primaries to those of this project, Rec. 709 with D65."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

# CIE 1931 chromaticities x and y of red, green, blue and white (ITU-R BT.709).
REC_709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
# Chromaticities that differ by at most this are those of Rec. 709, rounded.
ROUNDING = 1e-3
# Primaries of cameras are at most 1.5. Larger numbers may be percentages.
LARGEST = 2
# Matrix from XYZ to the responses of cones in Bradford's chromatic adaptation
# (ICC.1:2022, annex E).
BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def to_rec709(chromaticities: Sequence[float], adapt: bool) -> Float[np.ndarray, "3 3"] | None:
    """Compute the matrix from linear RGB of other primaries to Rec. 709.

    The chromaticities are CIE x and y of red, green, blue and white. `adapt` maps white to white,
    as for photographs (Bradford). Otherwise each light keeps its chromaticity, as for radiance.
    None stands for Rec. 709.
    """
    given = np.asarray(chromaticities, dtype=np.float64)
    if given.shape == (8,) and np.abs(given - REC_709).max() <= ROUNDING:
        return None
    error = ValueError(f"the primaries {given.tolist()} span no colors")
    if np.abs(given).max(initial=0) > LARGEST:
        raise error
    try:
        theirs = BRADFORD @ _to_xyz(given)
    except (ValueError, np.linalg.LinAlgError):
        raise error from None
    ours = BRADFORD @ _to_xyz(np.array(REC_709))
    if adapt:
        # The sum over the primaries is the response of the cones to white.
        theirs = np.diag(ours.sum(axis=1) / theirs.sum(axis=1)) @ theirs
    matrix: np.ndarray = np.linalg.inv(ours) @ theirs
    if not (np.abs(matrix) < 100).all():
        raise error
    return matrix


def _to_xyz(chromaticities: np.ndarray) -> np.ndarray:
    """Compute the matrix from linear RGB to XYZ, in which white has Y = 1."""
    x, y = chromaticities.reshape(4, 2).T
    with np.errstate(divide="ignore", invalid="ignore"):
        xyz = np.stack([x, y, 1 - x - y])
        white = xyz[:, 3] / y[3]
    return xyz[:, :3] * np.linalg.solve(xyz[:, :3], white)
