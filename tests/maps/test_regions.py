"""Label maps: compaction, memberships, look-up, resampling, the edge band."""

from __future__ import annotations

import math
import pickle
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene, load
from kcgs.functional import PairSoftness, edge_band, lookup_regions, region_splat
from kcgs.maps import table_and_size
from kcgs.maps.table import full_map
from tests.tester import BaseTester

from .label_maps import blobs, membership_of


class TestRegionMap(
    BaseTester,
    without={
        "test_gradcheck": "labels are integers, and memberships take no gradient",
        "test_module": "it is data, which a Scene keeps in its state",
    },
):
    def test_smoke(self, device: torch.device, dtype: torch.dtype) -> None:
        regions = RegionMap(blobs().to(device), {(0, 1): 0.5})
        assert regions.labels.device.type == device.type and "4 regions, size=(45, 70)" in repr(regions)
        weights = regions.membership(0, dtype)
        assert weights.dtype == dtype and weights.isfinite().all() and weights.any()

    @pytest.mark.parametrize("lead", [(), (2,)])
    def test_cardinality(self, device: torch.device, lead: tuple[int, ...]) -> None:
        regions = RegionMap(blobs((45, 69)).to(device).expand(*lead, 45, 69))
        assert regions.size == (45, 69) and regions.labels.shape == (*lead, 45, 69) and regions.ids.shape == (4,)
        assert regions.index.shape == (*(lead or (1,)), 45, 69)
        assert not lead or regions[0].labels.shape == (45, 69)
        assert regions.resize((7, 9)).labels.shape == (*lead, 7, 9)

    def test_dynamo(self, device: torch.device, dtype: torch.dtype) -> None:
        """A map is made outside of a graph, for the number of its regions is found in values; read inside."""

        def shares(of: RegionMap) -> Tensor:
            return of.labels.to(dtype) / of.num_regions + of.size[0] + of.index_of(of.ids).sum()

        self.assert_compiles(shares, RegionMap(blobs().to(device), 0.7), backend="aot_eager")

    def test_feature(self, device: torch.device) -> None:
        """Ids need not be consecutive."""
        regions = RegionMap.from_labels(torch.tensor([[255, 0], [7, 100_000]], device=device), 0.7)
        assert regions.ids.tolist() == [0, 7, 255, 100_000] and regions.softness == 0.7
        assert regions.index_of(torch.tensor([7, 8, 100_000, 0], device=device)).tolist() == [1, -1, 3, 0]

    @pytest.mark.parametrize(
        ("labels", "softness", "error", "words"),
        [
            (torch.zeros(3, 3).cfloat(), 0.0, TypeError, "labels must have an integer dtype; got torch.complex64"),
            (torch.tensor([[1.0, 2.25]]), 0.0, ValueError, "labels must hold whole numbers; got 2.25"),
            (torch.tensor([[1.0, 1e30]]), 0.0, ValueError, "labels must hold whole numbers; got 1.0"),
            (torch.zeros(3, dtype=torch.long), 0.0, ValueError, "labels must have 2 or 3 dimensions"),
            (torch.zeros(0, 4, dtype=torch.long), 0.0, ValueError, "at least one pixel"),
            (-torch.ones(3, 3, dtype=torch.long), 0.0, ValueError, "non-negative ids; got -1"),
            (torch.zeros(3, 3, dtype=torch.long), -0.1, ValueError, r"softness must be in \[0, 64\] pixels; got -0.1"),
            (torch.zeros(3, 3, dtype=torch.long), "a", TypeError, "softness must be a number of pixels; got 'a'"),
            ([[0]], 0.0, TypeError, "labels must be a Tensor, a numpy array, a PIL image or a path; got list"),
        ],
    )
    def test_exception(self, labels: Tensor, softness: float, error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            RegionMap(labels, softness)

    def test_labels_of_augmentations(self) -> None:
        """Kornia returns masks as floating (B, 1, H, W); a map is the same, and all else that takes labels."""
        labels = torch.stack([blobs(seed=k) for k in (0, 1)])
        mask = labels[:, None].half()
        for given in (mask, mask.float().numpy()):
            assert torch.equal(RegionMap(given).labels, labels)
        assert torch.equal(edge_band(mask), edge_band(labels))
        field = GaussianField.random(20, (45, 70), regions=labels[0], seed=0)
        tensors = [t.detach().expand(2, *t.shape) for t in (field.means, field.cholesky, field.colors)]
        ids = lookup_regions(tensors[0], mask)
        assert torch.equal(ids, lookup_regions(tensors[0], labels))
        assert torch.equal(region_splat(*tensors, ids, mask), region_splat(*tensors, ids, labels))

    def test_noise_keeps_no_table(self, monkeypatch: pytest.MonkeyPatch) -> None:
        regions = RegionMap(blobs(), 0.7)
        monkeypatch.setattr("kcgs.maps.table_of_labels._MOST_PLANES", 1)
        noise = RegionMap(blobs(), 0.7)
        assert table_and_size(regions)[0].weights is not None and table_and_size(noise)[0].weights is None
        field = GaussianField.random(20, (45, 70), regions=regions, seed=0)
        for size in ((45, 70), (60, 70)):
            assert torch.equal(Scene(field, noise).render(size), Scene(field, regions).render(size))
        assert torch.equal(noise.membership(0), regions.membership(0))

    def test_moves_all_its_tensors(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """By the methods of tensors, of which this machine may have none."""
        regions, moved = RegionMap(blobs(), {(0, 1): 0.7}), []
        for name in ("cuda", "pin_memory"):
            monkeypatch.setattr(Tensor, name, lambda tensor: moved.append(tensor) or tensor.clone())
            other = getattr(regions, name)()
            assert other is not regions and torch.equal(other.labels, regions.labels)
            assert other.softness == regions.softness and other.resize((9, 9)).size == (9, 9)
        assert len(moved) == 2 * 9


def test_resized_maps_merge_and_stack_as_their_sources() -> None:
    labels = torch.zeros(40, 40).long()
    labels[:, 20:], labels[7, 7] = 1, 2  # region 2 has no pixel of the small map
    regions = RegionMap(labels, {(0, 1): 0.5, (0, 2): 1.0, (1, 2): 1.3})
    for size in ((10, 10), (80, 80)):
        resized = regions.resize(size)
        merged, new_ids = resized.merge([(0, 2)])
        expected, expected_ids = regions.merge([(0, 2)])
        assert merged is not None and expected is not None and torch.equal(new_ids, expected_ids)
        assert torch.equal(merged.membership(0), expected.resize(size).membership(0))
        assert torch.equal(RegionMap.stack([resized, resized])[1].membership(0), resized.membership(0))
    with pytest.raises(ValueError, match="maps must be at least one, .* and resized from one size; got"):
        RegionMap.stack([regions.resize((10, 10)), RegionMap(labels[:10, :10])])


def test_membership_of_ids_of_any_kind() -> None:
    """One id counts once, however it is written."""
    regions = RegionMap(torch.tensor([[3, 3, 7, 9]]))
    three = regions.membership(3)
    assert three.tolist() == [[1, 1, 0, 0]]
    for ids in (np.int64(3), regions.ids[0], torch.tensor([3, 3]), np.array([3, 3]), {3}, (i for i in (3, 3, 99))):
        assert torch.equal(regions.membership(ids), three)
    assert not regions.membership([]).any()
    for number in (3.5, [3, 3.5], torch.tensor(3.5)):
        with pytest.raises(TypeError, match="region_ids must have an integer dtype; got torch.float32"):
            regions.membership(number)


def test_relabel_refuses_an_unknown_word() -> None:
    with pytest.raises(ValueError, match="new_contours must be 'hard' or 'mean'; got 'soft'"):
        RegionMap(blobs()).relabel(blobs(), "soft")  # type: ignore[arg-type]


class TestPairSoftness:
    def test_one_value_for_every_pair_is_a_number(self) -> None:
        labels = torch.tensor([[3, 5, 9]])
        assert RegionMap(labels, {(3, 5): 0.7, (9, 3): 0.7, (5, 9): 0.7}).softness == 0.7
        assert RegionMap(labels, {(3, 5): 0.0}).softness == 0.0
        assert RegionMap(torch.ones(2, 2).long(), {}).softness == 0.0

    def test_merged_regions_have_the_mean_along_their_contours(self) -> None:
        regions = RegionMap(torch.tensor([[1, 2, 3, 4]]), {(1, 2): 0.6, (1, 3): 1.0, (2, 3): 0.5, (3, 4): 0.3})
        merged, new_ids = regions.merge([(2, 3)])
        assert merged is not None and new_ids.tolist() == [1, 2, 2, 4]
        assert merged.labels.tolist() == [[1, 2, 2, 4]]
        assert dict(merged.softness) == {(1, 2): pytest.approx(0.8), (2, 4): 0.3}

    def test_read_in_either_order_and_never_written(self) -> None:
        pairs = {(9, 3): 0.7, (3, 5): 1}
        softness = RegionMap(torch.tensor([[3, 5, 9]]), pairs).softness
        assert isinstance(softness, PairSoftness)
        assert list(softness.items()) == [((3, 5), 1.0), ((3, 9), 0.7)]
        assert softness[9, 3] == softness[3, 9] == 0.7 and (5, 9) not in softness
        pairs[9, 3] = 2.0
        assert softness == {(3, 5): 1.0, (3, 9): 0.7}
        with pytest.raises(TypeError):
            softness[3, 9] = 1.0  # type: ignore[index]

    @pytest.mark.parametrize(
        ("softness", "error", "words"),
        [
            ({(0, 4): 0.7}, ValueError, r"softness must map pairs of two different ids in the map; got \(0, 4\)"),
            ({(0, 1): 0.7, (1, 0): 0.7}, ValueError, r"name a pair once; got \(0, 1\) and \(1, 0\)"),
            ({(0, 1): 64.5}, ValueError, r"softness of \(0, 1\) must be in \[0, 64\] pixels; got 64.5"),
            ({0: 0.7}, TypeError, "softness must map pairs of ids to pixels; got the key 0"),
        ],
    )
    def test_exception(self, softness: object, error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            RegionMap(blobs(), softness)  # type: ignore[arg-type]


class TestSoftnessOfEachMap:
    """Maps of a batch may differ in softness: each is as it is alone."""

    SOFTNESS: ClassVar[list[Any]] = [0.0, 0.7, {(0, 1): 0.7, (1, 2): 2.0}, {(0, 1): 1.3}]

    def batch(self) -> tuple[Tensor, RegionMap]:
        labels = torch.stack([blobs(seed=k) for k in range(4)])
        return labels, RegionMap(labels, self.SOFTNESS)

    def test_parts_copies_and_files(self, tmp_path: Path) -> None:
        labels, regions = self.batch()
        assert isinstance(regions.softness, tuple) and regions.softness[1] == 0.7 and regions[1].softness == 0.7
        assert regions[2:].softness == regions.softness[2:] and regions[2].softness == regions.softness[2]
        field = GaussianField.stack([GaussianField.random(5, (45, 70), regions=one, seed=0) for one in labels])
        Scene(field, regions).save(tmp_path / "scenes.safetensors")
        others = [pickle.loads(pickle.dumps(regions)), RegionMap.from_state(regions.state()), regions.resize((45, 70))]
        for other in [*others, load(tmp_path / "scenes.safetensors").regions]:
            assert other.softness == regions.softness
            assert torch.equal(membership_of(other).tiled_table.weights, membership_of(regions).tiled_table.weights)
        assert RegionMap(labels, [0.7] * 4).softness == 0.7
        assert torch.equal(regions.merge([(0, 3)])[0].labels, torch.where(labels == 3, 0, labels))

    def test_other_labels(self) -> None:
        labels, regions = self.batch()
        moved = regions.relabel(labels.flip(2), "mean")
        for k in range(4):
            assert moved[k].softness == regions[k].relabel(labels[k].flip(1), "mean").softness

    @pytest.mark.parametrize(
        ("labels", "softness", "words"),
        [
            (blobs(), [0.7], "softness must be that of one map; got 1 of them"),
            (blobs()[None], [0.7, 0.7], "softness must be one, or one for each of 1 maps; got 2 of them"),
            (torch.tensor([[[1, 2]], [[3, 4]]]), [{(3, 4): 0.7}, 0.0], r"different ids in the map; got \(3, 4\)"),
        ],
    )
    def test_exception(self, labels: Tensor, softness: Any, words: str) -> None:
        with pytest.raises(ValueError, match=words):
            RegionMap(labels, softness)


def test_pairs_of_a_batch_that_touch_anew_have_the_mean() -> None:
    regions = RegionMap(torch.tensor([[[1, 1, 2, 5]], [[1, 2, 2, 5]]]), {(1, 2): 0.6, (2, 5): 1.0})
    assert dict(regions.relabel(torch.tensor([[[1, 1, 2, 5]], [[1, 5, 2, 2]]]), "mean").softness)[1, 5] == 0.8


def stated_antialiasing(labels: Tensor, x: int, y: int) -> tuple[int, float]:
    """Label and part of the neighbour that takes most of a pixel, by the definition in docs/method.md."""
    height, width = labels.shape

    def read(i: int, j: int) -> int:
        return int(labels[min(max(j, 0), height - 1), min(max(i, 0), width - 1)])

    best = (read(x, y), 0.0)
    for dx, dy in ((0, -1), (0, 1), (-1, 0), (1, 0)):
        # i along the contour, j across it: 0 is the pixel's side, 1 that of the neighbour
        def side(i: int, j: int, dx: int = dx, dy: int = dy) -> int:
            return read(x + (i if dy else j * dx), y + (j * dy if dy else i))

        own, other = side(0, 0), side(0, 1)
        if own == other:
            continue
        ends = []
        for way in (-1, 1):
            n = 0
            while n < 32 and side(n * way, 0) == own and side(n * way, 1) == other:
                n += 1
            along = (x if dy else y) + n * way
            step = 0
            if n == 32 or not 0 <= along < (width if dy else height):
                n = 33
            elif side(n * way, 0) == side(n * way, 1) == other:
                step = 0 if side(n * way, -1) == other and side((n - 1) * way, -1) == own else 1
            elif side(n * way, 0) == side(n * way, 1) == own:
                step = 0 if side(n * way, 2) == own and side((n - 1) * way, 2) == other else -1
            ends.append((n - 1, step))
        (left, first), (right, last) = ends
        place = (right - left) / (left + right + 1)
        taken = ((first - last) * place + (first + last) * place**2) / 4
        if taken > best[1] + 1e-12:
            best = other, taken
    return best


def stated_weights(labels: Tensor, widths: Tensor) -> Tensor:
    """Antialiased labels by their definition, (R, H, W); `widths` are those of the contours of pixels."""
    height, width = labels.shape
    parts = [[stated_antialiasing(labels, x, y) for x in range(width)] for y in range(height)]
    other, share = (torch.tensor([[part[k] for part in row] for row in parts], dtype=torch.float64) for k in (0, 1))
    weights = []
    for region in labels.unique().tolist():
        inside = (labels == region).double()
        own = torch.from_numpy(ndimage.convolve(inside.numpy(), np.outer([1, 2, 1], [1, 2, 1]), mode="nearest"))
        is_line = (inside > 0) & (own <= 8) & (widths < 0.7)
        gain = torch.where(is_line, 21.6 / own.clamp_min(1) - 1, 1.0)
        weights.append(inside * (1 - share) * gain + (other == region) * share)
    return torch.stack(weights)


def stated_membership(antialiased: Tensor, widths: Tensor, size: tuple[int, int]) -> Tensor:
    """Memberships at another size by their definition, from antialiased labels: (R, H, W)."""
    shares, ones = [], torch.ones(widths.shape, dtype=torch.float64)
    for inside in antialiased:
        weights = torch.zeros_like(inside)
        for blur in widths.clamp_min(0.7).unique().tolist():
            radius = math.ceil(4 * blur)
            blurred, total = (
                torch.from_numpy(ndimage.gaussian_filter(part.numpy(), blur, mode="constant", radius=radius))
                for part in (inside, ones)
            )
            weights = torch.where(widths.clamp_min(0.7) == blur, blurred / total, weights)
        shares.append(weights)
    stacked = torch.stack([*shares, widths.square()])
    # torch's own bilinear resampling holds the border and puts pixels at their centres, as we do
    *means, variance = torch.nn.functional.interpolate(stacked[None], size, mode="bilinear", align_corners=False)[0]
    ratio = size[0] * size[1] / widths.numel()
    exponent = (variance.clamp_min(0.49) + 0.25) * ratio / ((variance - 0.25).clamp_min(0) * ratio + 0.25)
    powers = torch.stack(means) ** exponent.sqrt()
    return powers / powers.sum(0)


class TestResize:
    def test_labels_and_softness(self) -> None:
        labels = torch.zeros(40, 40).long()
        labels[:, 20:], labels[7, 7] = 1, 2
        regions = RegionMap(labels, {(0, 1): 0.5, (0, 2): 40.0, (1, 2): 1.3})
        large = regions.resize((120, 120))
        assert torch.equal(large.labels[1::3, 1::3], labels)
        assert large.softness == {(0, 1): 0.5, (0, 2): 64.0, (1, 2): pytest.approx(math.sqrt(9 * 1.44 + 0.25))}
        assert regions.resize((10, 10)).num_regions == 3
        assert large.resize((40, 40)) is regions and large.resize((120, 120)) is large
        assert RegionMap(torch.zeros(4, 5).long()).resize((9, 9)).num_regions == 1

    @pytest.mark.parametrize("softness", [0.0, {(0, 1): 0.0, (0, 2): 1.1, (1, 2): 2.3}])
    def test_memberships_are_the_stated_ones(self, softness: Any) -> None:
        """For whole maps and in tiles."""
        labels = blobs() % 3
        labels[9, 5:30], labels[20:24, 40], labels[30, 12] = 1, 2, 0
        regions = RegionMap(labels, softness)
        widths = membership_of(regions).variances[0].sqrt()
        weights = stated_weights(labels, widths)
        for size in ((23, 31), (91, 140), (7, 500), (1, 1)):
            resized = membership_of(regions.resize(size))
            for region, expected in enumerate(stated_membership(weights, widths, size)):
                assert (full_map(resized.tiled_table, 0, region) - expected).abs().max() < 1e-6
                assert (resized.weights(0, region, torch.float64) - expected).abs().max() < 1e-6

    def test_renders_alike_everywhere(self, backend: str) -> None:
        regions = RegionMap(blobs(), 0.6)
        field = GaussianField.random(40, (45, 70), regions=regions, seed=0)
        render = RegionSplatRenderer(backend=backend)
        image = render(field, regions, (90, 140))
        torch.testing.assert_close(image, Scene(field, regions)((90, 140)), rtol=1e-4, atol=1e-4)
        assert torch.equal(image, render(field, regions.resize((90, 140)), (90, 140)))

    def test_bad_size(self) -> None:
        with pytest.raises(ValueError, match="size must"):
            RegionMap(blobs()).resize((0, 3))


class TestLookup:
    def test_floor_and_clamp(self) -> None:
        labels = torch.arange(6).view(2, 3)
        means = torch.tensor([[0.0, 0.0], [0.999, 0.999], [1.0, 1.0], [2.9, 1.9], [-5.0, 9.0], [1e9, -1e9]])
        assert lookup_regions(means, labels).tolist() == [0, 0, 4, 5, 3, 2]
        maps = torch.stack([torch.zeros(2, 2), torch.ones(2, 2)]).long()
        assert lookup_regions(torch.zeros(2, 3, 2), maps).tolist() == [[0, 0, 0], [1, 1, 1]]
        with pytest.raises(ValueError, match="labels of shape"):
            lookup_regions(torch.zeros(3, 2), maps)


class TestEdgeBand(BaseTester, without={"test_gradcheck": "labels are integers", "test_module": "a function only"}):
    def test_smoke(self, device: torch.device) -> None:
        band = edge_band(blobs().to(device))
        assert band.device.type == device.type and band.dtype == torch.bool and band.any()

    def test_cardinality(self, device: torch.device) -> None:
        maps = torch.stack([blobs(seed=k) for k in range(2)]).to(device)
        assert torch.equal(edge_band(maps), torch.stack([edge_band(one) for one in maps]))

    def test_dynamo(self, device: torch.device, dtype: torch.dtype) -> None:
        self.assert_compiles(lambda labels: edge_band(labels, 2).to(dtype), blobs().to(device))

    def test_feature(self) -> None:
        """The band is found by distances to another label."""
        labels = blobs()
        distance = torch.full(labels.shape, math.inf, dtype=torch.float64)
        for r in labels.unique().tolist():
            inside = labels == r
            there = torch.from_numpy(ndimage.distance_transform_edt(inside.numpy()))
            distance[inside] = there[inside]
        for width in (1, 1.5, 2, 5):
            assert torch.equal(edge_band(labels, width), distance <= width)
        assert not edge_band(torch.ones(9, 9).long()).any()
        # smaller than the band
        assert edge_band(torch.tensor([[0, 1]])).all() and edge_band(torch.tensor([[0], [1], [1]])).all()

    @pytest.mark.parametrize("width", [0.5, math.inf, "5"])
    def test_exception(self, width: Any) -> None:
        with pytest.raises((TypeError, ValueError), match="width must be"):
            edge_band(blobs(), width)
