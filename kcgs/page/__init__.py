"""A scene as one web page, which needs no server and no network."""

from .html import ELEMENT, scene_page, web_bytes
from .server import serve

# public; what else is imported here is for the other rooms of kcgs
__all__ = ["ELEMENT", "scene_page"]
