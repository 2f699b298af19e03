"""A scene as one web page, which needs no server and no network."""

from .html import page_html, scene_page, web_bytes

__all__ = ["page_html", "scene_page", "web_bytes"]
