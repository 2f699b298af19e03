"""k-means of colours and of features."""

import math
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcgs._check import check_count

# largest number of rows from which the centres are computed; more rows do not move the centres
_MAX_SAMPLE = 100_000


def k_means(values: NDArray[Any], num_clusters: int) -> NDArray[np.int64]:
    """Return the cluster of every row of (N, D), deterministically; fewer clusters if there are equal rows."""
    from scipy.cluster.vq import kmeans2, vq

    check_count("num_clusters", num_clusters)
    sample = values[:: math.ceil(len(values) / _MAX_SAMPLE)]
    with warnings.catch_warnings(action="ignore"):  # clusters may stay empty
        centers, _ = kmeans2(sample, num_clusters, iter=20, minit="++", rng=0)
    return np.asarray(vq(values, centers)[0], dtype=np.int64)
