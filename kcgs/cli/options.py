"""Options that several commands share: the fit that they request, label maps, sizes of renders."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from kcgs._objectives import PURPOSES, check_objective
from kcgs._progress import Progress
from kcgs.errors import InvalidArgument

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from kcgs.fitting import FitConfig
    from kcgs.scene import Scene

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")]
ResizeRegions = Annotated[
    bool, typer.Option("--resize-regions", help="Resize a label map of another size to that of the image.")
]
Threshold = Annotated[
    float | None,
    typer.Option(min=0, help="Of a mask with soft edges: grey level above which a pixel is of the object."),
]
# least shorter side of an image that --regions auto segments, in pixels: smaller images seldom gain by regions
LEAST_SIDE = 64
IF_LARGE = f"if no side is below {LEAST_SIDE} pixels"
_FILES = PURPOSES["file of a size"]
Objective = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(PURPOSES["fit"]),
        callback=check_objective,
        help="What to lower: the squared or the absolute error, or what MS-SSIM lacks. "
        f"Default: {PURPOSES['fit'][0]}; with --target-bytes {_FILES[0]}. Files take {' or '.join(_FILES)}.",
    ),
]


class FitRequest(NamedTuple):
    """The options of a fit besides the image and its regions."""

    num_gaussians: int | None
    """None: chosen by the size of the image."""
    target_bytes: int | None
    """Largest size of a `.kcgs` file; it determines the number of Gaussians."""
    recipe: str
    settings: dict[str, Any]
    """Settings in place of the recipe's."""
    seed: int
    device: str
    """Device of the fit."""
    is_grey: bool = False
    """Fit only the luma, one channel."""

    @property
    def default_suffix(self) -> str:
        """Suffix of the file if no output is given."""
        return ".safetensors" if self.target_bytes is None else ".kcgs"

    def count_for(self, height: int, width: int) -> int:
        """Return the number of Gaussians for an image of this size."""
        from kcgs.fitting import default_num_gaussians

        return self.num_gaussians or default_num_gaussians(height, width)

    def load_config(self) -> FitConfig:
        """Return the recipe with these settings; raise a ValueError that names a wrong setting."""
        from kcgs.fitting import FitConfig

        return FitConfig.from_recipe(self.recipe, **self.settings)

    def load_image(self, path: Path) -> Tensor:
        """Read an image with the channels of the fit."""
        from kcgs.data import load_image

        return load_image(path, channels="L" if self.is_grey else "RGB")

    def load_device(self) -> torch.device:
        """Return the device; raise a ValueError if torch has no device of this name."""
        import torch

        try:
            device = torch.device(self.device)
            torch.empty(0, device=device)
        except (RuntimeError, AssertionError) as error:  # torch without CUDA raises AssertionError
            raise InvalidArgument("device", "one that torch has, such as cpu or cuda", repr(self.device)) from error
        return device


def fit_request(
    num_gaussians: Annotated[
        int | None,
        typer.Option(
            "-n", "--num-gaussians", min=1, help="Number of Gaussians; default: 1 per 100 pixels, at least 100."
        ),
    ] = None,
    recipe: Annotated[str, typer.Option(help="Recipe by name.")] = "best",
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Default: the recipe's, or as many as --max-seconds has time for.")
    ] = None,
    objective: Objective = None,
    max_seconds: Annotated[float | None, typer.Option(help="Wall time of the fit.")] = None,
    target_psnr: Annotated[
        float | None, typer.Option(help="About as few Gaussians as reach this PSNR in dB, at most --num-gaussians.")
    ] = None,
    target_bytes: Annotated[
        int | None,
        typer.Option(min=40, help="The best .kcgs file that is not larger; chooses the number of Gaussians."),
    ] = None,
    keep_contours: Annotated[
        bool,
        typer.Option("--keep-contours", help="Keep the label map: no contour moves, no region is merged."),
    ] = False,
    min_sigma: Annotated[
        float | None,
        typer.Option(help="Least standard deviation of a Gaussian in pixels: more is softer, and has no stray lines."),
    ] = None,
    bounded: Annotated[
        bool,
        typer.Option("--bounded", help="Centres within the image, factors below its side, colours in [-1, 2]."),
    ] = False,
    grey: Annotated[bool, typer.Option("--grey", help="Fit one channel, the luma, in place of three.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of the random start.")] = 0,
    device: Annotated[str, typer.Option(help="Where to fit: cpu, or cuda for a GPU.")] = "cpu",
) -> FitRequest:
    """Return the request that the options describe."""
    if target_bytes is not None:
        exclude("--target-bytes", num_gaussians=num_gaussians, target_psnr=target_psnr)
    settings: dict[str, Any] = {
        "iterations": iterations, "objective": objective, "max_seconds": max_seconds, "target_psnr": target_psnr,
        "min_sigma": min_sigma, "bounded": bounded or None,
    }  # fmt: skip
    settings = {key: value for key, value in settings.items() if value is not None}
    if keep_contours:
        settings |= {"move_contours": False, "merge_regions": False}
    return FitRequest(num_gaussians, target_bytes, recipe, settings, seed, device, grey)


def with_fit_options(command: Callable[..., None], *, without: tuple[str, ...] = ()) -> Callable[..., None]:
    """Replace a command's argument `request` by the options of `fit_request`, except those in `without`.

    Typer reads options from a function's signature and has no groups of options, so this function builds a signature.
    """
    fit_options = dict(inspect.signature(fit_request, eval_str=True).parameters)
    for name in without:
        del fit_options[name]
    parameters: list[inspect.Parameter] = []
    for name, parameter in inspect.signature(command, eval_str=True).parameters.items():
        parameters.extend(fit_options.values() if name == "request" else [parameter])

    def run(**arguments: Any) -> None:
        command(request=fit_request(**{name: arguments.pop(name) for name in fit_options}), **arguments)

    run.__doc__, run.__annotations__ = command.__doc__, {}
    keywords = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]
    run.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    return run


def exclude(cause: str, **options: object) -> None:
    """Refuse options that have no meaning together with `cause`, another option or an argument."""
    for name, value in options.items():
        if value is not None:
            raise InvalidArgument(name, f"left out with {cause}", value)


def target_size(scene: Scene, scale: float | None, size: str | None) -> tuple[int, int]:
    """Return the (height, width) of --scale or --size; refuse sizes that do not fit into memory."""
    from kcgs._check import check_number
    from kcgs.scene import check_render_memory

    if size is not None:
        exclude("--size", scale=scale)
        width, _, height = size.partition("x")
        if not (width.isdigit() and height.isdigit()):
            raise InvalidArgument("size", "WxH, such as 640x480", repr(size))
        sides = int(height), int(width)
    else:
        factor = check_number("scale", 1.0 if scale is None else scale, 0.0, 1e6, above=True)
        sides = max(1, round(scene.size[0] * factor)), max(1, round(scene.size[1] * factor))
    check_render_memory(scene, sides)
    return sides


def read_regions(
    regions: str, image: Tensor, threshold: float | None = None, *, resize: bool = False, progress: bool = False
) -> Tensor | None:
    """Return the label map of the option --regions, or None; `resize`: at the size of the image."""
    if regions in ("auto", "none"):
        exclude(f"--regions {regions}", threshold=threshold)
    if regions == "none":
        return None
    if regions == "auto":
        if min(image.shape[-2:]) < LEAST_SIDE:
            return None
        from kcgs.segment import segment

        with Progress("finding regions", pulse=True, visible=progress):
            return segment(image)
    from kcgs.data import load_labels

    labels, size = load_labels(Path(regions), threshold=threshold), (image.shape[-2], image.shape[-1])
    if tuple(labels.shape) == size:
        return labels
    if not resize:
        expected = f"one map of the image's size, {size[1]} x {size[0]}, which --resize-regions makes of it"
        raise InvalidArgument("regions", expected, f"{labels.shape[-1]} x {labels.shape[-2]}")
    from kcgs.maps import RegionMap

    return RegionMap(labels).resize(size).labels
