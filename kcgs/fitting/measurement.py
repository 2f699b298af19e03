"""The errors of a render in one pass over memory."""

import numpy as np

from kcgs.kernels.compiled import Program

program = Program("measurement of a fit", __file__)


@program.entry
def mean_errors(rendered, image, is_squared):  # type: ignore[no-untyped-def]
    """Return the mean error of rows (R, W), absolute or squared, and the mean squared error of the clipped render."""
    loss, squares = np.zeros((2, rendered.shape[1]))
    for y in range(len(rendered)):
        for x in range(rendered.shape[1]):
            difference = rendered[y, x] - image[y, x]
            loss[x] += difference * difference if is_squared else abs(difference)
            difference = min(max(rendered[y, x], rendered.dtype.type(0)), rendered.dtype.type(1)) - image[y, x]
            squares[x] += difference * difference
    return loss.sum() / rendered.size, squares.sum() / rendered.size
