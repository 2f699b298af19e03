"""The page of results: the question, the answer and the figure of every report."""

from __future__ import annotations

import json
import re
from pathlib import Path

from .core.run import RUN_FILE

REPORTS = Path(__file__).parent / "reports"
# as seen from docs/
LINK = "../benchmarks/reports"
HEAD = """# Results

Each answer links to a report of one page: its table, its losses, its command, and the tree of `kcgs/` that was
measured. Since the tree `ebcceda` of 27 November 2026 renders, fits and files have the same bits, by the values in
`tests/golden`. Some reports say that they are older. After them fits began to add Gaussians in rounds, and to remove
those that others overlap; label maps, files of a given scene and renders by the CPU kernel kept their bits.

`python -m benchmarks quality -o report --data DATA --workers 2` measures the first anew, and goes on where it was
stopped. `DATA` has the folders `DAVIS`, `bsds`, `kodak` and `cocostuff`; without it photos of scikit-image are
measured. `--only` chooses images.
"""
# trees before `ebcceda`, of version 0.2
OLDER = ("8b2cd43", "6dcd323")
TAIL = """## How figures are taken

- PSNR, MS-SSIM and SSIMULACRA2 are over the whole image. EF-PSNR is within 5 pixels of the contours of the map that was
  given or found, for every method alike.
- *Bytes* are those of the whole `.kcgs` file, map included. *At equal bits*, decoded files are compared with the
  other method's at as many bytes of the same image; its curve is interpolated by monotone cubics over the logarithm
  of the bytes.
- Differences are paired by image, above zero where the first has more. Intervals are 95 %, by bootstrap over images,
  widened for their small number; they are in `differences.csv`, and in the figures.
- Times are those of one processor core, where a report does not say otherwise; compilation is not in them.
- In the reports the recipes of GaussianImage's and Image-GS's papers run on the renderer of kcgs.

```{toctree}
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
    sections = [HEAD]
    for name, run in runs.items():
        text = (REPORTS / name / "report.md").read_text(encoding="utf-8")
        match = re.match(r"# (?P<question>.*)\n\n(.*\n\n)??(?P<answer>.+)\n\n!\[\]\((?P<figure>.*)\)", text)
        assert match is not None, name
        question, answer, figure = match["question"], match["answer"], match["figure"]
        note = "Measured with an older tree. " if run["tree"].startswith(OLDER) else ""
        note += f"{run['note']} " if run["note"] else ""
        link, image = f"[Report]({LINK}/{name}/report.md)", f"![{question}]({LINK}/{name}/{figure})"
        sections.append(f"## {question}\n\n{answer} {note}{link}\n\n{image}\n")
    return "\n".join([*sections, TAIL])


if __name__ == "__main__":
    (REPORTS.parent.parent / "docs/results.md").write_text(page(), encoding="utf-8")
