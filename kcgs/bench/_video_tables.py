"""What a clip has over single files and other codecs: means by sequence, goals, and the tables of bench video."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from ._video_runs import AS_IT_IS, BETWEEN, BYTES, CLIP, CODECS, MEAN, MEAN_PHOTO, QUALITY, VARIANTS, Shot
from .core.statistics import mean, summarize
from .core.tables import count, db, markdown, number, signed

# dB that is neither a win nor a loss
TIE = 0.005
_FLICKER = {
    "flicker": "flicker",
    "flicker_inside": "inside regions",
    "flicker_contours": "along contours",
    "flicker_followed": "along the motion",
}
_QUALITIES = {"psnr": "PSNR", "ef_psnr": "EF-PSNR"}
# by sequence
Values = Mapping[str, float]


class Results:
    """Frames by sequence, N and method."""

    def __init__(self, shots: Iterable[Shot]) -> None:
        self._found: dict[tuple[str, int, str], dict[int, Shot]] = {}
        for shot in shots:
            self._found.setdefault((shot.sequence, shot.n, shot.method), {})[shot.frame] = shot
        self.counts = sorted({n for _, n, _ in self._found})
        self.sequences = list(dict.fromkeys(sequence for sequence, _, _ in self._found))

    def of(self, sequence: str, n: int, method: str) -> dict[int, Shot]:
        """Return a method's frames by number; none where it was not run."""
        return self._found.get((sequence, n, method), {})

    def whose(self, n: int, *methods: str) -> list[str]:
        """List the sequences that all of these have."""
        return [name for name in self.sequences if all(self.of(name, n, method) for method in methods)]

    def value(self, sequence: str, n: int, method: str, field: str, frames: Iterable[int] | None = None) -> float:
        """Return a mean over frames, by default all but the clip's first; NaN: none."""
        shots = self.of(sequence, n, method)
        wanted = self.later(sequence, n, method) if frames is None else frames
        return mean(getattr(shots[frame], field) for frame in wanted if frame in shots)

    def later(self, sequence: str, n: int, method: str) -> set[int]:
        """Return the frames of a method but the clip's first; all of those in between."""
        if method in (BETWEEN, MEAN, MEAN_PHOTO):
            return set(self.of(sequence, n, method))
        return set(self.of(sequence, n, method)) - set(sorted(self.of(sequence, n, CLIP))[:1])

    def carried(self, sequence: str, n: int, field: str) -> float:
        """Return a mean over the frames that the clip carries; NaN: none."""
        return mean(getattr(shot, field) for shot in self.of(sequence, n, CLIP).values() if not shot.is_key)

    def pairs(self, n: int, ours: str, other: str, field: str) -> dict[str, tuple[float, float]]:
        """Return both methods' means over the frames that both have, but the first."""
        found = {}
        for name in self.whose(n, ours, other):
            both = self.later(name, n, ours) & self.later(name, n, other)
            one, two = ({f: getattr(self.of(name, n, method)[f], field) for f in both} for method in (ours, other))
            defined = [f for f in both if not math.isnan(one[f] + two[f])]
            if defined:
                found[name] = mean(one[f] for f in defined), mean(two[f] for f in defined)
        return found

    def gains(self, n: int, ours: str, other: str, field: str) -> dict[str, float]:
        """Return differences of means."""
        return {name: one - two for name, (one, two) in self.pairs(n, ours, other, field).items()}

    def shares(self, n: int, ours: str, other: str, field: str) -> dict[str, float]:
        """Return ratios of means."""
        return {name: one / two for name, (one, two) in self.pairs(n, ours, other, field).items()}


class Goal(NamedTuple):
    """What is wanted of the mean over sequences."""

    name: str
    limit: float
    is_share: bool  # at most so much; otherwise dB, at least so many
    values: Callable[[Results, int], Values]

    def is_met(self, value: float) -> bool:
        """Say whether a mean is as wanted."""
        return value <= self.limit if self.is_share else value >= self.limit

    def write(self, value: float) -> str:
        """Write a value."""
        return f"{100 * value:.1f} %" if self.is_share else f"{signed(value)} dB"


def bytes_share(results: Results, n: int) -> Values:
    """Bytes of a clip's frames, all of them, by those of files of equal quality."""
    names = results.whose(n, CLIP, QUALITY)
    means = {name: [[s.bytes for s in results.of(name, n, m).values()] for m in (CLIP, QUALITY)] for name in names}
    return {name: statistics.fmean(clip) / statistics.fmean(files) for name, (clip, files) in means.items()}


def time_share(results: Results, n: int) -> Values:
    """Processor time of a carried frame by that of the key frame, of clips that have any."""
    found = {name: results.of(name, n, CLIP) for name in results.whose(n, CLIP)}
    key = {name: mean(shot.seconds for shot in shots.values() if shot.is_key) for name, shots in found.items()}
    shares = {name: results.carried(name, n, "seconds") / key[name] for name in found}
    return {name: share for name, share in shares.items() if not math.isnan(share)}


GOALS = (
    Goal("bytes, of those of files of equal quality", 0.3, True, bytes_share),
    Goal("PSNR beside these", -0.3, False, lambda r, n: r.gains(n, CLIP, QUALITY, "psnr")),
    Goal("EF-PSNR beside these", -0.3, False, lambda r, n: r.gains(n, CLIP, QUALITY, "ef_psnr")),
    Goal("PSNR beside files of equal bytes", 3.0, False, lambda r, n: r.gains(n, CLIP, BYTES, "psnr")),
    Goal("processor time of a carried frame, of the key frame's", 0.15, True, time_share),
    Goal("flicker, of that of files of equal quality", 0.5, True, lambda r, n: r.shares(n, CLIP, QUALITY, "flicker")),
    Goal("PSNR in between beside the mean of two renders", 1.0, False, lambda r, n: r.gains(n, BETWEEN, MEAN, "psnr")),
)


def goals(results: Results) -> str:
    """Say which goals are met, and on which sequences they are not."""
    lines = []
    for n in results.counts:
        for goal in GOALS:
            values = goal.values(results, n)
            if not values:
                continue
            reached, wanted = statistics.fmean(values.values()), "at most" if goal.is_share else "at least"
            behind = [f"{name} {goal.write(value)}" for name, value in values.items() if not goal.is_met(value)]
            line = [count(n), goal.name, f"{wanted} {goal.write(goal.limit)}", goal.write(reached)]
            lines.append([*line, "met" if goal.is_met(reached) else "**missed**", str(len(values)), ", ".join(behind)])
    return markdown(["N", "of the clip", "wanted", "mean", "", "sequences", "missed on"], lines)


def against_codecs(results: Results) -> str:
    """Write what the clip gains and loses against other codecs at its bytes, sequence by sequence."""
    names, lines = results.sequences, []
    for n in results.counts:
        for codec in CODECS:
            for field, title in _QUALITIES.items():
                found = summarize(results.gains(n, CLIP, codec, field), TIE)
                if found is not None:
                    line = [count(n), codec, title, signed(found.mean), f"{found.wins}-{found.losses}"]
                    lines.append(line + [signed(found.values.get(name, math.nan)) for name in names])
    return markdown(["N", "against", "gained in", "mean", "won-lost", *names], lines)


def means(results: Results, frames: Mapping[str, Iterable[int] | None]) -> str:
    """Write means over sequences, of each method over these frames; None: over all but the first."""
    header, lines = ["N", "method", "sequences", "bytes per frame", *_QUALITIES.values(), *_FLICKER.values()], []
    for n in results.counts:
        for method, which in frames.items():
            if names := results.whose(n, method):
                found = {
                    field: mean(results.value(name, n, method, field, which) for name in names)
                    for field in (*_QUALITIES, *_FLICKER)
                }
                # of clips with their key frames, as other codecs' are
                size = mean(shot.bytes for name in names for shot in results.of(name, n, method).values())
                line = [count(n), method, str(len(names)), count(size), *(db(found[q]) for q in _QUALITIES)]
                lines.append(line + [number(found[field]) for field in _FLICKER])
    return markdown(header, lines)


def by_sequence(results: Results, n: int) -> str:
    """Write what each clip is made of."""
    lines = []
    for name in results.whose(n, CLIP):
        shots, files = results.of(name, n, CLIP).values(), results.of(name, n, QUALITY).values()
        key = [shot for shot in shots if shot.is_key]
        sizes = mean(shot.bytes for shot in key), results.carried(name, n, "bytes")
        line = [name, str(len(key)), *map(count, sizes)]
        line += [count(sum(shot.bytes for shot in shots)), db(mean(shot.psnr for shot in shots))]
        line += [db(mean(shot.ef_psnr for shot in shots)), number(results.carried(name, n, "born"))]
        line += [_percent(results.carried(name, n, "changed")), number(mean(shot.seconds for shot in key))]
        line.append(number(results.carried(name, n, "seconds")))
        lines.append(line + [number(mean(getattr(s, field) for s in files)) for field in ("seconds", "fit_seconds")])
    header = [
        "sequence",
        "key frames",
        "bytes, key",
        "bytes, carried",
        "bytes, clip",
        "PSNR",
        "EF-PSNR",
        "new per frame",
    ]
    return markdown([*header, "changed", "s, key", "s, carried", "s, file alone", "of these fit"], lines)


def beside_files(results: Results, n: int) -> str:
    """Write each clip's bytes, quality and flicker beside those of files of single frames."""
    share, flickers = bytes_share(results, n), [results.shares(n, CLIP, QUALITY, field) for field in _FLICKER]
    gains = [results.gains(n, CLIP, other, field) for other in (QUALITY, BYTES) for field in _QUALITIES]
    lines = [
        [
            name,
            _percent(share[name]),
            *(signed(values.get(name, math.nan)) for values in gains),
            *(_percent(values.get(name, math.nan)) for values in flickers),
        ]
        for name in share
    ]
    header = ["sequence", "bytes of equal quality", "PSNR", "EF-PSNR", "PSNR, equal bytes", "EF-PSNR, equal bytes"]
    return markdown([*header, *_FLICKER.values()], lines)


def _percent(value: float) -> str:
    return "" if math.isnan(value) else f"{100 * value:.0f} %"


def between(results: Results) -> str:
    """Write how well frames that were left out are shown."""
    lines, header = [], ["N", "sequence"]
    header += [f"{title}, {method}" for title in _QUALITIES.values() for method in (BETWEEN, MEAN, MEAN_PHOTO)]
    for n in results.counts:
        names = results.whose(n, BETWEEN)
        found = {
            name: [results.value(name, n, m, field) for field in _QUALITIES for m in (BETWEEN, MEAN, MEAN_PHOTO)]
            for name in names
        }
        lines += [[count(n), name, *map(db, values)] for name, values in found.items()]
        if names:
            lines.append([count(n), "mean", *(db(mean(column)) for column in zip(*found.values(), strict=True))])
    return markdown(header, lines)


class Part(NamedTuple):
    """Means of a variant over sequences, and of the encoder as it is over the same frames."""

    name: str
    ours: dict[str, float]
    whole: dict[str, float]


def parts(results: Results) -> list[Part]:
    """Compare clips with parts of the encoder taken out with those of the encoder as it is, which comes first."""
    found = []
    fields = ("bytes", *_QUALITIES, *_FLICKER, "seconds")
    for n in results.counts[:1]:
        for method in VARIANTS:
            pairs = {field: list(results.pairs(n, method, AS_IT_IS, field).values()) for field in fields}
            if pairs["psnr"]:
                ours, whole = ({f: mean(pair[i] for pair in pairs[f]) for f in fields} for i in (0, 1))
                found.append(Part(method, ours, whole))
    return found


def parts_table(found: Sequence[Part]) -> str:
    """Write what becomes of a carried frame where parts of carrying are taken out."""
    lines = []
    for name, ours, whole in found:
        line = [name, count(ours["bytes"]), f"{100 * (ours['bytes'] / whole['bytes'] - 1):+.1f} %"]
        for field in _QUALITIES:
            line += [db(ours[field]), signed(ours[field] - whole[field])]
        lines.append(line + [number(ours[field]) for field in (*_FLICKER, "seconds")])
    header = ["clip", "bytes", "", "PSNR", "", "EF-PSNR", "", *_FLICKER.values(), "s"]
    return markdown(header, lines)
