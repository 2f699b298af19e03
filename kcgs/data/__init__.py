"""Images, label maps and data sets."""

from kcgs.data.charts import ChartSample, chart_2x3, chart_pie
from kcgs.data.davis import Davis, DavisFrame, DavisSequence
from kcgs.data.images import load_image, save_image
from kcgs.data.labels import colorize_labels, label_colors, load_labels, overlay_labels, save_labels
from kcgs.data.video import FrameReader, LabelMapReader, read_label_maps, read_video, write_video

__all__ = [
    "ChartSample", "Davis", "DavisFrame", "DavisSequence", "FrameReader", "LabelMapReader", "chart_2x3", "chart_pie",
    "colorize_labels", "label_colors", "load_image", "load_labels", "overlay_labels", "read_label_maps", "read_video",
    "save_image", "save_labels", "write_video",
]  # fmt: skip
