"""`python -m benchmarks NAME -o DIR`."""

import argparse
from pathlib import Path

from . import available_experiments, run

parser = argparse.ArgumentParser("python -m benchmarks", description="Run an experiment and write its report.")
parser.add_argument("name", choices=available_experiments())
parser.add_argument("-o", "--output", type=Path, required=True, help="folder for the report")
parser.add_argument("--data", type=Path, help="folder with images, where the experiment needs them")
parser.add_argument("--quick", action="store_true", help="a short form of the same")
parser.add_argument("--only", help="parts to run, with commas between, where it has parts")
parser.add_argument("--workers", type=int, help="fits at a time; default: 1")
parser.add_argument("--sequences", help="of DAVIS, with commas between; default: all")
parser.add_argument("--budget-seconds", type=float, help="as many fits as this time allows")
parser.add_argument("--seeds", type=int, help="fits with so many seeds each")
parser.add_argument("--iterations", type=int, help="of the published recipes")
parser.add_argument("--redraw", action="store_true", help="write the report again from the results in the folder")
parser.add_argument("--runs", type=Path, help="folder of the fits, which experiments may share")

if __name__ == "__main__":
    run(**vars(parser.parse_args()))
