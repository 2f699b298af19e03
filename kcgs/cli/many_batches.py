"""The batches of `kcgs fit-many`: images of the same size that are fitted together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from .many_fingerprints import FitJob, fingerprint_of_shard
from .many_jobs import FileBatch, Outcome
from .many_shards import ShardPart
from .options import FitRequest

# pixels of a batch: more would not fit into the cache of a core; a GPU is fully used from this number on
_CORE_PIXELS = 1 << 17
_GPU_PIXELS = 1 << 22

Size = tuple[int, int]


class Batch(NamedTuple):
    """Images that one job fits."""

    indices: tuple[int, ...]
    """Indices of the images among all images of the command."""
    work: FileBatch | ShardPart


def run_batch(batch: Batch) -> list[Outcome]:
    """Fit the images of a batch; return the outcomes in the order of the images."""
    return batch.work.run()


def single_image_option(request: FitRequest) -> str | None:
    """Return the option that makes a request fit images one by one; None: images may be fitted together."""
    config = request.load_config()
    values = {
        "target-bytes": request.target_bytes, "target-psnr": config.target_psnr, "max-seconds": config.max_seconds,
    }  # fmt: skip
    return next((name for name, value in values.items() if value is not None), None)


def make_batches(
    jobs: Sequence[FitJob], batch: str, shard: int | None, workers: int, devices: Sequence[str], output: Path
) -> list[Batch]:
    """Divide images into batches of one size.

    Args:
        jobs: one for each image.
        batch: number of images, or auto.
        shard: number of scenes per file; None: a file for each image.
        workers: number of batches at a time; with auto there are enough batches for all workers.
        devices: batches are spread over the devices in turn.
        output: folder of the shards.
    """
    from kcgs.data import shard_path

    groups = _by_size(jobs) if batch != "1" or shard is not None else {None: [*range(len(jobs))]}
    on_gpu = devices[0].startswith("cuda")
    batches: list[Batch] = []
    num_shards = 0
    for size, indices in groups.items():
        count = _auto_batch(size, len(indices), workers, on_gpu) if batch == "auto" else int(batch)
        for members in _chunks(indices, shard or len(indices)):
            parts = [*_chunks(members, count)]
            fingerprint = "" if shard is None else fingerprint_of_shard([jobs[index] for index in members])
            for number, part in enumerate(parts):
                device = devices[len(batches) % len(devices)]
                chosen = tuple(jobs[k]._replace(request=jobs[k].request._replace(device=device)) for k in part)
                work: FileBatch | ShardPart = FileBatch(chosen)
                if shard is not None:
                    work = ShardPart(shard_path(output.absolute(), num_shards), number, chosen, size, fingerprint)
                batches.append(Batch(tuple(part), work))
            num_shards += 1
    return batches


def _by_size(jobs: Sequence[FitJob]) -> dict[Size | None, list[int]]:
    """Group images by size, in the order of each group's first image; unreadable images join the first group."""
    from kcgs._decode import read_size

    groups: dict[Size | None, list[int]] = {}
    for index, job in enumerate(jobs):
        groups.setdefault(read_size(job.image), []).append(index)
    if len(groups) > 1:
        unknown = groups.pop(None, [])
        first = next(iter(groups.values()))
        first[:] = sorted(first + unknown)
    return groups


def _auto_batch(size: Size | None, count: int, workers: int, on_gpu: bool) -> int:
    """Return the number of images of a size that are fitted together."""
    if size is None:
        return 1
    suitable = (_GPU_PIXELS if on_gpu else _CORE_PIXELS) // (size[0] * size[1])
    return max(1, min(suitable, -(-count // workers)))


def _chunks(items: Sequence[int], count: int) -> Iterator[Sequence[int]]:
    return (items[first : first + count] for first in range(0, len(items), count))
