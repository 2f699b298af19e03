"""Suffixes of files, for rooms that load torch, and for the command line, which checks names before torch loads."""

SCENES = (".safetensors", ".kcgs")

WRITTEN_IMAGES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
"""Images that `save_image` writes."""

IMAGES = (*WRITTEN_IMAGES, ".gif")
"""Files of a folder that are images; a file that is named is tried whatever its suffix."""

LABEL_MAPS = (*IMAGES, ".npy")

VIDEOS = (".mp4", ".mov", ".mkv")
"""Videos that H.264 is written into."""
