"""The text of the page: the element's script, a policy that allows that script only, and the scene."""

from __future__ import annotations

import base64
import hashlib
import html
from pathlib import Path

from kcgs.clip import Clip
from kcgs.codec import CodecError, decode, encode
from kcgs.codec.clips.file import is_clip, unpack
from kcgs.functional.softness import check_contours
from kcgs.scene import Scene, check_scene

_FOLDER = Path(__file__).resolve().parent
# against the scene's own render, in dB: no difference of a level of 255
_QUALITY = 60.0


def scene_page(scene: Scene | Clip | bytes, *, title: str = "scene", contours: str = "scaled") -> str:
    r"""Write a scene as one HTML page that opens from disk, offline.

    Convention: the page zooms, pans, and hides regions; a clip it plays. It holds the scene as a `.kcgs` file and loads
    nothing.

    Args:
        scene: a scene of one image, or a clip, with 1, 3 or 4 channels; or the bytes of a `.kcgs` file of either, which
            are kept as they are.
        title: of the page, and what it calls the image for who does not see it.
        contours: "scaled" or "crisp", as :meth:`kcgs.Scene.render` has them.

    Returns:
        The page, about 100 kB, of a clip 130, and 4/3 of the file.

    Raises:
        TypeError, ValueError: as :func:`kcgs.codec.encode` and :func:`kcgs.codec.decode`; other contours, another
            number of channels.

    Example:
        >>> from kcgs import GaussianField
        >>> page = scene_page(Scene(GaussianField.random(100, (32, 48), seed=0)), title="Blobs & more")
        >>> page[:15], "<title>Blobs &amp; more</title>" in page
        ('<!doctype html>', True)
    """
    data = web_bytes(scene)
    source = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    return page_html(source, title=title, contours=contours, clip=is_clip(data))


def web_bytes(scene: Scene | Clip | bytes) -> bytes:
    """Write a scene as a `.kcgs` file whose render is within a level of 255 of the scene's own; files are kept."""
    if isinstance(scene, Clip):
        scene = scene.to_bytes()
    if isinstance(scene, Scene):
        channels = check_scene(scene).field.colors.shape[-1]
    elif isinstance(scene, bytes) and is_clip(scene):
        header, _, ended = unpack(scene)
        if not ended:
            raise CodecError("the clip ends early")
        channels = header.channels
    else:
        channels = decode(scene).scene.field.colors.shape[-1]
    if channels not in (1, 3, 4):
        raise ValueError(f"scene must have 1, 3 or 4 channels for a page to show it; got {channels}")
    return encode(scene, quality=_QUALITY) if isinstance(scene, Scene) else scene


def page_html(
    source: str, *, title: str, contours: str = "scaled", original: str | None = None, clip: bool = False
) -> str:
    """Return the page of a scene or a clip at an address, maybe with an original beside it; see :func:`scene_page`."""
    names = "page.css", "clip.js" if clip else "page.js", "page.html"
    style, script, page = ((_FOLDER / name).read_text(encoding="utf-8") for name in names)
    script = script.strip()
    hashes = {name: _policy_hash(text) for name, text in (("style", style), ("script", script))}
    # a page of an address asks its own server; one that holds its scene asks nobody
    images, asked = ("", "'none'") if source.startswith("data:") else (" 'self'", "'self'")
    policy = (
        f"default-src 'none'; script-src '{hashes['script']}' 'wasm-unsafe-eval'; style-src '{hashes['style']}'; "
        f"img-src blob: data:{images}; connect-src {asked}; base-uri 'none'; form-action 'none'"
    )
    beside = "" if original is None else f' data-original="{html.escape(original)}"'
    return page.format(
        policy=policy, title=html.escape(title), style=style, script=script,
        contours=check_contours(contours), attribute="data-clip" if clip else "src", src=html.escape(source),
        original=beside,
    )  # fmt: skip


def _policy_hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
