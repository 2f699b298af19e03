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

    Colours outside of the box are the background's. The object is cut out of a reduced image. Each click then changes
    what lies around it, within a distance that grows with the distance to the nearest contour: click into the middle of
    what is wrong, first where most is. Contours snap to edges at full size. The names of regions are "object" and
    "background"; the object is in one region, though it may have several pieces. The result is the same every time.

    Args:
        image: as `segment` takes it, any size.
        box: left, top, right, bottom in pixels, somewhat larger than the object.
        foreground: :math:`(P, 2)` points (x, y) of the object, in pixels, in the box.
        background: :math:`(P, 2)` points (x, y) that are not of it.

    Raises:
        TypeError, ValueError: a box without pixels of the image or without any around it; points outside of the image,
            or of the object and outside of the box; no object is found.
        ImportError: OpenCV is not installed.

    Warns:
        UserWarning: a click that the mask does not follow.

    Example:
        ``segment(image, "grabcut", box=(30, 40, 200, 180), background=[(60, 70)])``
    """
    return cut_from_box(image, check_prompt(image, box, foreground, background))
