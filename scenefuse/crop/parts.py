"""Connected parts of a cloud."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scenefuse.core.transforms import Array

# Points closer than this belong to one part, as a share of the diagonal of the fiducials' box.
LINK_FRACTION = 0.03
# Parts with a smaller share of the points are left out.
MIN_PART_SHARE = 0.01


def parts(points: Array, link: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The connected part of each point, of points closer than about `link`, and how many points each part has."""
    cells, cell_of = np.unique(np.floor(points / link).astype(np.int64), axis=0, return_inverse=True)
    touching = cKDTree(cells).query_pairs(1.8, output_type="ndarray")
    graph = coo_matrix((np.ones(len(touching)), touching.T), shape=(len(cells), len(cells)))
    part_of = connected_components(graph, directed=False)[1][cell_of.ravel()]
    return part_of, np.bincount(part_of)
