"""The zoo: small scenes fitted to pictures that anybody may use, each with its decoder, recipe and card."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcgs._atomic import atomic_path
from kcgs.bench.measure import measure
from kcgs.data import chart_2x3, chart_pie, save_image
from kcgs.fit import FitConfig, fit
from kcgs.functional import RegionMap
from kcgs.io import save
from kcgs.nn.renderer import render_image
from kcgs.onnx import scene_decoder, write_model
from kcgs.segment import segment
from kcgs.zoo import Entry, entries

_PREVIEW = 384  # pixels of its longer side
_LARGEST_DECODER = 600_000


class Plan(NamedTuple):
    """One scene to be: a picture, how many Gaussians, what it shows and on what terms."""

    picture: str
    n: int
    title: str
    licence: str


_CHART = "Apache-2.0, drawn by kcgs"
_NASA = "public domain (NASA), from scikit-image"
_CC0 = "CC0, from scikit-image"

PLANS: dict[str, Plan] = {
    "chart-2x3": Plan("2x3", 20, "chart of six colours, 20 Gaussians", _CHART),
    "chart-pie": Plan("pie", 20, "chart of eight sectors, 20 Gaussians", _CHART),
    "astronaut-400": Plan("astronaut", 400, "portrait, few Gaussians", _NASA),
    "astronaut-3000": Plan("astronaut", 3_000, "portrait, many Gaussians", _NASA),
    "chelsea-500": Plan("chelsea", 500, "cat, few Gaussians", _CC0),
    "coffee-1500": Plan("coffee", 1_500, "cup of coffee", _CC0),
    "rocket-1000": Plan("rocket", 1_000, "rocket launch", _NASA),
}


def run(output: Path, *, data: Path | None = None, quick: bool = False, only: str | None = None) -> None:
    """Fit the scenes and write them with their manifest.

    Args:
        output: folder of the zoo.
        data: not used.
        quick: few iterations.
        only: names with commas between; None: all.

    Raises:
        ValueError: an unknown name.
    """
    names = list(PLANS) if only is None else only.split(",")
    unknown = [name for name in names if name not in PLANS]
    if unknown:
        raise ValueError(f"only must name scenes of the zoo, {', '.join(PLANS)}; got {unknown[0]!r}")
    known = {entry.name: entry for entry in entries(output)} if (output / "manifest.json").is_file() else {}
    for name in names:
        known[name] = _make(name, PLANS[name], output, quick)
        listed = [known[name]._asdict() for name in PLANS if name in known]
        with atomic_path(output / "manifest.json") as path:
            path.write_text(json.dumps({"format": "kcgs.zoo", "entries": listed}, indent=1) + "\n", encoding="utf-8")


def picture(name: str) -> tuple[Tensor, Tensor]:
    """Return a picture of the zoo and the label map that its scene was fitted with."""
    if name in ("2x3", "pie"):
        chart = chart_2x3() if name == "2x3" else chart_pie()
        return chart.image, chart.labels
    from skimage import data

    loaders: dict[str, Callable[[], object]] = {
        "astronaut": data.astronaut,
        "chelsea": data.chelsea,
        "coffee": data.coffee,
        "rocket": data.rocket,
    }
    image = torch.as_tensor(loaders[name]()).permute(2, 0, 1).float() / 255
    return image, segment(image)


def _make(name: str, plan: Plan, output: Path, quick: bool) -> Entry:
    image, labels = picture(plan.picture)
    recipe = "best" if plan.picture in ("2x3", "pie") else "best-refined"  # made-up maps may move freely
    config = FitConfig.from_recipe(recipe, **({"iterations": 20} if quick else {}))
    result = fit(image, labels, plan.n, config=config)
    field, regions = result.field, result.regions
    folder = output / name
    folder.mkdir(parents=True, exist_ok=True)
    size = save(folder / "scene.safetensors", field, regions, metadata={"recipe": recipe, "title": plan.title})
    with atomic_path(folder / "recipe.json") as path:
        path.write_text(config.model_dump_json(indent=1) + "\n", encoding="utf-8")
    decoder = _write_decoder(folder / "decoder.onnx", name, recipe, result.field, regions)
    drawn = render_image(field, regions)
    if decoder is not None:
        # to compare with in the viewer
        save_image(folder / ("original.webp" if recipe == "best" else "original.jpg"), image)
    shrink = _PREVIEW / max(field.size)
    save_image(folder / "preview.jpg", render_image(field, regions, _scaled(field.size, shrink)))
    figures = measure(drawn, image, labels)
    edge = figures["ef_psnr"]
    entry = Entry(
        name=name,
        title=plan.title,
        scene=f"{name}/scene.safetensors",
        sha256=_hash(folder / "scene.safetensors"),
        bytes=size,
        recipe=recipe,
        num_gaussians=len(field),
        num_regions=1 if regions is None else regions.num_regions,
        psnr=round(figures["psnr"], 3),
        ef_psnr=round(edge, 3) if edge == edge else None,
        licence=plan.licence,
        command=f"kcgs bench zoo -o models --only {name}",
        decoder=None if decoder is None else f"{name}/decoder.onnx",
        decoder_sha256=None if decoder is None else _hash(decoder),
    )
    with atomic_path(folder / "card.md") as path:
        path.write_text(_card(entry, field.size, figures), encoding="utf-8")
    return entry


def _write_decoder(path: Path, name: str, recipe: str, field: object, regions: RegionMap | None) -> Path | None:
    """Write the decoder, with its inputs for views and regions, where it is small."""
    model = scene_decoder(field, regions, interactive=True, recipe=recipe)  # type: ignore[arg-type]
    if model.ByteSize() > _LARGEST_DECODER:
        path.unlink(missing_ok=True)
        return None
    write_model(model, path)
    return path


def _scaled(size: tuple[int, int], factor: float) -> tuple[int, int]:
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _card(entry: Entry, size: tuple[int, int], figures: dict[str, float]) -> str:
    edge = "not defined: one region" if entry.ef_psnr is None else f"{entry.ef_psnr:.2f} dB"
    rows = {
        "picture": f"{entry.title}, {size[1]} x {size[0]}",
        "licence of the picture": entry.licence,
        "made by": f"`{entry.command}`",
        "recipe": f"`{entry.recipe}`, all settings in `recipe.json`",
        "Gaussians": str(entry.num_gaussians),
        "regions": str(entry.num_regions),
        "PSNR": f"{entry.psnr:.2f} dB",
        "EF-PSNR": edge,
        "MS-SSIM": f"{figures['ms_ssim']:.4f}",
        "bytes": f"{entry.bytes} (label map as plain numbers)",
        "decoder": "`decoder.onnx`, with `view` and `visible`" if entry.decoder else "left out: large",
    }
    table = "\n".join(f"| {key} | {value} |" for key, value in rows.items())
    return f"# {entry.name}\n\n![{entry.title}](preview.jpg)\n\n| | |\n|---|---|\n{table}\n"
