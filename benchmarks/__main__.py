"""The command `python -m benchmarks`."""

import argparse
from importlib import import_module
from pathlib import Path
from types import ModuleType

from .core.run import Options, run_experiment

# modules of this package with `jobs`, `measure` and `page`
EXPERIMENTS = (
    "quality", "convergence", "clock", "published", "ablation", "rate", "pairs", "previews", "maps", "labels",
    "enlarge", "objects", "fill", "video", "batch", "many", "loading", "render", "gpu", "gpu-fit", "decode",
)  # fmt: skip


def module_of(name: str) -> ModuleType:
    """Import the module of an experiment, whose name has "_" for "-"."""
    return import_module(f"benchmarks.{name.replace('-', '_')}")


def main(arguments: list[str] | None = None) -> None:
    """Run an experiment, or make the zoo."""
    parser = argparse.ArgumentParser("python -m benchmarks", description="Run an experiment and write its report.")
    parser.add_argument("name", choices=(*EXPERIMENTS, "zoo"))
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder; the same command goes on in it")
    parser.add_argument("--data", type=Path, help="folder with DAVIS, bsds, kodak or cocostuff in it")
    parser.add_argument("--quick", action="store_true", help="a short form, which shows only that all of it runs")
    parser.add_argument("--only", type=lambda text: tuple(text.split(",")), default=(), help="images: a,b")
    parser.add_argument("--workers", type=int, default=1, help="processes; timings need one")
    parser.add_argument("--redraw", action="store_true", help="only write the report, from the results in the folder")
    values = vars(parser.parse_args(arguments))
    name, options = values.pop("name"), Options(**values)
    module = module_of(name)
    try:
        if name == "zoo":
            module.make_zoo(options)
        else:
            run_experiment(name, options, module.jobs, module.measure, module.page)
    except (ValueError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
