"""Shards, files with the scenes of many images of one size, and a data set over a folder of shards."""

from __future__ import annotations

import json
import math
import operator
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.data import Dataset

from kcgs._repr import brief
from kcgs.errors import InvalidArgument
from kcgs.functional import to_tokens
from kcgs.maps import RegionMap
from kcgs.nn import GaussianField, pad_rows
from kcgs.scene import Scene, check_batch
from kcgs.storage import Shard, map_file

# digits in the names of shards
_DIGITS = 5


@brief
class SceneBatch(NamedTuple):
    """Scenes of a data set as tensors; unused rows have the colour 0.

    In shards of `kcgs fit-many` rows are in the order of :func:`kcgs.fitting.rank_gaussians`. Label maps are those of
    ``dataset[k].regions``.
    """

    positions: Tensor
    """Indices of the scenes in the data set, (B,) int64."""
    sizes: Tensor
    """(height, width) of the images, (B, 2) int64."""
    means: Tensor
    """(B, N, 2)"""
    cholesky: Tensor
    """(B, N, 3)"""
    colors: Tensor
    """(B, N, C)"""
    region_ids: Tensor | None
    """(B, N) int64 if the scenes have label maps, else None."""

    def to(self, device: torch.device | str) -> SceneBatch:
        """Return the batch on another device."""
        return SceneBatch(*(None if table is None else table.to(device) for table in self))  # type: ignore[arg-type]

    def tokens(self) -> Tensor:
        """Return the Gaussians as numbers of order one, (B, N, 5 + C): see :func:`kcgs.functional.to_tokens`."""
        return to_tokens(self.means, self.cholesky, self.colors, self.sizes)


class SceneDataset(Dataset[Scene]):
    r"""The scenes in the shards of a folder, as `kcgs fit-many --shard` writes them: a torch Dataset.

    Convention: ``dataset[k]`` is a :class:`kcgs.Scene`; ``dataset.batch(indices)``, and a DataLoader with
    ``collate_fn=dataset.collate``, give a :class:`SceneBatch` of tensors. Files are mapped into memory, so that only
    the requested rows are read. A copy in another process, spawned or forked, opens the files itself.

    Args:
        folder: has 00000.safetensors, 00001.safetensors and so on, all with the same numbers of rows and channels.

    Raises:
        FileNotFoundError: no shards there.
        ValueError: a file that is no shard, or without a name and a PSNR for each scene; shards that differ in rows or
            channels.

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
    """Names of the images, in the order of the scenes."""
    psnr: Tensor
    """PSNR of each scene, in dB, (K,) float64."""

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self._paths = list_shards(folder)
        if not self._paths:
            raise FileNotFoundError(f"folder must hold shards, such as 00000.safetensors; got {str(folder)!r}")
        self._open: dict[int, Shard] = {}
        self.names, psnrs, counts = [], [], []
        layouts: dict[str, str] = {}
        for path in self._paths:
            shard = map_file(path)
            names, psnr = shard_contents(shard.metadata, path)
            count = len(shard.tensors["means"])
            if not len(names) == len(psnr) == count:
                raise ValueError(
                    f"{path} must have a name and a PSNR for each of its {count} scenes; "
                    f"got {len(names)} names and {len(psnr)} PSNRs"
                )
            counts.append(count)
            self.names += names
            psnrs += psnr
            layouts[shard.layout] = path.name
        self.psnr = torch.tensor(psnrs, dtype=torch.float64)
        self._firsts = torch.tensor([0, *counts]).cumsum(0)
        if len(layouts) > 1:
            expected = "shards of as many rows and channels, all with regions or none"
            raise InvalidArgument("folder", expected, layouts, verb="hold")

    def __repr__(self) -> str:
        return f"SceneDataset({len(self)} scenes in {len(self._paths)} shards, {self._shard(0).layout})"

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(self.names)

    def __getitem__(self, index: int) -> Scene:
        """Return a scene, without unused rows."""
        position = range(len(self))[operator.index(index)]
        number = int(torch.searchsorted(self._firsts, position, right=True)) - 1
        return self._shard(number).scene(position - int(self._firsts[number]))

    def batch(self, indices: Sequence[int]) -> SceneBatch:
        """Return scenes as tensors, in the order of the indices, at least one."""
        if not len(indices):
            raise InvalidArgument("indices", "at least one", "none", verb="hold")
        positions = torch.tensor([range(len(self))[operator.index(index)] for index in indices])
        numbers = torch.searchsorted(self._firsts, positions, right=True) - 1
        rows = positions - self._firsts[numbers]
        place = numbers.argsort(stable=True).argsort()  # of each scene, where the scenes are sorted by their shards
        chosen = [(self._shard(number), rows[numbers == number]) for number in numbers.unique().tolist()]

        def table(name: str) -> Tensor:
            parts = [shard.tensors[name].index_select(0, rows_of_shard) for shard, rows_of_shard in chosen]
            # each shard has the smallest integer type that holds its ids
            return torch.cat([part.long() if name == "region_ids" else part for part in parts])[place]

        sizes = torch.tensor([self._shard(number).size for number in numbers.tolist()])
        ids = table("region_ids") if "region_ids" in chosen[0][0].tensors else None
        return SceneBatch(positions, sizes, table("means"), table("cholesky"), table("colors"), ids)

    __getitems__ = batch  # a DataLoader calls it

    @staticmethod
    def collate(batch: SceneBatch) -> SceneBatch:
        """Return the batch unchanged: pass it as `collate_fn` to a DataLoader."""
        return batch

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the open files."""
        return {**self.__dict__, "_open": {}}

    def _shard(self, number: int) -> Shard:
        """Return a shard, opened once per process."""
        if number not in self._open:
            self._open[number] = map_file(self._paths[number])
        return self._open[number]


def list_shards(folder: str | os.PathLike[str]) -> list[Path]:
    """List the shards of a folder, in the order of their numbers."""
    paths = [path for path in Path(folder).glob("*.safetensors") if _is_shard(path)]
    return sorted(paths, key=lambda path: int(path.stem))


def _is_shard(path: Path) -> bool:
    return path.suffix == ".safetensors" and path.stem.isdecimal() and len(path.stem) >= _DIGITS


def shard_path(folder: Path, number: int) -> Path:
    """Return the path of a shard."""
    return folder / f"{number:0{_DIGITS}}.safetensors"


def save_shard(
    path: str | os.PathLike[str],
    scenes: Scene,
    names: Sequence[str | Path],
    psnr: Sequence[float] | Tensor,
    metadata: Mapping[str, str] | None = None,
) -> int:
    """Write a batch of scenes as a shard, with the names and PSNR of its images; return the file's size in bytes.

    Args:
        path: 00000.safetensors, 00001.safetensors and so on.
        scenes: a batch of images of one size; opacities are merged into the colours.
        names: of the images; paths are written as text.
        psnr: of the scenes, in dB, such as `psnr` of :class:`kcgs.FitResult`.
        metadata: notes for the file, besides those of the scenes.

    Raises:
        TypeError: no batch of scenes.
        ValueError: `path` has no name of a shard; the number of names or PSNRs is not that of the scenes; a PSNR is
            NaN or minus infinity.

    Example:
        >>> import tempfile
        >>> scenes = Scene(GaussianField(torch.rand(2, 9, 2), torch.ones(2, 9, 3), torch.rand(2, 9, 3), size=(8, 8)))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_shard(f"{folder}/00000.safetensors", scenes, ["a", "b"], [30.0, 31.0]) > 600
        True
    """
    if not _is_shard(Path(path)):
        raise InvalidArgument("path", "a name such as 00000.safetensors", repr(str(path)))
    numbers: list[float] = torch.as_tensor(psnr, dtype=torch.float64).tolist()
    for name, values in (("names", names), ("psnr", numbers)):
        if len(values) != len(check_batch(scenes)):
            raise InvalidArgument(name, f"one for each of {len(scenes)} scenes", len(values))
    if not all(number > -math.inf for number in numbers):
        raise InvalidArgument("psnr", "numbers of dB", numbers)
    # JSON has no infinity, the PSNR of an image without error
    finite = [None if number == math.inf else number for number in numbers]
    notes = {**scenes.metadata, **(metadata or {}), "names": json.dumps([*map(str, names)]), "psnr": json.dumps(finite)}
    return Scene(scenes.field.without_opacities(), scenes.regions, notes).save(path)


def shard_contents(metadata: Mapping[str, str], path: Path) -> tuple[list[str], list[float]]:
    """Return the names and the PSNR of the images of a shard."""
    try:
        psnr = [math.inf if number is None else number for number in json.loads(metadata["psnr"])]
        return json.loads(metadata["names"]), psnr
    except (KeyError, ValueError):
        raise ValueError(f"{path} is no shard: its metadata lack names and psnr") from None


def stack_scenes(scenes: Sequence[Scene], num_gaussians: int, *, with_maps: bool) -> Scene:
    """Stack unbatched scenes of one size into a batch of `num_gaussians` rows each.

    Opacities are merged into the colours. `with_maps`: a scene without a label map gets a map of one region.
    """
    if not with_maps:
        return Scene(GaussianField.stack([pad_rows(scene.field, num_gaussians) for scene in scenes]))
    one_region = torch.zeros(scenes[0].size, dtype=torch.int64, device=scenes[0].field.means.device)
    maps = [scene.regions or RegionMap(one_region) for scene in scenes]
    fields = [pad_rows(scene.field, num_gaussians, one) for scene, one in zip(scenes, maps, strict=True)]
    return Scene(GaussianField.stack(fields), RegionMap.stack(maps))
