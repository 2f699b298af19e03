"""The page of results: the question, the answer and the figure of every report."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path

from .core.run import RUN_FILE

REPORTS = Path(__file__).parent / "reports"
# as seen from docs/
LINK = "../benchmarks/reports"
HEAD = """# Results

Each answer links to a report of one page: its table, its losses, and its command. All but those that say so were
measured with one tree of `kcgs/`, `{tree}`. Later changes concern GPUs, compilation, messages, and images of which a
quarter of the values are 0 or 1: all other results are the same bits on a CPU.
`python -m benchmarks quality -o report --data DATA --workers 2` measures the first anew, and goes on where it was
stopped. `DATA` has the folders `DAVIS`, `bsds`, `kodak` and `cocostuff`; without it photos of scikit-image are
measured. `--only` chooses images.
"""
TAIL = """
## How figures are taken

- PSNR, MS-SSIM and SSIMULACRA2 are over the whole image. EF-PSNR is within 5 pixels of the contours of the given map,
  for every method alike.
- *Bytes* are those of the whole `.kcgs` file, map included. *At equal bits*, decoded files are compared with the
  other method's at as many bytes of the same image; its curve is interpolated by monotone cubics over the logarithm
  of the bytes.
- Differences are paired by image, above zero where the first has more. Intervals are 95 %, by bootstrap over images,
  widened for their small number; they are in `differences.csv`, and in the figures.
- Times are those of one processor core, where a report does not say otherwise; compilation is not in them.
- gsplat, GaussianImage and Image-GS need CUDA, so their own programs are in no table: the recipes of their papers run
  on the renderer of kcgs.

```{{toctree}}
:hidden:
:glob:

benchmarks/reports/*/report
```
"""


def page() -> str:
    """Make the page from the committed reports."""
    from .__main__ import EXPERIMENTS

    paths = {name: REPORTS / name / RUN_FILE for name in EXPERIMENTS}
    runs = {name: json.loads(path.read_text(encoding="utf-8")) for name, path in paths.items() if path.exists()}
    tree = Counter(run.get("tree", "") for run in runs.values()).most_common(1)[0][0]
    sections = [HEAD.format(tree=tree)]
    for name, run in runs.items():
        text = (REPORTS / name / "report.md").read_text(encoding="utf-8")
        match = re.match(r"# (?P<question>.*)\n\n(.*\n\n)??(?P<answer>.+)\n\n!\[\]\((?P<figure>.*)\)", text)
        assert match is not None, name
        question, answer, figure = match["question"], match["answer"], match["figure"]
        note = "" if run.get("tree") == tree else "Measured with another tree. "
        note += f"{run['note']} " if run["note"] else ""
        link, image = f"[Report]({LINK}/{name}/report.md)", f"![{question}]({LINK}/{name}/{figure})"
        sections.append(f"## {question}\n\n{answer} {note}{link}\n\n{image}\n")
    return "\n".join([*sections, TAIL.format().lstrip("\n")])


if __name__ == "__main__":
    (REPORTS.parent.parent / "docs/results.md").write_text(page(), encoding="utf-8")
