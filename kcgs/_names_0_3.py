"""Names of version 0.3, and what to write in their place: the errors of unknown names say it."""

_IMAGE_GS = "in benchmarks/core/image_gs.py of the repository"

SETTINGS = {
    "loss": "it is objective now, with the same values",
    "densify": "it is an argument of fit, an event of your own; None is matching pursuit, and 'largest-error' is "
    + _IMAGE_GS,
}
PROPERTIES = {"num_iterations": "planned_iterations", "max_iterations": "iteration_limit"}  # of a FitConfig
OBJECTIVES = {
    "psnr": "which is now 'l2'",
    "auto": "which is now the default: leave it out",
    "l1+ssim": f"which is now {_IMAGE_GS}",
}
# of other settings, and recipes
VALUES = dict.fromkeys(("image-gs", "gradient", "adam"), f"which is now {_IMAGE_GS}")


def describe(value: object, names: dict[str, str] = VALUES) -> str:
    """Return the text of a value for a message; a value of 0.3 is followed by what replaced it."""
    return f"{value!r}, {names[value]}" if isinstance(value, str) and value in names else repr(value)
