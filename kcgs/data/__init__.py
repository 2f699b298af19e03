"""Images and label maps on disk, and data sets of scenes.

`load_image` and `load_labels` read what a fit takes; `colorize_labels` and `overlay_labels` show a label map. The
charts, and `Davis` for your copy of that data set, are images with label maps, to try and measure fits. `save_shard`
writes a shard: a file with the scenes of many images. `SceneDataset` reads a folder of shards, to train networks.
"""

from .charts import ChartSample, chart_2x3, chart_pie
from .colors import colorize_labels, label_colors, overlay_labels
from .davis import Davis, DavisFrame
from .images import load_image, save_image
from .labels import load_labels, save_labels
from .shards import SceneBatch, SceneDataset, save_shard, shard_contents, shard_path, stack_scenes

# the public names; other packages of kcgs use the other imports
__all__ = [
    "ChartSample", "Davis", "DavisFrame", "SceneBatch", "SceneDataset", "chart_2x3", "chart_pie",
    "colorize_labels", "label_colors", "load_image", "load_labels", "overlay_labels",
    "save_image", "save_labels", "save_shard",
]  # fmt: skip
