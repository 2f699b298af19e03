"""Shards of scenes, and the data set over them."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader

from kcgs import GaussianField, RegionMap, Scene, load
from kcgs.data import SceneBatch, SceneDataset, save_shard

SIZE = (16, 24)


def scenes_of(count: int, has_maps: bool = False, num_gaussians: int = 9, seed: int = 0) -> Scene:
    """Scenes whose last rows have the colour 0, in the first one row, in the second two."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, num_gaussians, 2, generator=generator) * torch.tensor([24.0, 16.0])
    colors = torch.rand(count, num_gaussians, 3, generator=generator) + 0.1
    for k in range(count):
        colors[k, num_gaussians - k - 1 :] = 0.0
    cholesky = torch.tensor([2.0, 0.5, 1.5]).expand(count, num_gaussians, 3)
    if not has_maps:
        return Scene(GaussianField(means, cholesky, colors, size=SIZE))
    maps = [RegionMap(torch.arange(24).expand(SIZE) // (4 + k) + k, 0.3 * k) for k in range(count)]
    field = GaussianField(means, cholesky, colors, size=SIZE)
    regions = RegionMap.stack(maps)
    return Scene(field.assign_regions(regions), regions)


def write(folder: Path, has_maps: bool = False) -> list[Scene]:
    """Write shards of 3 and 2 scenes; return all of them."""
    parts = [scenes_of(3, has_maps), scenes_of(2, has_maps, seed=1)]
    for number, (part, names) in enumerate(zip(parts, ("abc", "de"), strict=True)):
        save_shard(folder / f"0000{number}.safetensors", part, names, [20.0 + k for k in range(len(names))])
    return [scene for part in parts for scene in part]


@pytest.mark.parametrize("has_maps", [False, True])
def test_an_index_gives_a_scene(has_maps: bool, tmp_path: Path) -> None:
    expected = write(tmp_path, has_maps)
    (tmp_path / "00002.parts").mkdir()  # of a shard that is not complete
    (tmp_path / "00002.parts/00000.safetensors").write_bytes(b"")
    dataset = SceneDataset(tmp_path)
    assert (len(dataset), "".join(dataset.names), dataset.psnr.tolist()) == (5, "abcde", [20, 21, 22, 20, 21])
    for index, scene in enumerate(expected):
        actual = dataset[index]
        assert actual.num_gaussians == int((scene.field.colors != 0).any(-1).sum()) < 9
        torch.testing.assert_close(actual.render(), scene.render())
        if has_maps:
            assert torch.equal(actual.regions.labels, scene.regions.labels)
            assert actual.regions.softness == scene.regions.softness
    assert torch.equal(dataset[-1].field.means, dataset[4].field.means)
    with pytest.raises(IndexError):
        dataset[5]


@pytest.mark.parametrize(("has_maps", "workers", "start"), [(False, 0, None), (True, 0, None), (True, 1, "fork")])
def test_batches_are_tensors_in_the_order_of_the_sampler(
    has_maps: bool, workers: int, start: str | None, tmp_path: Path
) -> None:
    expected = write(tmp_path, has_maps)
    dataset = SceneDataset(tmp_path)
    loader = DataLoader(
        dataset, batch_size=2, sampler=[4, 0, 3, 2, 1], collate_fn=dataset.collate, num_workers=workers,
        multiprocessing_context=start,
    )  # fmt: skip
    batches = list(loader)
    assert all(isinstance(batch, SceneBatch) for batch in batches)
    assert torch.cat([batch.positions for batch in batches]).tolist() == [4, 0, 3, 2, 1]
    for name in ("means", "cholesky", "colors", *(["region_ids"] if has_maps else [])):
        rows = torch.cat([getattr(batch, name) for batch in batches])
        assert torch.equal(rows, torch.stack([getattr(expected[k].field, name) for k in (4, 0, 3, 2, 1)]))
    assert (batches[0].region_ids is None) != has_maps


@pytest.mark.parametrize("largest", [(7, 300), (300, 70_000)])
def test_batches_of_shards_with_ids_of_other_types(largest: tuple[int, int], tmp_path: Path) -> None:
    for number, region in enumerate(largest):
        labels = region * (torch.arange(24) >= 12).long().expand(2, *SIZE)
        scenes = Scene(scenes_of(2).field.assign_regions(labels), labels)
        save_shard(tmp_path / f"0000{number}.safetensors", scenes, "ab", [20.0, 21.0])
    dataset = SceneDataset(tmp_path)
    batch = dataset.batch([3, 0])
    assert batch.region_ids.amax(1).tolist() == [largest[1], largest[0]] and batch.region_ids.dtype == torch.int64
    assert dataset[3].field.region_ids.unique().tolist() == [0, largest[1]]


@pytest.mark.parametrize("num_maps", [None, 1])
def test_one_map_of_all_images(num_maps: int | None, tmp_path: Path) -> None:
    labels = (torch.arange(24) >= 12).long().expand(SIZE)
    regions = RegionMap(labels if num_maps is None else labels[None], 0.5)
    scenes = Scene(scenes_of(2).field.assign_regions(labels), regions)
    save_shard(tmp_path / "00000.safetensors", scenes, "ab", [20.0, 21.0])
    torch.testing.assert_close(SceneDataset(tmp_path)[1].render(), scenes[1].render())


def test_a_copy_opens_the_files_itself(tmp_path: Path) -> None:
    write(tmp_path)
    dataset = SceneDataset(tmp_path)
    dataset[0]
    content = pickle.dumps(dataset)
    assert len(content) < 2_000 and torch.equal(pickle.loads(content)[3].field.means, dataset[3].field.means)


def test_a_shard_is_a_scene_file(tmp_path: Path) -> None:
    write(tmp_path, has_maps=True)
    scene = load(tmp_path / "00000.safetensors")
    assert len(scene) == 3 and scene.metadata["names"] == '["a", "b", "c"]'
    torch.testing.assert_close(scene.render(), scenes_of(3, has_maps=True).render())


def test_what_is_no_data_set(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="folder must hold shards, such as 00000.safetensors; got"):
        SceneDataset(tmp_path)
    scenes_of(2).save(tmp_path / "00000.safetensors")
    with pytest.raises(ValueError, match=r"00000.safetensors is no shard: its metadata lack names and psnr"):
        SceneDataset(tmp_path)
    scenes_of(2)[0].save(tmp_path / "00000.safetensors")
    with pytest.raises(ValueError, match=r"holds no batch of scenes: it must hold means, cholesky, colors of a batch"):
        SceneDataset(tmp_path)
    (tmp_path / "00000.safetensors").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="holds no batch of scenes"):
        SceneDataset(tmp_path)
    for number, rows in enumerate((9, 8)):
        save_shard(tmp_path / f"0000{number}.safetensors", scenes_of(2, num_gaussians=rows), "ab", [1.0, 2.0])
    with pytest.raises(ValueError, match="folder must hold shards of as many rows and channels, all with"):
        SceneDataset(tmp_path)
    save_shard(tmp_path / "00001.safetensors", scenes_of(2, has_maps=True), "ab", [1.0, 2.0])
    with pytest.raises(ValueError, match="9 rows, 3 channels, no regions.*9 rows, 3 channels, regions"):
        SceneDataset(tmp_path)
    with pytest.raises(ValueError, match=r"path must be a name such as 00000.safetensors; got '.*train.safetensors'"):
        save_shard(tmp_path / "train.safetensors", scenes_of(2), "ab", [1.0, 2.0])
    with pytest.raises(ValueError, match="names must be one for each of 2 scenes; got 3"):
        save_shard(tmp_path / "00002.safetensors", scenes_of(2), "abc", [1.0, 2.0])
    Scene(scenes_of(2).field, None, {"names": '["a"]', "psnr": "[1.0]"}).save(tmp_path / "00000.safetensors")
    with pytest.raises(ValueError, match="name and a PSNR for each of its 2 scenes; got 1 names and 1 PSNRs"):
        SceneDataset(tmp_path)
    with pytest.raises(ValueError, match=r"psnr must be numbers of dB; got \[1.0, nan\]"):
        save_shard(tmp_path / "00002.safetensors", scenes_of(2), "ab", [1.0, torch.nan])
    with pytest.raises(TypeError, match="scenes must be a batch of scenes; got list"):
        save_shard(tmp_path / "00002.safetensors", [*scenes_of(2)], "ab", [1.0, 2.0])  # type: ignore[arg-type]


def test_an_image_without_error(tmp_path: Path) -> None:
    save_shard(tmp_path / "00000.safetensors", scenes_of(2), "ab", torch.tensor([20.0, torch.inf]))
    assert SceneDataset(tmp_path).psnr.tolist() == [20.0, torch.inf]
    assert load(tmp_path / "00000.safetensors").metadata["psnr"] == "[20.0, null]"


def test_shards_are_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (99_999, 100_000):
        save_shard(tmp_path / f"{number}.safetensors", scenes_of(1), [Path(f"{number}.jpg")], [20.0])
    assert SceneDataset(tmp_path).names == ["99999.jpg", "100000.jpg"]


def test_notes_of_the_scenes_and_of_the_file(tmp_path: Path) -> None:
    scenes = Scene(scenes_of(2).field, metadata={"frame_rate": "24", "camera": "a"})
    save_shard(tmp_path / "00000.safetensors", scenes, "ab", [20.0, 21.0], {"camera": "b"})
    notes = load(tmp_path / "00000.safetensors").metadata
    assert (notes["frame_rate"], notes["camera"]) == ("24", "b")


def test_indices_and_devices(tmp_path: Path) -> None:
    write(tmp_path)
    dataset = SceneDataset(tmp_path)
    assert repr(dataset) == "SceneDataset(5 scenes in 2 shards, 9 rows, 3 channels, no regions)"
    batch = dataset.batch([-1, 2]).to("cpu")
    assert batch.positions.tolist() == [4, 2] and batch.region_ids is None
    with pytest.raises(TypeError):
        dataset[1:3]  # type: ignore[index]
    with pytest.raises(IndexError):
        dataset.batch([7])
    with pytest.raises(ValueError, match="indices must hold at least one; got none"):
        dataset.batch([])


def test_opacities_are_merged_into_the_colors(tmp_path: Path) -> None:
    field = scenes_of(2).field
    scenes = Scene(GaussianField(field.means, field.cholesky, field.colors, None, torch.full((2, 9), 0.5), size=SIZE))
    save_shard(tmp_path / "00000.safetensors", scenes, ["a", "b"], [20.0, 21.0])
    torch.testing.assert_close(SceneDataset(tmp_path)[1].render(), scenes[1].render())
    scenes.save(tmp_path / "00000.safetensors")
    with pytest.raises(ValueError, match="merges them into the colours"):
        SceneDataset(tmp_path)
