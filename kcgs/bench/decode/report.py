"""From rows to a report with tables and figures."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path

from kcgs._atomic import atomic_path
from kcgs.bench.cells import markdown
from kcgs.bench.machine import describe

from .decoders import DECODERS, GENERIC, SCENE, TRUTH_CUTOFF, YARDSTICK, Files
from .figures import plot_speed, plot_sweep
from .findings import Findings, cutoff_name

_SCENES_TEXT = """Contours are `none` (one region), `hard`, or `soft`. The workloads' soft contours have a standard
deviation of 0.7 pixels."""
_SPEED_TEXT = """Milliseconds for one picture, medians; all decoders of a scene are timed in turns in one process, on
one thread and on two, at the default cutoff of 1e-4. `to cpu` is the median of the ratios to torch's `cpu` kernel on
as many threads in the same round. torch's kernels and the generic decoder are given the Gaussians scaled and the
label map sampled for the size that is drawn, once for all pictures; the scene decoder does both in every picture.
Errors are against float64, colours in [0, 1]; values of the workloads' pictures go up to about 5, since they are sums
of 12 Gaussians."""
_GOAL_TEXT = """What a scene decoder ought to reach: on one thread at the scene's own size at most 10 ms at N = 1,250
and 16 ms at N = 7,500, at most 3 times the `cpu` kernel's time, loaded in under 500 ms, at most 2.5 times the scene's
bytes. Milliseconds are those of this machine."""
_FILES_TEXT = """`ratio` is the scene decoder's bytes over the scene's. The generic decoder is one file for all scenes
and needs the scene beside it. `export` is the time to make and write both decoders and the scene. Loading goes from
the files on disk to being ready to draw, onnxruntime's optimisation of the graph, scaling and sampling the label map
included; the first picture is loading and one drawing. One thread, medians."""
_MEMORY_TEXT = """MB added at the peak by loading and drawing one picture, on one thread, each in a process of its own
that has drawn a small scene before. At another size that includes sampling the label map, for all but the scene
decoder."""
_SWEEP_TEXT = """One thread, the scene's own size, cutoffs of 1e-2, 1/255, 1e-3, 1e-4 and 1e-6; all timed in turns.
Left and below is better."""
_LEFT_OUT_TEXT = "What each decoder says that it does without."

GOALS = {"W1": 10.0, "W2": 16.0}
_MOST = {"to cpu": 3.0, "load": 500.0, "ratio": 2.5}


def describe_files(files: Mapping[str, Files]) -> dict[str, list[str]]:
    """Read from decoders what they leave out."""
    import onnx

    paths = {name: made.decoder for name, made in files.items()}
    paths[GENERIC] = next(iter(files.values())).generic
    said = {}
    for name, path in paths.items():
        notes = {entry.key: entry.value for entry in onnx.load(path, load_external_data=False).metadata_props}
        said[name] = json.loads(notes["left_out"])
    return said


def write(output: Path, found: Findings) -> None:
    """Write report.md and its figures into the folder."""
    plot_sweep(found, output / "error-against-time.png")
    plot_speed(found, output / "speed.png")
    parts = ["# Decoding: speed, error, memory, bytes"]
    options = (" --quick" if found.quick else "") + ("" if found.quick or found.missing else " --data DIR")
    parts.append(f"Made by `kcgs bench decode -o DIR{options}`.")
    versions = "; ".join(f"{name} {version(name)}" for name in ("onnxruntime", "onnx", "onnx-ir"))
    waiting = f"OMP_WAIT_POLICY: {os.environ.get('OMP_WAIT_POLICY', 'not set')}"  # what torch's idle threads do
    parts.append("\n".join(f"- {line}" for line in [*describe(), versions, waiting]))
    if found.quick:
        parts.append("The short form, small scenes and one round: the numbers only show that all of it runs.")
    if found.missing is not None:
        parts.append(f"Without fitted scenes: {found.missing}.")
    parts += ["## Scenes", _SCENES_TEXT, _scenes(found)]
    parts += ["## Speed and error", _SPEED_TEXT, _truth(found), "![](speed.png)", _speed(found)]
    if not found.quick:
        parts += ["## The scene decoder's goals", _GOAL_TEXT, _goals(found)]
    parts += ["## Error against time", _SWEEP_TEXT, "![](error-against-time.png)", _sweep(found)]
    parts += ["## Files and loading", _FILES_TEXT, _bytes(found), _loading(found)]
    parts += ["## Peak memory", _MEMORY_TEXT, _memory(found)]
    parts += ["## Left out by the decoders", _LEFT_OUT_TEXT, _left_out(found)]
    with atomic_path(output / "report.md") as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")


def _number(value: float | None) -> str:
    if value is None or math.isnan(value):
        return ""
    if value == 0 or abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.1e}" if abs(value) < 0.01 else f"{value:.3g}"


def _scenes(found: Findings) -> str:
    lines = []
    for scene in found.scenes:
        regions = 1 if scene.regions is None else scene.regions.num_regions
        size = f"{scene.size[0]} x {scene.size[1]}"
        lines.append([scene.name, size, f"{len(scene.field):,}", str(regions), scene.contours, scene.source])
    return markdown(["scene", "height x width", "N", "regions", "contours", "made"], lines)


def _truth(found: Findings) -> str:
    differences = ", ".join(f"{_number(r.value)} ({r.scene})" for r in found.rows if r.section == "truth")
    return (
        f"The truth is the `tiled` kernel in float64 at a cutoff of {TRUTH_CUTOFF:.0e}. From `reference`, the dense "
        f"sum in float64 at cutoff 0, it differs by at most {differences}."
    )


def _speed(found: Findings) -> str:
    header = [
        "scene",
        "size",
        "decoder",
        "ms",
        "to cpu",
        "ms, 2 threads",
        "to cpu, 2 threads",
        "max error",
        "rms error",
    ]
    lines = []
    for scene in found.names("speed", "scene"):
        for size in found.names("speed", "size"):
            for name in found.names("speed", "decoder"):
                value = partial(found.value, "speed", scene, size, name)
                cells = [value(q, threads=n) for n in (1, 2) for q in ("time", "to cpu")]
                cells += [value("max error"), value("rms error")]
                if cells[0] is not None:
                    lines.append([scene, size, name, *map(_number, cells)])
    return markdown(header, lines)


def _goals(found: Findings) -> str:
    lines = []
    for scene in found.scenes:
        values = {q: found.value("speed", scene.name, "native", SCENE, q) or math.nan for q in ("time", "to cpu")}
        values["load"] = found.value("files", scene.name, "native", SCENE, "load") or math.nan
        values["ratio"] = _ratio(found, scene.name)
        # a fit has a few Gaussians fewer than it was asked for
        most = {"time": GOALS["W1" if len(scene.field) <= 1_250 else "W2"], **_MOST}
        cells = [f"{_number(values[q])} ({'met' if values[q] <= most[q] else 'missed'})" for q in most]
        lines.append([scene.name, *cells])
    return markdown(["scene", "ms", "to cpu", "load, ms", "bytes to scene"], lines)


def _sweep(found: Findings) -> str:
    lines = []
    for scene in found.names("error", "scene"):
        for name in found.names("error", "decoder"):
            for cutoff in found.names("error", "cutoff"):
                value = partial(found.value, "error", scene, "native", name, cutoff=cutoff)
                cells = [_number(value(q)) for q in ("time", "to cpu", "max error", "rms error")]
                lines.append([scene, name, cutoff_name(cutoff), *cells])
    return markdown(["scene", "decoder", "cutoff", "ms", "to cpu at that cutoff", "max error", "rms error"], lines)


def _ratio(found: Findings, scene: str) -> float:
    own, plain = (found.value("files", scene, "native", name, "size") or math.nan for name in (SCENE, YARDSTICK))
    return own / plain


def _bytes(found: Findings) -> str:
    lines = []
    for scene in found.names("files", "scene"):
        sizes = [found.value("files", scene, "native", name, "size") for name in (YARDSTICK, SCENE, GENERIC)]
        export = found.value("files", scene, "native", SCENE, "export")
        lines.append([scene, *map(_number, [*sizes[:2], _ratio(found, scene), sizes[2], export])])
    return markdown(["scene", "scene, bytes", "scene decoder", "ratio", "generic decoder", "export, ms"], lines)


def _loading(found: Findings) -> str:
    quantities = ("load", "first picture")
    sizes = found.names("speed", "size")
    lines = []
    for scene in found.names("files", "scene"):
        for name in DECODERS:
            cells = [found.value("files", scene, size, name, q) for size in sizes for q in quantities]
            if cells[0] is not None:
                lines.append([scene, name, *map(_number, cells)])
    return markdown(["scene", "decoder", *(f"{q}, ms, {size}" for size in sizes for q in quantities)], lines)


def _memory(found: Findings) -> str:
    names = found.names("memory", "decoder")
    lines = [
        [scene, size, *(_number(found.value("memory", scene, size, name, "peak")) for name in names)]
        for scene in found.names("memory", "scene")
        for size in found.names("memory", "size")
    ]
    return markdown(["scene", "size", *names], lines)


def _left_out(found: Findings) -> str:
    parts = []
    for name, said in found.left_out.items():
        title = GENERIC if name == GENERIC else f"{SCENE}: {name}"
        parts.append(f"- {title}\n" + "\n".join(f"    - {sentence}" for sentence in said))
    return "\n".join(parts)
