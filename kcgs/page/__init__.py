"""A scene as one web page, which needs no server and no network."""

from .html import ELEMENT, scene_page, web_bytes
from .server import serve

# public; other packages of kcgs use the other imports
__all__ = ["ELEMENT", "scene_page"]
