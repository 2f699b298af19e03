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
those that others overlap; label maps, files of a given scene and renders by the CPU kernel kept their bits. Three
photos each of `maps`, `enlarge` and `previews` were measured again: the mean PSNR differs by at most 0.03 dB.

`python -m benchmarks quality -o report --data DATA --workers 2` measures the first anew, and goes on where it was
stopped. `DATA` has the folders `DAVIS`, `bsds`, `kodak` and `cocostuff`; without it photos of scikit-image are
measured. `--only` chooses images.
"""
# trees before `ebcceda`, of version 0.2
OLDER = ("8b2cd43", "6dcd323")
# measured with the authors' programs, which are not part of kcgs; rows of kcgs are from the reports gpu and gpu-fit
PEERS = f"""
## How fast are GaussianImage and Image-GS themselves?

Their own programs, as they were public in November 2026, were measured once on an H200, for as many iterations as the
table says. The photo is kodim05, with 10,000 Gaussians and without regions.

| program | iterations | seconds | PSNR, dB |
|---|---|---|---|
| GaussianImage | 1,000 / 5,000 / 27,600 | 1.6 / 8.9 / 50 | 19.85 / 28.08 / 29.65 |
| Image-GS | 1,000 / 5,000 / 10,000 | 3.5 / 17 / 34 | 15.5 / 28.1 / 28.8 |
| kcgs, `best` | 700 | 0.28 | 32.08 |

GaussianImage's CUDA rasterizer, without regions, rendered the scenes of [our report]({LINK}/gpu/report.md) on another
H200. Its gradients by two of the three numbers of a Cholesky factor were off by factors of 0.7 to 11 there; those of
kcgs are within 0.002 of exact ones at its default cutoff. Milliseconds of one image / of one image and its gradients:

| scene | GaussianImage | kcgs | kcgs, a CUDA graph |
|---|---|---|---|
| dog, N = 1,250 | 0.34 / 1.08 | 0.43 / 1.08 | 0.050 / 0.110 |
| dog, N = 7,500 | 0.33 / 1.10 | 0.43 / 0.94 | 0.084 / 0.160 |
| W2, N = 7,500 | 0.28 / 0.96 | 0.40 / 0.97 | 0.081 / 0.144 |
| kodim05, N = 10,000 | 0.35 / 0.98 | 0.22 / 0.75 | 0.084 / 0.161 |
| W4, N = 50,000, 2160 x 3840 | 0.81 / 2.62 | 0.93 / 1.72 | 0.816 / 1.66 |
"""
TAIL = """
## How figures are taken

- PSNR, MS-SSIM and SSIMULACRA2 are over the whole image. EF-PSNR is within 5 pixels of the contours of the map that was
  given or found, for every method alike.
- *Bytes* are those of the whole `.kcgs` file, map included. *At equal bits*, decoded files are compared with the
  other method's at as many bytes of the same image; its curve is interpolated by monotone cubics over the logarithm
  of the bytes.
- Differences are paired by image, above zero where the first has more. Intervals are 95 %, by bootstrap over images,
  widened for their small number; they are in `differences.csv`, and in the figures.
- Times are those of one processor core, where a report does not say otherwise; compilation is not in them.
- In the reports the recipes of GaussianImage's and Image-GS's papers run on the renderer of kcgs.

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
    return "\n".join([*sections, PEERS.lstrip("\n"), TAIL.format().lstrip("\n")])


if __name__ == "__main__":
    (REPORTS.parent.parent / "docs/results.md").write_text(page(), encoding="utf-8")
