"""The text of the page: two scripts, a policy that allows only these scripts, and the scene."""

from __future__ import annotations

import base64
import hashlib
import html
from pathlib import Path

from kcgs.codec import decode, encode
from kcgs.errors import InvalidArgument
from kcgs.scene import Scene, check_scene

# page.html, a template for `str.format`, and page.css are written by hand; page.js and the element are committed as
# `make page` builds them out of export/web/element, so that an installation needs no npm
_FOLDER = Path(__file__).resolve().parent
ELEMENT = _FOLDER / "kcgs-image.js"
"""The script of `<kcgs-image>`, one file to copy to a site."""
# PSNR in dB against the scene's own render: no value differs by as much as 1 / 255
_QUALITY = 60.0


def scene_page(scene: Scene | bytes, *, title: str = "scene") -> str:
    r"""Write a scene as one HTML page that opens from disk, offline.

    Convention: the page zooms, pans, and hides regions. It holds the scene as a `.kcgs` file and loads nothing.

    Args:
        scene: of one image, with 1, 3 or 4 channels; or the bytes of its `.kcgs` file, which the page holds unchanged.
        title: title of the page and alternative text of the image.

    Returns:
        The page: about 100 kB plus 4/3 of the bytes of the scene's file.

    Raises:
        TypeError, ValueError: as :func:`kcgs.codec.encode` and :func:`kcgs.codec.decode`; another number of
            channels.

    Example:
        >>> from kcgs import GaussianField
        >>> page = scene_page(Scene(GaussianField.random(100, (32, 48), seed=0)), title="Blobs & more")
        >>> page[:15], "<title>Blobs &amp; more</title>" in page
        ('<!doctype html>', True)
    """
    files = (_FOLDER / "page.css", _FOLDER / "page.js", _FOLDER / "page.html", ELEMENT)
    style, script, template, element = (file.read_text(encoding="utf-8").strip() for file in files)
    policy = (
        f"default-src 'none'; script-src '{_policy_hash(script)}' '{_policy_hash(element)}' 'wasm-unsafe-eval'; "
        f"style-src '{_policy_hash(style)}'; img-src data:; base-uri 'none'; form-action 'none'"
    )
    return template.format(
        policy=policy, title=html.escape(title), style=style, element=element, script=script,
        scene=base64.b64encode(web_bytes(scene)).decode(),
    )  # fmt: skip


def web_bytes(scene: Scene | bytes) -> bytes:
    """Encode a scene for a page, within 1 / 255 of its own render; bytes of a file are checked and returned."""
    loaded = check_scene(scene) if isinstance(scene, Scene) else decode(scene).scene
    channels = loaded.field.colors.shape[-1]
    if channels not in (1, 3, 4):
        raise InvalidArgument("scene", "1, 3 or 4 channels for a page to show it", channels, verb="have")
    return encode(scene, quality=_QUALITY) if isinstance(scene, Scene) else scene


def _policy_hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
