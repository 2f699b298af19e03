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


# Fits
GRID = torch.arange(64)[:, None] // 22 * 4 + torch.arange(80) // 20
MERGED = {(0, 1): 0.9, (1, 2): 0.6, (0, 9): 0.5, (1, 9): 0.8, (2, 9): 0.7}
Regions = Callable[[], adapter.Parts]
HARD: Regions = only_map
SOFT: Regions = partial(only_map, 0.7)


def saturated() -> Tensor:
    return ((textured() - 0.5) * 6).clamp(0, 1)


def on_photo(shift: tuple[int, int] = (0, 0)) -> adapter.Parts:
    return only_map(labels=photo_map().roll(shift, (0, 1)))


def on_chart() -> adapter.Parts:
    return only_map(labels=flat_chart()[1])


def on_blurred(softness: adapter.Softness = 0.0) -> adapter.Parts:
    return only_map(softness, labels=blurred()[1])


def _fit(
    recipe: str,
    num_gaussians: int,
    iterations: int,
    regions: Regions | None = None,
    *,
    image: Callable[[], Tensor] = textured,
    run: Callable[..., Any] = adapter.run_fit,
    **settings: Any,
) -> Any:
    parts = None if regions is None else regions()
    return run(image(), parts, num_gaussians, recipe, iterations=iterations, **settings)


FITS: dict[str, Case] = {
    "paper-none": partial(_fit, "paper", 40, 60),
    "paper-hard": partial(_fit, "paper", 40, 60, HARD),
    "paper-soft": partial(_fit, "paper", 40, 60, SOFT),
    "paper-softness": partial(_fit, "paper", 40, 40, HARD, softness=1.0),
    "paper-no-warmup": partial(_fit, "paper", 40, 40, HARD, warmup=False),
    "gaussian-image": partial(_fit, "gaussian-image", 40, 60, HARD),
    "gaussian-image-clamp": partial(_fit, "gaussian-image-clamp", 40, 60),
    "best-none": partial(_fit, "best", 120, 60, image=photo),
    "best-hard": partial(_fit, "best", 90, 90, HARD),
    "best-softness-0": partial(_fit, "best", 90, 60, HARD, softness=0.0),
    "best-softness-1": partial(_fit, "best", 90, 60, HARD, softness=1.0),
    "best-soft": partial(_fit, "best", 90, 60, SOFT),
    "best-pairs": partial(_fit, "best", 90, 60, partial(only_map, PAIRS)),
    "best-photo": partial(_fit, "best", 160, 100, on_photo, image=photo),
    "best-merged": partial(_fit, "best", 60, 60, on_blurred, image=lambda: blurred()[0]),
    "best-merged-soft": partial(_fit, "best", 60, 60, partial(on_blurred, MERGED), image=lambda: blurred()[0]),
    "best-merged-photo": partial(_fit, "best", 160, 60, partial(on_photo, (9, 14)), image=photo),
    "best-merged-late": partial(_fit, "best", 50, 60, partial(only_map, 2.0, labels=GRID), image=photo),
    "best-unguided": partial(_fit, "best", 60, 30, HARD, guidance=False),
    "best-saturated": partial(_fit, "best", 60, 40, HARD, image=saturated),
    "best-ms-ssim": partial(_fit, "best", 90, 60, image=photo, objective="ms-ssim"),
    "best-adan": partial(_fit, "best", 90, 60, HARD, optimizer="adan"),
    "best-resumed": partial(_fit, "best", 90, 60, HARD, run=adapter.run_resumed, stop=40),
    "paper-resumed": partial(_fit, "paper", 40, 40, HARD, run=adapter.run_resumed, stop=20),
    "best-grey": partial(_fit, "best", 90, 60, HARD, image=partial(textured, channels=1)),
    "best-double": partial(_fit, "best", 30, 30, HARD, image=lambda: textured().double()),
    "best-baseline": partial(_fit, "best-baseline", 90, 60, HARD),
    "best-refined": partial(_fit, "best-refined", 90, 90, HARD),
    "best-refined-photo": partial(_fit, "best-refined", 120, 60, on_photo, image=photo),
    "chart-none": partial(_fit, "best-baseline", 4, 60, image=lambda: flat_chart()[0]),
    "chart-hard": partial(_fit, "best", 6, 60, on_chart, image=lambda: flat_chart()[0]),
    "chart-softness-0": partial(_fit, "best", 6, 60, on_chart, image=lambda: flat_chart()[0], softness=0.0),
    "target-psnr": partial(_fit, "best", 400, 150, image=photo, target_psnr=22.0),
    "target-psnr-regions": partial(_fit, "best", 300, 120, HARD, target_psnr=27.0),
    "target-psnr-paper": partial(_fit, "paper", 60, 60, HARD, target_psnr=17.0),
}
CASES |= {f"fit/{name}": function for name, function in FITS.items()}


# Videos: an image that moves to the right, once up to a cut
def _video(regions: Regions | None = None, *, cut: bool = False) -> Any:
    frames = [textured().roll(2 * t, 2) for t in range(3)]
    if cut:
        frames[2] = 1.0 - frames[2].flip(1)
    return adapter.run_fit_video(frames, None if regions is None else regions(), 60, "best", iterations=40)


CASES |= {"video/none": _video, "video/cut": partial(_video, cut=True), "video/map": partial(_video, SOFT)}

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
    if len(whole) > 2_000:  # several layers
        results["truncated"] = adapter.from_file(whole[: len(whole) * 2 // 3])
        results["max-bytes"] = adapter.from_file(whole, max_bytes=len(whole) - 5)
    return results


def _saved(make: Callable[[], adapter.Parts]) -> dict[str, Any]:
    data, scene = adapter.saved(make(), {"title": "golden"})
    return {"data": data, "scene": scene}


for name, make in FILES.items():
    CASES[f"codec/{name}"] = partial(_file, make)
    CASES[f"safetensors/{name}"] = partial(_saved, make)


def _compress(**scene: Any) -> dict[str, Any]:
    fine = adapter.run_compress(gaussians(60, **scene), textured(), iterations=12, quality=46.0, objective="ms-ssim")
    target = adapter.run_compress(gaussians(60, **scene), textured(), iterations=8, target_bytes=len(fine) - 60)
    return {"data": fine, "target": target}


for name in ("none", "hard", "pairs"):
    CASES[f"codec/compress-{name}"] = partial(_compress, **MAPS[name])
for name, settings in {
    "quality": {"quality": 30, "objective": "ms-ssim"},
    "ms-ssim": {"quality": 46.0, "iterations": 8, "objective": "ms-ssim"},
}.items():
    CASES[f"codec/compress-{name}"] = lambda s=settings: {"data": adapter.run_compress(gaussians(60), textured(), **s)}
CASES |= {
    "codec/fit-bytes-none": partial(_fit, "best", 700, 40, image=photo, run=adapter.run_fit_bytes),
    "codec/fit-bytes-map": partial(_fit, "best", 800, 40, HARD, run=adapter.run_fit_bytes),
    "codec/fit-bytes-baseline": partial(_fit, "best-baseline", 600, 30, HARD, run=adapter.run_fit_bytes),
    "codec/fit-bytes-soft": partial(_fit, "best", 800, 30, SOFT, run=adapter.run_fit_bytes),
}


# ONNX
def _model(model: Any, **feeds: Any) -> dict[str, Any]:
    image = adapter.run_onnx(model, feeds)
    del model.metadata_props[:]  # the version of kcgs is one of them
    return {"graph": model.SerializeToString(deterministic=True), "image": image}


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


def _generic() -> Any:
    p = gaussians()
    ids = p.labels.unique()
    memberships = (p.labels == ids[:, None, None]).float()
    feeds = {"means": p.means, "cholesky": p.cholesky, "colors": p.colors, "memberships": memberships}
    feeds["region_ids"] = torch.searchsorted(ids, p.ids)
    free = _model(adapter.decoder_of_any(), **feeds)
    return {"free": free, "coarse": _model(adapter.decoder_of_any(cutoff=1e-3, clamp=True), **feeds)}


CASES["onnx/generic"] = _generic


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
    photo(), "felzenszwalb", scale=80.0, snap=2, max_regions=9, min_size=15
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
