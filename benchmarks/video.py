"""How good, calm and fast is the fit of a video, beside fits of its frames alone?"""

from __future__ import annotations

import time
from itertools import islice, pairwise
from pathlib import Path
from statistics import fmean

from torch import Tensor

from kcgs import FitConfig, fit
from kcgs.fitting import precompile
from kcgs.functional import ef_psnr, psnr
from kcgs.video import fit_video, read_label_maps, read_video

from .core.compare import Comparison, differences, losses_table, mean_gain
from .core.figures import Panel, save_lines
from .core.fits import QUICK_ITERATIONS
from .core.images import load
from .core.run import Job, Options, Page, Row
from .core.tables import means_table, values_of

NUM_GAUSSIANS = 1_250
NUM_FRAMES = 24
QUICK_FRAMES = 3
VIDEO, ALONE = "video", "frames alone"
COMPARISON = Comparison(VIDEO, ALONE)
QUANTITIES = ("psnr", "ef_psnr", "flicker", "core_seconds")
METHOD = f"""The first {NUM_FRAMES} frames of sequences of DAVIS with the given masks, N = {NUM_GAUSSIANS:,} in each.
`{VIDEO}` is `kcgs.video.fit_video`, `{ALONE}` is `kcgs.fit` of each frame. Flicker is the mean over pixels and frames
of how much the step from a frame to the next differs between render and video, in levels of 8 bits. Times are of one
core, per frame. The figure follows the PSNR along the frames, in the mean over sequences."""


def measure(image: str, n: int, data: str, quick: bool) -> list[Row]:
    """Fit a sequence as a video and frame by frame; return a row for each frame."""
    frames, maps = read_sequence(image, data, quick)
    count, length = len(frames), {"iterations": QUICK_ITERATIONS} if quick else {}
    config, rows = FitConfig.from_recipe("best", **length), []
    precompile(config)
    for method in COMPARISON:
        start = time.process_time()
        if method == VIDEO:
            scenes = fit_video(frames, maps, n, recipe=config)
            renders = [scenes[t].render() for t in range(count)]
        else:
            renders = [
                fit(frame, labels, n, recipe=config).scene.render() for frame, labels in zip(frames, maps, strict=True)
            ]
        seconds = (time.process_time() - start) / count
        flicker = fmean(map(difference_of_steps, pairwise(renders), pairwise(frames)))
        for t, (render, frame, labels) in enumerate(zip(renders, frames, maps, strict=True)):
            row = {"image": image, "method": method, "frame": t, "core_seconds": seconds, "flicker": flicker}
            rows.append(row | {"psnr": float(psnr(render, frame)), "ef_psnr": float(ef_psnr(render, frame, labels))})
    return rows


def read_sequence(image: str, data: str, quick: bool) -> tuple[list[Tensor], list[Tensor]]:
    """Read a sequence and its maps; the quick form makes a moving disc."""
    if quick:
        sample = load(image, data, quick)
        assert sample.labels is not None
        steps = range(QUICK_FRAMES)
        return [sample.image.roll(t, -1) for t in steps], [sample.labels.roll(t, -1) for t in steps]
    frames = read_video(Path(data, "DAVIS/JPEGImages/480p", image))
    maps = read_label_maps(Path(data, "DAVIS/Annotations/480p", image))
    return list(islice(frames, NUM_FRAMES)), list(islice(maps, NUM_FRAMES))


def difference_of_steps(renders: tuple[Tensor, Tensor], frames: tuple[Tensor, Tensor]) -> float:
    """Return the mean difference between changes of renders and changes of frames, in 8-bit levels."""
    steps = [after.clamp(0, 1) - before.clamp(0, 1) for before, after in (renders, frames)]
    return 255 * float((steps[0] - steps[1]).abs().mean())


def jobs(options: Options) -> list[Job]:
    """List the sequences of DAVIS that have enough frames."""
    if options.quick:
        return [{"image": "disc", "n": 40, **options.image_arguments()}]
    folders = sorted((options.folder() / "DAVIS/JPEGImages/480p").iterdir())
    sequences = [path.name for path in folders if len(list(path.glob("*.jpg"))) >= NUM_FRAMES]
    return [{"image": name, "n": NUM_GAUSSIANS, **options.image_arguments()} for name in sequences]


def page(folder: Path, rows: list[Row]) -> Page:
    """Write the report."""
    panels = [Panel("", rows, "frame", quantity, ("linear", "linear")) for quantity in ("psnr", "ef_psnr")]
    save_lines(folder / "video.png", panels, "method", "frame", marker=False)
    psnr, ef_psnr = (mean_gain(rows, COMPARISON, quantity) for quantity in ("psnr", "ef_psnr"))
    times, flickers = (
        [fmean(values_of((row for row in rows if row["method"] == name), quantity)) for name in COMPARISON[::-1]]
        for quantity in ("core_seconds", "flicker")
    )
    answer = (
        f"The fit of a video has {psnr:+.2f} dB PSNR and {ef_psnr:+.2f} dB EF-PSNR against fits of "
        f"its frames alone, and is {times[0] / times[1]:.1f} times as fast. Flicker is {flickers[1]:.2f} of 255 "
        f"levels, against {flickers[0]:.2f}. Only its Gaussians can be followed from frame to frame."
    )
    table = means_table(rows, ["image", "method"], "", QUANTITIES)
    losses = losses_table(rows, [COMPARISON], QUANTITIES, [])
    return Page(answer, "video.png", table, losses, METHOD, differences(rows, [COMPARISON], QUANTITIES, []))
