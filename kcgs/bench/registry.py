"""Experiments by name."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from .core import registry as core
from .fits import Place

# the paper's, which share their options
_PAPER = ("charts", "davis", "ablation", "convergence")
_EXPERIMENTS = ("demo", "render", "fit", "maps", "decode", "rate", "zoo", *_PAPER)
# those that have groups to choose from
_GROUPED = ("fit", "decode", "rate", "zoo")
# those whose fits may run side by side
_PARALLEL = ("fit", "maps", *_PAPER)


def available_experiments() -> tuple[str, ...]:
    """Names that `kcgs bench` takes."""
    return _EXPERIMENTS


def run(
    name: str,
    output: Path,
    *,
    data: Path | None = None,
    quick: bool = False,
    only: str | None = None,
    engine: str = "local",
    workers: int | None = None,
    **settings: Any,
) -> None:
    """Run an experiment and write its report into the folder `output`, which is made if it is not there.

    Args:
        name: of the experiment.
        output: folder.
        data: folder with images, for the experiments that need it.
        quick: a short form of the same experiment.
        only: names of groups with commas between them, for the experiments that have groups; None: all.
        engine: local or ray, for the experiments whose fits may run side by side.
        workers: fits at a time; None: one locally, and on Ray what its processors allow.
        settings: sequences, budget_seconds, seeds, iterations, runs, for the paper's experiments, as in
            :class:`kcgs.bench.paper.options.Options`; None: not given.

    Raises:
        ValueError: unknown name or group; `only` for an experiment without groups, an engine or workers for one whose
            fits run one after another, settings for one that has none.
        OSError: the folder cannot be made.
    """
    if name not in _EXPERIMENTS:
        raise ValueError(f"name must be one of {', '.join(_EXPERIMENTS)}; got {name!r}")
    # experiments move to the core's registry one by one; this one goes when all have
    folder = "paper." if name in _PAPER else ""
    if isinstance(import_module(f"{__package__}.{folder}{name}").run, core.Experiment):
        given = {"data": data, "quick": quick, "only": only, "engine": engine, "workers": workers, **settings}
        core.run(name, output, **given)
        return
    if only is not None and name not in _GROUPED:
        raise ValueError(f"only is for experiments with groups ({', '.join(_GROUPED)}); got {only!r} for {name!r}")
    place = Place(engine, workers)
    if not place.is_here and name not in _PARALLEL:
        raise ValueError(f"engine and workers are for {', '.join(_PARALLEL)}; {name!r} runs one after another")
    given = {key: value for key, value in settings.items() if value is not None}
    if given and name not in _PAPER:
        raise ValueError(f"{', '.join(given)} are for {', '.join(_PAPER)}; got {given} for {name!r}")
    output.mkdir(parents=True, exist_ok=True)
    if name in _PAPER:
        from .paper.options import Options

        options = Options(data=data, quick=quick, place=place, **given)
        import_module(f"{__package__}.paper.{name}").run(output, options)
        return
    choice: dict[str, Any] = {} if only is None else {"only": only}
    if name in _PARALLEL:
        choice["place"] = place
    import_module(f"{__package__}.{name}").run(output, data=data, quick=quick, **choice)
