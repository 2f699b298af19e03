"""One object from a box and clicks, without a network."""

from torch import Tensor

from kcgs.segment.cleanup import Cleanup, Prediction
from kcgs.segment.cutting import cut_from_box
from kcgs.segment.prompts import Points, check_prompt
from kcgs.segment.registry import register


@register("grabcut", Cleanup(min_size=1, connected=False))
def grabcut(
    image: Tensor, *, box: Points, foreground: Points | None = None, background: Points | None = None
) -> Prediction:
    """Segment one object, by a box around it and clicks, with GrabCut (Rother, Kolmogorov and Blake, SIGGRAPH 2004).

    Colours outside of the box belong to the background. The object is cut out of a reduced image. Each click then
    changes pixels around it, within a distance that grows with its distance to the nearest contour: click into the
    middle of a wrong area, the largest first. Contours snap to edges at full size. The names of regions are "object"
    and "background"; the object is one region, but it may have several pieces. The result is deterministic.

    Args:
        image: as `segment` takes it, any size.
        box: left, top, right, bottom in pixels, somewhat larger than the object.
        foreground: :math:`(P, 2)` points (x, y) of the object, in pixels, in the box.
        background: :math:`(P, 2)` points (x, y) of the background.

    Raises:
        TypeError, ValueError: a box without pixels of the image in it or around it; points outside of the image;
            points of the object outside of the box; no object is found.
        ImportError: OpenCV is not installed.

    Warns:
        UserWarning: the mask does not follow a click.

    Example:
        ``segment(image, "grabcut", box=(30, 40, 200, 180), background=[(60, 70)])``
    """
    return cut_from_box(image, check_prompt(image, box, foreground, background))
