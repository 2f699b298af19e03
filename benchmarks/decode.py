"""How fast and how exactly do decoders render?"""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import onnx
import torch
from torch import Tensor

from kcgs import RegionSplatRenderer, Scene, load
from kcgs.onnx import scene_decoder

from .core.clocks import milliseconds, peak_megabytes, threads
from .core.figures import Panel, save_lines
from .core.run import Job, Options, Page, Row
from .core.scenes import FITTED, SIZES, scene_of, size_of
from .core.tables import group_by, means_table, values_of

CUTOFFS = (1e-2, 1 / 255, 1e-3, 1e-4, 1e-6)
DEFAULT_CUTOFF = 1e-4
# cutoff of the exact render in float64: the weights below it are far below the rounding of float32
TRUTH_CUTOFF = 1e-12
ROUNDS = 5
SIZE_TITLES = {"native": "a scene's own size", "3840 wide": "3,840 pixels wide"}
DECODERS = ("onnxruntime", "torch, cpu", "torch, tiled")
# decoders that are timed on a wide image; the others take seconds
FAST = ("onnxruntime", "torch, cpu")
METHOD = """Milliseconds for one image, medians, all decoders of a scene in turns. `onnxruntime` runs the scene's
own decoder (`kcgs.onnx.scene_decoder`), `torch` is `RegionSplatRenderer` with a backend. Loading goes from the file
on disk to the first image. MB is what loading and one image add at the peak, in a process of its own. Errors are the
largest, against `tiled` in float64 at a cutoff of 1e-12, for colours in [0, 1]. W1 and W2 are sums of 12 Gaussians of
about one size, without contours, with hard and with soft ones; the others are fitted scenes of the zoo."""


def open_decoder(decoder: str, path: str, cutoff: float, size: tuple[int, int], count: int) -> Callable[[], Tensor]:
    """Open a decoder's file and return a function that renders (C, H, W) at this size."""
    if decoder == "onnxruntime":
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = count
        # otherwise idle threads keep spinning while the next decoder is timed
        options.add_session_config_entry("session.force_spinning_stop", "1")
        session = onnxruntime.InferenceSession(f"{path}-{cutoff:g}.onnx", options, providers=["CPUExecutionProvider"])
        feeds: dict[str, Any] = {"size": np.array(size, np.int64)}
        return lambda: torch.from_numpy(session.run(["image"], feeds)[0])[0]
    renderer, scene = RegionSplatRenderer(cutoff, backend=decoder.removeprefix("torch, ")), load(f"{path}.safetensors")
    return partial(torch.no_grad()(renderer), scene.field, scene.regions, size)


def open_and_render(*arguments: Any) -> Tensor:
    """Open a decoder and render one image."""
    return open_decoder(*arguments)()


def write_files(scene: Scene, path: str, cutoffs: tuple[float, ...]) -> None:
    """Write a scene and its decoders."""
    scene.save(f"{path}.safetensors")
    for cutoff in cutoffs:
        onnx.save(scene_decoder(scene, cutoff=cutoff, clamp=False), f"{path}-{cutoff:g}.onnx")


def measure(image: str, size: str, count: int, cutoffs: list[float], rounds: int) -> list[Row]:
    """Time the decoders of a scene in turns, on `count` threads."""
    scene, names, rows = scene_of(image), DECODERS if size == "native" else FAST, []
    target = size_of(scene, size)
    with TemporaryDirectory() as folder, threads(count):
        path, small = f"{folder}/scene", f"{folder}/small"
        write_files(scene, path, tuple(cutoffs))
        write_files(scene_of("W3 hard"), small, (DEFAULT_CUTOFF,))
        keys = [(decoder, cutoff) for decoder in names for cutoff in cutoffs]
        renders = {(d, c): open_decoder(d, path, c, target, count) for d, c in keys}
        times = milliseconds(renders, rounds)
        with torch.no_grad():
            renderer, exact_scene = RegionSplatRenderer(TRUTH_CUTOFF, backend="tiled"), copy.deepcopy(scene).double()
            exact = renderer(exact_scene.field, exact_scene.regions, target)
        for decoder, cutoff in keys:
            row = {"image": image, "size": size, "method": decoder, "threads": count, "cutoff": cutoff}
            row |= {"ms": times[decoder, cutoff], "error": float((renders[decoder, cutoff]() - exact).abs().max())}
            if count == 1 and cutoff == DEFAULT_CUTOFF:
                file = Path(f"{path}-{cutoff:g}.onnx" if decoder == "onnxruntime" else f"{path}.safetensors")
                start = partial(open_and_render, decoder, path, cutoff, target, 1)
                row |= {"load_ms": milliseconds({"": start}, rounds)[""], "bytes": file.stat().st_size}
                if rounds > 1:
                    arguments, first = (decoder, path, cutoff, target, 1), (decoder, small, cutoff, (48, 64), 1)
                    row["peak_MB"] = peak_megabytes(open_and_render, *arguments, warm_up=first)
            rows.append(row)
    return rows


def jobs(options: Options) -> list[Job]:
    """List the timings of decoders, for workloads and fitted scenes."""
    scenes = [f"{name} {contours}" for name in ("W1", "W2") for contours in ("none", "hard", "soft")]
    scenes = ["W3 hard"] if options.quick else [*scenes, *(f"{name} soft" for name in FITTED)]
    sizes, counts = (SIZES[:1], (1,)) if options.quick else (SIZES, (1, 2))
    return [
        {"image": scene, "size": size, "count": count, "rounds": 1 if options.quick else ROUNDS,
         "cutoffs": CUTOFFS if size == "native" and count == 1 and not scene.endswith("none") else (DEFAULT_CUTOFF,)}
        for scene in scenes for size in sizes for count in counts
    ]  # fmt: skip


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    default = [row for row in rows if row["cutoff"] == DEFAULT_CUTOFF]
    native = [row for row in rows if row["size"] == "native" and row["threads"] == 1]
    groups = {
        str(image): image_rows
        for (image,), image_rows in group_by(native, ["image"]).items()
        if len(group_by(image_rows, ["cutoff"])) > 1
    }
    panels = [Panel(image, image_rows, "ms", "error", ("log", "log")) for image, image_rows in groups.items()]
    save_lines(folder / "decode.png", panels, "method", "cutoff")
    columns = ("ms", "error", "load_ms", "bytes", "peak_MB")
    one_thread = [row for row in default if row["threads"] == 1]
    # times with hard contours or without contours differ little from times with soft contours
    shown = [row for row in one_thread if row["image"].endswith("soft")] or one_thread
    table = means_table(shown, ["image", "size", "method"], "", columns)
    times = {(r["image"], r["size"], r["method"]): r["ms"] for r in one_thread}
    ratios = {key[:2]: ms / times[*key[:2], "torch, cpu"] for key, ms in times.items() if key[2] == "onnxruntime"}
    spans = [
        f"{min(values):.2g} to {max(values):.2g} times as long at {SIZE_TITLES[size]}"
        for size in SIZES
        if (values := [ratio for (_, name), ratio in ratios.items() if name == size])
    ]
    error = max(values_of((row for row in one_thread if row["method"] == "onnxruntime"), "error"))
    answer = (
        f"On one core `onnxruntime` takes, beside `torch, cpu`, {' and '.join(spans)}. Its largest error at the "
        f"default cutoff is {error:.1g}."
    )
    slower = {key: ratio for key, ratio in ratios.items() if ratio > 1}
    worst = [" ".join(key) for key, ratio in slower.items() if ratio == max(slower.values())]
    losses = (
        f"`onnxruntime` is slower in {len(slower)} of {len(ratios)} cases; most in {', '.join(worst)}."
        if slower
        else ""
    )
    return Page(answer, "decode.png", table, losses, METHOD)
