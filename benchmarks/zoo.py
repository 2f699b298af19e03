"""Make the zoo: small scenes of images that anybody may use, each with its card."""

from __future__ import annotations

import hashlib
import json
import math
from pathlib import Path
from typing import NamedTuple

from kcgs import FitConfig, Scene, evaluate, fit
from kcgs.data import save_image
from kcgs.zoo import Entry, entries

from .core.fits import QUICK_ITERATIONS
from .core.images import CHARTS, load_mapped
from .core.run import Options

PREVIEW = 384  # longer side of a preview, in pixels
_CHART = "Apache-2.0, made by kcgs"
_NASA = "public domain (NASA), from scikit-image"
_CC0 = "CC0, from scikit-image"


class Plan(NamedTuple):
    """An image of the zoo: its number of Gaussians, its title and its licence."""

    image: str
    n: int
    title: str
    licence: str


PLANS: dict[str, Plan] = {
    "chart-2x3": Plan("2x3", 20, "chart of six colours", _CHART),
    "chart-pie": Plan("pie", 20, "chart of eight sectors", _CHART),
    "astronaut-400": Plan("astronaut", 400, "portrait, few Gaussians", _NASA),
    "astronaut-3000": Plan("astronaut", 3_000, "portrait, many Gaussians", _NASA),
    "chelsea-500": Plan("chelsea", 500, "cat, few Gaussians", _CC0),
    "coffee-1500": Plan("coffee", 1_500, "cup of coffee", _CC0),
    "rocket-1000": Plan("rocket", 1_000, "rocket launch", _NASA),
}


def make_zoo(options: Options) -> None:
    """Fit all scenes, or the scenes that `only` names, and write them with their manifest."""
    unknown = [name for name in options.only if name not in PLANS]
    if unknown:
        raise ValueError(f"only must name scenes of the zoo, {', '.join(PLANS)}; got {unknown[0]!r}")
    manifest = options.output / "manifest.json"
    by_name = {entry.name: entry for entry in entries(options.output)} if manifest.is_file() else {}
    for name in options.only or PLANS:
        by_name[name] = make_entry(name, PLANS[name], options.output / name, options.quick)
        content = {"format": "kcgs.zoo", "entries": [by_name[name]._asdict() for name in PLANS if name in by_name]}
        manifest.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def make_entry(name: str, plan: Plan, folder: Path, quick: bool) -> Entry:
    """Fit a scene and write its files."""
    image, labels = load_mapped(plan.image)
    recipe = "best" if plan.image in CHARTS else "best-refined"  # contours from `segment` may move any distance
    config = FitConfig.from_recipe(recipe, **({"iterations": QUICK_ITERATIONS} if quick else {}))
    folder.mkdir(parents=True, exist_ok=True)
    fitted = fit(image, labels, plan.n, recipe=config).scene
    scene = Scene(fitted.field, fitted.regions, {"recipe": recipe, "title": plan.title})
    size = scene.save(folder / "scene.safetensors")
    height, width = scene.size
    shrink = PREVIEW / max(height, width)
    save_image(folder / "preview.jpg", scene.render((max(1, round(height * shrink)), max(1, round(width * shrink)))))
    metrics = evaluate(scene, image, labels)
    edge = metrics["ef_psnr"]
    entry = Entry(
        name=name, title=plan.title, scene=f"{name}/scene.safetensors", sha256=_hash(folder / "scene.safetensors"),
        bytes=size, recipe=recipe, num_gaussians=scene.num_gaussians,
        num_regions=1 if scene.regions is None else scene.regions.num_regions, psnr=round(metrics["psnr"], 3),
        ef_psnr=None if math.isnan(edge) else round(edge, 3), licence=plan.licence,
        command=f"python -m benchmarks zoo -o models --only {name}",
    )  # fmt: skip
    (folder / "card.md").write_text(_card(entry, scene.size, metrics["ms_ssim"]), encoding="utf-8")
    return entry


def _hash(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _card(entry: Entry, size: tuple[int, int], ms_ssim: float) -> str:
    rows = {
        "image": f"{entry.title}, {size[1]} x {size[0]}",
        "licence of the image": entry.licence,
        "made by": f"`{entry.command}`",
        "recipe": f"`{entry.recipe}`",
        "Gaussians": str(entry.num_gaussians),
        "regions": str(entry.num_regions),
        "PSNR": f"{entry.psnr:.2f} dB",
        "EF-PSNR": "not defined: one region" if entry.ef_psnr is None else f"{entry.ef_psnr:.2f} dB",
        "MS-SSIM": f"{ms_ssim:.4f}",
        "bytes": f"{entry.bytes} (label map deflated)",
    }
    table = "\n".join(f"| {key} | {value} |" for key, value in rows.items())
    return f"# {entry.name}\n\n![{entry.title}](preview.jpg)\n\n| | |\n|---|---|\n{table}\n"
