"""Shards, which hold the scenes of many images of one size, and a data set over a folder of them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.data import Dataset

from kcgs.errors import InvalidArgument
from kcgs.functional import RegionMap, to_tokens
from kcgs.nn import GaussianField, pad_rows
from kcgs.scene import Scene
from kcgs.storage import MappedScene, map_file

# of the names of shards
_DIGITS = 5


class SceneBatch(NamedTuple):
    """Scenes of a data set as tensors.

    Rows are in the order of :func:`kcgs.fitting.rank_gaussians`; those that an image has no use for have the colour 0.
    """

    positions: Tensor
    """Of the scenes in the data set, (B,) int64."""
    sizes: Tensor
    """(height, width) of the images, (B, 2) int64."""
    means: Tensor
    """(B, N, 2)"""
    cholesky: Tensor
    """(B, N, 3)"""
    colors: Tensor
    """(B, N, C)"""
    region_ids: Tensor | None
    """(B, N) int64, where scenes have label maps."""

    def tokens(self) -> Tensor:
        """Write the Gaussians as numbers of order one, (B, N, 5 + C): see :func:`kcgs.functional.to_tokens`."""
        return to_tokens(self.means, self.cholesky, self.colors, self.sizes)


class SceneDataset(Dataset[Scene]):
    r"""The scenes in the shards of a folder, as `kcgs fit-many --shard` writes them: a torch Dataset.

    Convention: an index gives a scene, without rows of the colour 0. Batches come as tensors, by torch's
    ``__getitems__``: pass :meth:`collate` to a DataLoader. Files are mapped into memory, so that only the rows that are
    asked for are read. A copy in another process, spawned or forked, opens the files itself.

    Args:
        folder: with 00000.safetensors, 00001.safetensors and so on; all of as many rows and channels.

    Raises:
        FileNotFoundError: no shards there.
        ValueError: a file that is no shard, or shards that differ in rows or channels.

    Example:
        >>> import tempfile
        >>> from torch.utils.data import DataLoader
        >>> from kcgs import fit
        >>> scenes = fit(torch.rand(4, 3, 16, 24), num_gaussians=8, iterations=20).scene
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = save_shard(f"{folder}/00000.safetensors", scenes, ["a", "b", "c", "d"], [20.0, 21.0, 22.0, 23.0])
        ...     dataset = SceneDataset(folder)
        ...     batch = next(iter(DataLoader(dataset, batch_size=2, collate_fn=dataset.collate)))
        >>> len(dataset), dataset.names[3], dataset[3].render().shape, batch.colors.shape
        (4, 'd', torch.Size([3, 16, 24]), torch.Size([2, 8, 3]))
    """

    names: list[str]
    """Of the images, in order."""
    psnr: Tensor
    """Of each scene, in dB, (K,) float64."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self._paths = list_shards(folder)
        if not self._paths:
            raise FileNotFoundError(f"folder must hold shards, such as 00000.safetensors; got {str(folder)!r}")
        self._open: dict[int, MappedScene] = {}
        self.names, psnrs, counts = [], [], []
        for number in range(len(self._paths)):
            names, psnr = shard_contents(self._shard(number).metadata, self._paths[number])
            counts.append(len(names))
            self.names += names
            psnrs += psnr
        self.psnr = torch.tensor(psnrs, dtype=torch.float64)
        self._firsts = torch.tensor([0, *counts]).cumsum(0)
        layouts = {tuple(self._shard(k).tensors["colors"].shape[1:]): path for k, path in enumerate(self._paths)}
        if len(layouts) > 1:
            raise InvalidArgument("folder", "shards of as many rows and channels", layouts, verb="hold")

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(self.names)

    def __getitem__(self, index: int) -> Scene:
        """Return a scene, without rows of the colour 0."""
        position = range(len(self))[index]
        number = int(torch.searchsorted(self._firsts, position, right=True)) - 1
        shard, row = self._shard(number), position - int(self._firsts[number])
        return shard.scene(row)

    def __getitems__(self, indices: Sequence[int]) -> SceneBatch:
        """Return scenes as tensors, in the order of the indices; a DataLoader calls this."""
        positions = torch.as_tensor(indices, dtype=torch.int64)
        numbers = torch.searchsorted(self._firsts, positions, right=True) - 1
        rows = positions - self._firsts[numbers]
        tables: dict[str, Tensor] = {}
        for number in numbers.unique().tolist():
            chosen = numbers == number
            for name, tensor in self._shard(number).tensors.items():
                if name in SceneBatch._fields:
                    part = tensor.index_select(0, rows[chosen])
                    tables.setdefault(name, part.new_empty(len(positions), *part.shape[1:]))[chosen] = part
        ids = tables.get("region_ids")
        sizes = torch.tensor([self._shard(number).size for number in numbers.tolist()]).view(-1, 2)
        return SceneBatch(
            positions, sizes, tables["means"], tables["cholesky"], tables["colors"], None if ids is None else ids.long()
        )

    @staticmethod
    def collate(batch: SceneBatch) -> SceneBatch:
        """Return a batch as it is: the argument `collate_fn` of a DataLoader."""
        return batch

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the open files."""
        return {**self.__dict__, "_open": {}}

    def _shard(self, number: int) -> MappedScene:
        """Return a shard, opened once per process."""
        if number not in self._open:
            self._open[number] = map_file(self._paths[number])
        return self._open[number]


def list_shards(folder: str | os.PathLike[str]) -> list[Path]:
    """List the shards of a folder, in order."""
    files = Path(folder).glob("*.safetensors")
    return sorted(path for path in files if path.stem.isdigit() and len(path.stem) >= _DIGITS)


def shard_path(folder: Path, number: int) -> Path:
    """Return the path of a shard."""
    return folder / f"{number:0{_DIGITS}}.safetensors"


def save_shard(
    path: str | os.PathLike[str],
    scenes: Scene,
    names: Sequence[str],
    psnr: Sequence[float],
    metadata: Mapping[str, str] | None = None,
) -> int:
    """Write a batch of scenes with the names and the PSNR of its images, in the metadata; return the bytes.

    Raises:
        ValueError: as many names or numbers as there are not scenes.

    Example:
        >>> import tempfile
        >>> scenes = Scene(GaussianField(torch.rand(2, 9, 2), torch.ones(2, 9, 3), torch.rand(2, 9, 3), size=(8, 8)))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_shard(f"{folder}/00000.safetensors", scenes, ["a", "b"], [30.0, 31.0]) > 600
        True
    """
    for name, values in (("names", names), ("psnr", psnr)):
        if len(values) != len(scenes):
            raise InvalidArgument(name, f"one for each of {len(scenes)} scenes", len(values))
    notes = {**(metadata or {}), "names": json.dumps([*names]), "psnr": json.dumps([*psnr])}
    return Scene(scenes.field, scenes.regions, notes).save(path)


def shard_contents(metadata: Mapping[str, str], path: Path) -> tuple[list[str], list[float]]:
    """Return the names and the PSNR of the images of a shard."""
    try:
        return json.loads(metadata["names"]), json.loads(metadata["psnr"])
    except (KeyError, ValueError):
        raise ValueError(f"{path} is no shard: its metadata lack names and psnr") from None


def stack_scenes(scenes: Sequence[Scene], num_gaussians: int) -> Scene:
    """Put scenes of one image each, all of one size, into a batch of so many rows each, without opacities.

    Where one has a label map, those without get a map of one region.
    """
    maps = [scene.regions for scene in scenes]
    if any(maps):
        maps = [one or RegionMap(torch.zeros(scenes[0].size, dtype=torch.int64)) for one in maps]
    fields = [pad_rows(scene.field, num_gaussians, one) for scene, one in zip(scenes, maps, strict=True)]
    regions = RegionMap.stack([one for one in maps if one is not None]) if any(maps) else None
    return Scene(GaussianField.stack(fields), regions)
