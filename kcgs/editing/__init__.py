"""Edit scenes by region: new scenes, and images of regions alone or over another image."""

from .render import render_over, render_region
from .scenes import delete_region, extract_region, move_region, recolor_region, replace_background

__all__ = [
    "delete_region",
    "extract_region",
    "move_region",
    "recolor_region",
    "render_over",
    "render_region",
    "replace_background",
]
