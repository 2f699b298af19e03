"""A scene as one web page, which needs no server and no network."""

from .html import scene_page

__all__ = ["scene_page"]
