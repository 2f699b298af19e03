"""Which of two images would viewers rather have in a photo's place?"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from random import Random

from PIL import Image, ImageDraw, ImageFont
from torch import cat
from torch.nn.functional import avg_pool2d

from kcgs import fit
from kcgs.data import save_image
from kcgs.functional import psnr, ssimulacra2
from kcgs.rate import fit_bytes
from kcgs.segment import segment

from .core.codecs import best_file
from .core.figures import save_shares
from .core.fits import QUICK_ITERATIONS
from .core.images import load, names, resize
from .core.run import Job, Options, Page, Row, write_rows
from .core.tables import group_by, markdown

BYTES = {f"{size} bytes": size for size in (1_000, 3_000, 8_000)}
ENLARGEMENT = "enlargement"
FACTOR = 4
# pixels of the small photo per Gaussian
SHARE = 80
OURS = "kcgs"
# for so many pairs there is one sheet with A and B swapped, and one sheet with the same image twice
PAIRS_PER_CHECK = 12
MIN_CHECKS = 2
# pixels of a sheet
CAPTION_HEIGHT = 36
GAP = 8
# examples: "07 B clearly: streaks", "| 7 | slightly A |", "07: none"
ANSWER = re.compile(
    r"\W*(?:sheet\W*)?(?P<sheet>\d+)\W+(?P<before>(?:clear|slight)\w*\W+)?(?:prefer\w*\W+)?"
    r"(?P<choice>A|B|none|no(?:\W+difference)?|neither|same|equal)\b(?P<after>\W+(?:clear|slight)\w*)?(?P<comment>.*)",
    re.IGNORECASE,
)
METHOD = f"""Files: `fit_bytes` with the map of `segment`, both with default settings, beside WebP or AVIF (speed 4)
of the photo or of the photo reduced to a half, a third or a quarter of each side, enlarged bicubically: of all files
of at most so many bytes the one with the highest SSIMULACRA2. Enlargement: the photo reduced {FACTOR} times by the
means of blocks, fitted with a Gaussian per {SHARE} pixels and the map of `segment`, rendered at the photo's size,
beside the render at the small size, enlarged bicubically. Photos are Kodak's with even numbers; those with odd
numbers, which settings may be tuned on, are chosen by `--only`, as are comparisons: `--only 'kodim01,kodim03,1000
bytes'`.

A sheet shows the photo, A and B at their own pixels; its name is a number. A seed chooses the order of sheets and
sides. Some pairs come again with sides swapped, some sheets show the same image twice. Sheets are made once: `sheets`
is for viewers, `key.json` is not, and the hash of the key, in `key.sha256`, is published before anyone looks. Viewers
know nothing but the sheets. Those of the committed report are three vision-language models that were asked to answer
as ordinary people would; nobody has asked people yet. Each one's answers, a line such as `07 B clearly: streaks` or
`08 none` per sheet, go into `answers/NAME.txt`, and `--redraw` counts them."""


def measure(image: str, comparison: str, folder: str, data: str, quick: bool) -> list[Row]:
    """Make both images of a pair, and write them beside the photo."""
    photo, iterations = load(image, data, quick).image, QUICK_ITERATIONS if quick else None
    row: Row = {"image": image, "comparison": comparison}
    if comparison == ENLARGEMENT:
        small, size = avg_pool2d(photo, FACTOR), (photo.shape[1], photo.shape[2])
        scene = fit(small, segment(small), round(small[0].numel() / SHARE), iterations=iterations).scene
        images = [scene.render(size), resize(scene.render(), size, "bicubic")]
        rows = [{**row, "method": OURS}, {**row, "method": "bicubic"}]
    else:
        row["target_bytes"] = BYTES[comparison]
        ours = fit_bytes(photo, segment(photo), BYTES[comparison], iterations=iterations)
        other = best_file(("WebP", "AVIF"), photo, BYTES[comparison])
        assert other is not None
        images = [ours.scene.render(), other.render]
        rows = [
            {**row, "method": OURS, "file": OURS, "bytes": len(ours.data)},
            {**row, "method": "WebP or AVIF", "file": other.name, "bytes": len(other.data)},
        ]
    Path(folder).mkdir(parents=True, exist_ok=True)
    save_image(_path(folder, rows[0]), cat([photo, *images], 2))
    return [
        {**row, "psnr": float(psnr(render, photo)), "ssimulacra2": float(ssimulacra2(render, photo))}
        for row, render in zip(rows, images, strict=True)
    ]


def _path(folder: str | Path, row: Row) -> Path:
    return Path(folder, f"{row['comparison']}, {row['image']}.png")


def jobs(options: Options) -> list[Job]:
    """List pairs of files and of enlargements, of the even numbers of Kodak unless `only` names others."""
    comparisons = [name for name in (*BYTES, ENLARGEMENT) if name in options.only]
    images = ["disc"]
    if not options.quick:
        kodak = names(options.folder(), "kodak")
        images = [name for name in kodak if name in options.only] or [name for name in kodak if int(name[-2:]) % 2 == 0]
    arguments = {"folder": str(options.output / "runs"), **options.image_arguments()}
    return [
        {"image": image, "comparison": comparison, **arguments}
        for image in images
        for comparison in comparisons or (*BYTES, ENLARGEMENT)
    ]


def make_sheets(folder: Path, rows: list[Row]) -> None:
    """Write numbered sheets, the key to them, and the key's hash."""
    seed = secrets.randbits(64)
    random = Random(seed)
    pairs = [random.sample(pair, 2) for pair in group_by(rows, ["comparison", "image"]).values()]
    count = min(len(pairs), max(MIN_CHECKS, len(pairs) // PAIRS_PER_CHECK))
    swapped = [pair[::-1] for pair in random.sample(pairs, count)]
    identical = [[random.choice(pair)] * 2 for pair in random.sample(pairs, count)]
    sheets = random.sample([*pairs, *swapped, *identical], len(pairs) + 2 * count)
    (folder / "sheets").mkdir()
    entries = []
    for number, sheet in enumerate(sheets, 1):
        with Image.open(_path(folder / "runs", sheet[0])) as file:
            width, height = file.width // 3, file.height
            columns = [0, *(1 if row["method"] == OURS else 2 for row in sheet)]
            images = [file.crop((i * width, 0, (i + 1) * width, height)) for i in columns]
        _save_sheet(folder / "sheets" / f"{number:02}.png", images)
        entry = {"sheet": number, "comparison": sheet[0]["comparison"], "image": sheet[0]["image"]}
        sides = [{name: row[name] for name in ("method", "file", "bytes") if name in row} for row in sheet]
        entries.append(entry | dict(zip("AB", sides, strict=True)))
    key = json.dumps({"seed": seed, "sheets": entries}, indent=1).encode()
    (folder / "key.sha256").write_text(f"{hashlib.sha256(key).hexdigest()}  key.json\n")
    (folder / "key.json").write_bytes(key)


def _save_sheet(path: Path, images: list[Image.Image]) -> None:
    width, height = images[0].size
    sheet = Image.new("RGB", (3 * width + 2 * GAP, height + CAPTION_HEIGHT), "white")
    canvas, font = ImageDraw.Draw(sheet), ImageFont.load_default(24)
    for index, (caption, image) in enumerate(zip(("photo", "A", "B"), images, strict=True)):
        left = index * (width + GAP)
        sheet.paste(image, (left, CAPTION_HEIGHT))
        canvas.text((left + width / 2, CAPTION_HEIGHT / 2), caption, "black", font, anchor="mm")
    sheet.save(path)


def read_answers(folder: Path, entries: list[Row]) -> Iterator[Row]:
    """Yield each viewer's answer to each sheet; if a viewer answers twice, the first answer counts."""
    for path in sorted(folder.glob("*.txt")):
        matches = filter(None, map(ANSWER.match, path.read_text(encoding="utf-8").splitlines()))
        answers = {int(match["sheet"]): match for match in [*matches][::-1]}
        pairs = set()
        for entry in entries:
            pair = entry["comparison"], entry["image"]
            kind = "identical" if entry["A"] == entry["B"] else "swapped" if pair in pairs else "pair"
            if kind == "pair":
                pairs.add(pair)
            if match := answers.get(entry["sheet"]):
                side = entry.get(match["choice"].upper())
                strength = "clearly" if "clear" in f"{match['before']}{match['after']}".lower() else "slightly"
                choice = f"{OURS if side['method'] == OURS else 'other'} {strength}" if side else "none"
                row = {"sheet": entry["sheet"], "comparison": pair[0], "image": pair[1], "viewer": path.stem}
                yield {**row, "kind": kind, "choice": choice, "comment": match["comment"].strip(" :;,.|-*()")}


def page(folder: Path, rows: list[Row]) -> Page:
    """Make the sheets, or count the answers and write the report."""
    if not (folder / "key.json").exists() and (folder / "runs").is_dir():
        make_sheets(folder, rows)
    entries = json.loads((folder / "key.json").read_text())["sheets"] if (folder / "key.json").exists() else []
    comparisons = [comparison for (comparison,) in group_by(rows, ["comparison"])]
    answers = sorted(
        read_answers(folder / "answers", entries), key=lambda row: (comparisons.index(row["comparison"]), row["viewer"])
    )
    pairs = [row for row in answers if row["kind"] == "pair"]
    by_pair = group_by(pairs, ["comparison", "image"])
    sentences, lines, losses = [], [], []
    for (comparison,), group in group_by(pairs, ["comparison"]).items():
        balances = {image: sum(map(_sign, votes)) for (name, image), votes in by_pair.items() if name == comparison}
        won, lost = (sum(sign * balance > 0 for balance in balances.values()) for sign in (1, -1))
        signs = Counter(map(_sign, group))
        sentences.append(f"{won} of {len(balances)} photos ({comparison})")
        line = [str(comparison), f"{won} of {len(balances)}", str(lost), *(str(signs[sign]) for sign in (1, -1, 0))]
        lines.append(line)
        losses += [(balance, str(comparison), str(image)) for image, balance in balances.items() if balance < 0]
    if answers:
        write_rows(folder / "answers.csv", answers)
    texts = [_loss(folder, by_pair[comparison, image]) for _, comparison, image in sorted(losses)]
    shares = {line[0]: [int(count) for count in line[3:]] for line in lines}
    save_shares(folder / "pairs.png", ("for kcgs", "for the other", "for none"), shares, "answers")
    published = f"The hash of the key is `{(folder / 'key.sha256').read_text().split()[0]}`."
    answer = (
        f"Most viewers preferred kcgs on {', '.join(sentences)}. The other image "
        "is a WebP or AVIF in as many bytes, or a bicubic enlargement."
        if answers
        else "Nobody has answered yet."
    )
    header = ["comparison", "kcgs preferred", "other preferred", "answers for kcgs", "for the other", "for none"]
    losses_text = markdown(["comparison", "photo", "what viewers said", "sheet"], texts) if texts else ""
    return Page(answer, "pairs.png", markdown(header, lines), losses_text, f"{METHOD} {published} {_checks(answers)}")


def _checks(answers: list[Row]) -> str:
    """Say how often each viewer's answers agree with sides swapped, and are none for equal images."""
    checks = []
    for (viewer,), group in group_by(answers, ["viewer"]).items():
        signs_of_pairs = {(row["comparison"], row["image"]): _sign(row) for row in group if row["kind"] == "pair"}
        swapped, identical = ([row for row in group if row["kind"] == kind] for kind in ("swapped", "identical"))
        alike = sum(signs_of_pairs.get((row["comparison"], row["image"])) == _sign(row) for row in swapped)
        none = sum(row["choice"] == "none" for row in identical)
        checks.append(f"{viewer} {alike} of {len(swapped)} and {none} of {len(identical)}")
    return f"The same answer with sides swapped, and none for equal images: {'; '.join(checks)}." if checks else ""


def _sign(answer: Row) -> int:
    return 0 if answer["choice"] == "none" else 1 if answer["choice"].startswith(OURS) else -1


def _loss(folder: Path, answers: list[Row]) -> list[str]:
    """Describe a lost pair, and write its sheet at half its size, unless the sheets are gone."""
    path = f"losses/{answers[0]['sheet']:02}.jpg"
    sheet_path = folder / "sheets" / f"{answers[0]['sheet']:02}.png"
    if sheet_path.exists():
        (folder / "losses").mkdir(exist_ok=True)
        with Image.open(sheet_path) as sheet:
            sheet.reduce(2).save(folder / path, quality=70)
    comments = "; ".join(row["comment"] for row in answers if row["comment"])
    return [answers[0]["comparison"], answers[0]["image"], comments, f"[photo, A, B]({path})"]
