"""A scene as one web page, which needs no server and no network."""

from .html import ELEMENT, scene_page

__all__ = ["ELEMENT", "scene_page"]
