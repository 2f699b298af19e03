"""Edit scenes by region: new scenes, and images of regions alone or over another image."""

from .inpainting import inpaint
from .masks import check_offset, dilate, shift_labels
from .recoloring import recolor_region
from .render import render_over, render_region
from .scenes import delete_region, extract_region, move_region, replace_background
from .selection import members_of, unique_region_ids, warn_of_lost_regions

# the public names; other packages of kcgs use the other imports
__all__ = [
    "delete_region",
    "extract_region",
    "move_region",
    "recolor_region",
    "render_over",
    "render_region",
    "replace_background",
]
