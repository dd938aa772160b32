"""The two-view geometry that COLMAP's own matcher would write for given matches."""

from __future__ import annotations

import numpy as np
import pycolmap
from numpy.typing import NDArray


def verify(
    cameras: tuple[pycolmap.Camera, pycolmap.Camera],
    places: tuple[NDArray[np.float32], NDArray[np.float32]],
    matches: NDArray[np.uint32],
    seed: int = 0,
) -> pycolmap.TwoViewGeometry:
    """Return configuration, F, E, H and inliers; without any where too few matches agree.

    Args:
        cameras: of both photos.
        places: (N, 2) x, y of both photos' features, pixels.
        matches: (M, 2) features that match.
        seed: of the robust estimation.
    """
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    none = pycolmap.TwoViewGeometry()
    none.config = pycolmap.TwoViewGeometryConfiguration.DEGENERATE
    if len(matches) < options.min_num_inliers:
        return none
    found = pycolmap.estimate_two_view_geometry(
        cameras[0], places[0], cameras[1], places[1], matches, options
    )
    return found if len(found.inlier_matches) >= options.min_num_inliers else none
