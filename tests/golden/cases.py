"""What is recorded: each case has a name, `group/what`, and returns tensors, bytes and plain values by name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from . import adapter
from .inputs import PAIRS, SIZE, blurred, flat_chart, gaussians, map_of, only_map, photo, photo_map, textured

Case = Callable[[], Any]
CASES: dict[str, Case] = {}
MAPS: dict[str, dict[str, Any]] = {
    "none": {"regions": False},
    "hard": {},
    "soft": {"softness": 0.8},
    "pairs": {"softness": PAIRS},
}


def case(name: str) -> Callable[[Case], Case]:
    """Register a case."""

    def register(function: Case) -> Case:
        assert name not in CASES, name
        CASES[name] = function
        return function

    return register


# Fits
GRID = torch.arange(64)[:, None] // 22 * 4 + torch.arange(80) // 20
MERGED = {(0, 1): 0.9, (1, 2): 0.6, (0, 9): 0.5, (1, 9): 0.8, (2, 9): 0.7}
FITS: dict[str, Case] = {
    "paper-none": lambda: adapter.run_fit(textured(), None, 40, "paper", iterations=60),
    "paper-hard": lambda: adapter.run_fit(textured(), only_map(), 40, "paper", iterations=60),
    "paper-soft": lambda: adapter.run_fit(textured(), only_map(0.7), 40, "paper", iterations=60),
    "paper-softness": lambda: adapter.run_fit(textured(), only_map(), 40, "paper", iterations=40, softness=1.0),
    "paper-no-warmup": lambda: adapter.run_fit(textured(), only_map(), 40, "paper", iterations=40, warmup=False),
    "gaussian-image": lambda: adapter.run_fit(textured(), only_map(), 40, "gaussian-image", iterations=60),
    "gaussian-image-clamp": lambda: adapter.run_fit(textured(), None, 40, "gaussian-image-clamp", iterations=60),
    "image-gs": lambda: adapter.run_fit(textured(), None, 40, "image-gs", iterations=60),
    "image-gs-regions": lambda: adapter.run_fit(
        textured(), only_map(0.7), 40, "image-gs", iterations=40, guidance=True
    ),
    "best-none": lambda: adapter.run_fit(photo(), None, 120, "best", iterations=60),
    "best-hard": lambda: adapter.run_fit(textured(), only_map(), 90, "best", iterations=90),
    "best-softness-0": lambda: adapter.run_fit(textured(), only_map(), 90, "best", iterations=60, softness=0.0),
    "best-softness-1": lambda: adapter.run_fit(textured(), only_map(), 90, "best", iterations=60, softness=1.0),
    "best-soft": lambda: adapter.run_fit(textured(), only_map(0.7), 90, "best", iterations=60),
    "best-pairs": lambda: adapter.run_fit(textured(), only_map(PAIRS), 90, "best", iterations=60),
    "best-photo": lambda: adapter.run_fit(photo(), only_map(labels=photo_map()), 160, "best", iterations=100),
    "best-merged": lambda: adapter.run_fit(blurred()[0], only_map(labels=blurred()[1]), 60, "best", iterations=60),
    "best-merged-soft": lambda: adapter.run_fit(
        blurred()[0], only_map(MERGED, labels=blurred()[1]), 60, "best", iterations=60
    ),
    "best-merged-photo": lambda: adapter.run_fit(
        photo(), only_map(labels=photo_map().roll((9, 14), (0, 1))), 160, "best", iterations=60
    ),
    "best-merged-late": lambda: adapter.run_fit(photo(), only_map(2.0, labels=GRID), 50, "best", iterations=60),
    "best-unguided": lambda: adapter.run_fit(textured(), only_map(), 60, "best", iterations=30, guidance=False),
    "best-saturated": lambda: adapter.run_fit(
        ((textured() - 0.5) * 6).clamp(0, 1), only_map(), 60, "best", iterations=40
    ),
    "best-ms-ssim": lambda: adapter.run_fit(photo(), None, 90, "best", iterations=60, objective="ms-ssim"),
    "best-adan": lambda: adapter.run_fit(textured(), only_map(), 90, "best", iterations=60, optimizer="adan"),
    "best-resumed": lambda: adapter.run_resumed(textured(), only_map(), 90, 40, "best", iterations=60),
    "paper-resumed": lambda: adapter.run_resumed(textured(), only_map(), 40, 20, "paper", iterations=40),
    "image-gs-resumed": lambda: adapter.run_resumed(textured(), None, 40, 20, "image-gs", iterations=40),
    "best-grey": lambda: adapter.run_fit(textured(channels=1), only_map(), 90, "best", iterations=60),
    "best-double": lambda: adapter.run_fit(textured().double(), only_map(), 30, "best", iterations=30),
    "best-baseline": lambda: adapter.run_fit(textured(), only_map(), 90, "best-baseline", iterations=60),
    "best-refined": lambda: adapter.run_fit(textured(), only_map(), 90, "best-refined", iterations=90),
    "best-refined-photo": lambda: adapter.run_fit(
        photo(), only_map(labels=photo_map()), 120, "best-refined", iterations=60
    ),
    "chart-none": lambda: adapter.run_fit(flat_chart()[0], None, 4, "best-baseline", iterations=60),
    "chart-hard": lambda: adapter.run_fit(flat_chart()[0], only_map(labels=flat_chart()[1]), 6, "best", iterations=60),
    "chart-softness-0": lambda: adapter.run_fit(
        flat_chart()[0], only_map(labels=flat_chart()[1]), 6, "best", iterations=60, softness=0.0
    ),
    "target-psnr": lambda: adapter.run_fit(photo(), None, 400, "best", iterations=150, target_psnr=22.0),
    "target-psnr-regions": lambda: adapter.run_fit(
        textured(), only_map(), 300, "best", iterations=120, target_psnr=27.0
    ),
    "target-psnr-paper": lambda: adapter.run_fit(textured(), only_map(), 60, "paper", iterations=60, target_psnr=17.0),
}
CASES |= {f"fit/{name}": function for name, function in FITS.items()}

# Videos: an image that moves to the right, once up to a cut
VIDEOS: dict[str, dict[str, Any]] = {
    "none": {"cut": False},
    "cut": {"cut": True},
    "map": {"cut": False, "regions": only_map(0.7)},
}


def _video(cut: bool, regions: adapter.Parts | None = None) -> dict[str, Any]:
    frames = [textured().roll(2 * t, 2) for t in range(3)]
    if cut:
        frames[2] = 1.0 - frames[2].flip(1)
    return adapter.run_fit_video(frames, regions, 60, "best", iterations=40)


CASES |= {f"video/{name}": partial(_video, **settings) for name, settings in VIDEOS.items()}

# Files
FILES = {f"{name}": partial(gaussians, **settings) for name, settings in MAPS.items()} | {
    "grey": partial(gaussians, channels=1),
    "opacities": partial(gaussians, opacities=True),
    "large": partial(gaussians, 700, (96, 128)),
}


def _file(make: Callable[[], adapter.Parts]) -> dict[str, Any]:
    whole = adapter.to_file(make())
    results = {"whole": whole, "decoded": adapter.from_file(whole)}
    results |= {f"quality-{q}": adapter.to_file(make(), quality=q) for q in (30, 55)}
    results["target"] = adapter.to_file(make(), target_bytes=len(whole) * 3 // 4)
    results["truncated"] = adapter.from_file(whole[: len(whole) * 2 // 3])
    return results | {"max-bytes": adapter.from_file(whole, max_bytes=len(whole) - 5)}


def _saved(make: Callable[[], adapter.Parts]) -> dict[str, Any]:
    data, scene = adapter.saved(make(), {"title": "golden"})
    return {"data": data, "scene": scene}


for name, make in FILES.items():
    CASES[f"codec/{name}"] = partial(_file, make)
    CASES[f"safetensors/{name}"] = partial(_saved, make)


def _compress(**scene: Any) -> dict[str, Any]:
    image = textured(channels=scene.get("channels", 3))
    fine = adapter.run_compress(gaussians(60, **scene), image, iterations=12)
    target = adapter.run_compress(gaussians(60, **scene), image, iterations=8, target_bytes=len(fine) - 60)
    return {"data": fine, "target": target, "quality": adapter.run_compress(gaussians(60), image, quality=30)}


for name in ("none", "hard", "pairs"):
    CASES[f"codec/compress-{name}"] = partial(_compress, **MAPS[name])
CASES["codec/compress-ms-ssim"] = lambda: {
    "data": adapter.run_compress(gaussians(60), textured(), iterations=8, objective="ms-ssim")
}
BYTES: dict[str, Case] = {
    "none": lambda: adapter.run_fit_bytes(photo(), None, 700, "best", iterations=40),
    "map": lambda: adapter.run_fit_bytes(textured(), only_map(), 800, "best", iterations=40),
    "refined": lambda: adapter.run_fit_bytes(textured(), only_map(), 900, "best-refined", iterations=30),
    "baseline": lambda: adapter.run_fit_bytes(textured(), only_map(), 600, "best-baseline", iterations=30),
    "soft": lambda: adapter.run_fit_bytes(textured(), only_map(0.7), 800, "best", iterations=30),
}
CASES |= {f"codec/fit-bytes-{name}": function for name, function in BYTES.items()}


# ONNX
def _model(model: Any, **feeds: Any) -> dict[str, Any]:
    bare = type(model)()
    bare.CopyFrom(model)
    del bare.metadata_props[:]
    data = model.SerializeToString(deterministic=True)
    outputs = {"image": adapter.run_onnx(model, feeds)} if feeds else {}
    return {"bytes": data, "graph": bare.SerializeToString(deterministic=True), **outputs}


def _decoder(scene: dict[str, Any], **settings: Any) -> dict[str, Any]:
    parts = gaussians(**scene)
    feeds: dict[str, Any] = {"size": np.array([60, 84])}
    if settings.get("interactive"):
        feeds["view"] = np.array([3.5, -2, 40, 30], np.float32)
        count = 1 if parts.labels is None else len(parts.labels.unique())
        feeds["visible"] = np.linspace(1, 0, count, dtype=np.float32)
    return _model(adapter.decoder_of(parts, **settings), **feeds)


for name, settings in MAPS.items():
    CASES[f"onnx/scene-{name}"] = partial(_decoder, settings)
    CASES[f"onnx/interactive-{name}"] = partial(_decoder, settings, interactive=True, recipe="best")
CASES["onnx/cutoff-0"] = partial(_decoder, {"count": 40}, cutoff=0.0)
CASES["onnx/large-ids"] = partial(_decoder, {"ids": (5, 300, 70_000, 9)}, interactive=True)


@case("onnx/generic")
def _generic() -> Any:
    p = gaussians()
    ids = p.labels.unique()
    memberships = (p.labels == ids[:, None, None]).float()
    feeds = {"means": p.means, "cholesky": p.cholesky, "colors": p.colors, "memberships": memberships}
    feeds["region_ids"] = torch.searchsorted(ids, p.ids)
    free = _model(adapter.decoder_of_any(), **feeds)
    return {"free": free, "coarse": _model(adapter.decoder_of_any(cutoff=1e-3, clamp=True), **feeds)}


@case("onnx/decode-script")
def _decode_script() -> Any:
    own = adapter.decoder_of(gaussians(softness=0.8), interactive=True).SerializeToString()
    views = ([], ["--scale", "1.7"], ["--size", "70x50", "--view=-3,2,40.5,30"], ["--region", "7", "11"])
    return {f"scene-{i}": adapter.run_decode_script(own, options) for i, options in enumerate(views)}


# Renders and gradients
def _splat(scene: dict[str, Any], **settings: Any) -> dict[str, Tensor]:
    parts = gaussians(**scene)
    leaves = [t.clone().requires_grad_() for t in parts[:3]]
    size = None if parts.labels is not None else SIZE
    image = adapter.splat(parts._replace(means=leaves[0], cholesky=leaves[1], colors=leaves[2]), size=size, **settings)
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(9)).to(image)
    image.backward(weights)
    gradients = {f"d-{name}": leaf.grad for name, leaf in zip(parts._fields[:3], leaves, strict=True)}
    return {"image": image.detach(), **gradients}


for name, settings in MAPS.items():
    for backend in ("reference", "tiled", "cpu"):
        for cutoff in (1e-4, 0.0):
            CASES[f"splat/{backend}-{name}-{cutoff:g}"] = partial(_splat, settings, cutoff=cutoff, backend=backend)
    CASES[f"splat/auto-{name}-double"] = partial(_splat, {**settings, "dtype": torch.float64})
for backend in ("reference", "tiled", "cpu"):
    CASES[f"splat/{backend}-batch"] = partial(_splat, {"batch": 3, "count": 40}, backend=backend)
    CASES[f"splat/{backend}-channels"] = partial(_splat, {"channels": 5, "softness": 0.8}, backend=backend)
    CASES[f"splat/{backend}-large-ids"] = partial(_splat, {"ids": (5, 300, 70_000, 9)}, backend=backend)


def _renders(make: Callable[[], adapter.Parts]) -> dict[str, Any]:
    sizes = {"own": None, "double": (80, 112), "odd": (53, 61), "half": (20, 28)}
    results: dict[str, Any] = {name: adapter.render(make(), size) for name, size in sizes.items()}
    maps = {f"map-{n}": adapter.resized_map(make(), s) for n, s in sizes.items() if s and make().labels is not None}
    return results | maps


for name in (*MAPS, "opacities"):
    CASES[f"render/{name}"] = partial(_renders, FILES[name])

# Label maps and images
for name in ("auto", "felzenszwalb", "slic", "watershed", "kmeans"):
    CASES[f"segment/{name}"] = partial(lambda method: adapter.run_segment(photo(), method), name)
CASES["segment/felzenszwalb-options"] = lambda: adapter.run_segment(
    photo(), "felzenszwalb", scale=80.0, snap=True, max_regions=9, min_size=15
)
CASES["segment/cleanup"] = lambda: adapter.cleanups(photo(), photo_map())
CASES["functional/contours"] = lambda: adapter.contour_functions(photo(), photo_map())
CASES["functional/contours-textured"] = lambda: adapter.contour_functions(textured(), map_of())
CASES["functional/metrics"] = lambda: adapter.metrics(
    textured((180, 200)), (textured((180, 200)) + 0.1 * textured((180, 200)).roll(3, 2)).clamp(0, 1), map_of((180, 200))
)

# Scenes
BACKGROUND = textured((50, 60))
for name in ("hard", "soft", "pairs"):
    CASES[f"scene/edits-{name}"] = partial(lambda s: adapter.edits(gaussians(**s), 7, BACKGROUND), MAPS[name])
for name, settings in MAPS.items():
    CASES[f"scene/prune-{name}"] = partial(lambda s: adapter.run_prune(gaussians(**s), 0.05), settings)
    CASES[f"scene/propose-{name}"] = partial(
        lambda s: adapter.run_propose(gaussians(**s), textured() - 0.4, 25), settings
    )
for name in ("hard", "soft", "pairs"):
    CASES[f"scene/refine-contours-{name}"] = partial(
        lambda s: adapter.run_refine_contours(gaussians(**s), textured().roll(1, 2)), MAPS[name]
    )
CASES["scene/refine-contours-far"] = lambda: adapter.run_refine_contours(
    gaussians(), textured().roll(2, 1), max_distance=None, length_weight=0.001
)
