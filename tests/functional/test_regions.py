"""Label maps: compaction, memberships, look-up, resampling, the edge band."""

from __future__ import annotations

import copy
import math
import pickle

import pytest
import torch
from scipy import ndimage
from torch import Tensor

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene
from kcgs.functional import PairSoftness, edge_band, lookup_regions
from kcgs.kernels.tiles import TILE
from tests.tester import BaseTester


def blobs(size: tuple[int, int] = (45, 70), regions: int = 4, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    noise = torch.rand(1, regions, *size, generator=generator)
    return torch.nn.functional.avg_pool2d(noise, 9, stride=1, padding=4).argmax(1)[0]


class TestRegionMap(
    BaseTester,
    without={
        "test_gradcheck": "labels are integers, and memberships take no gradient",
        "test_module": "it is data, which a Scene keeps in its state",
    },
):
    @pytest.mark.parametrize("softness", [0.0, 0.7, {(0, 1): 0.5}])
    def test_smoke(
        self, device: torch.device, dtype: torch.dtype, softness: float | dict[tuple[int, int], float]
    ) -> None:
        regions = RegionMap.from_labels(blobs().to(device), softness)
        assert regions.labels.device.type == device.type and "4 regions, size=(45, 70)" in repr(regions)
        weights = regions.membership(0, dtype)
        assert weights.dtype == dtype and weights.isfinite().all() and weights.any()

    @pytest.mark.parametrize("lead", [(), (1,), (2,)])
    def test_cardinality(self, device: torch.device, lead: tuple[int, ...]) -> None:
        regions = RegionMap.from_labels(blobs((45, 69)).to(device).expand(*lead, 45, 69))
        assert regions.size == (45, 69) and regions.labels.shape == (*lead, 45, 69) and regions.ids.shape == (4,)
        assert regions.index.shape == (*(lead or (1,)), 45, 69)
        assert not lead or regions.image(0).labels.shape == (45, 69)
        assert regions.resize((7, 9)).labels.shape == (*lead, 7, 9)

    @pytest.mark.parametrize("softness", [0.0, 0.7])
    def test_dynamo(self, device: torch.device, dtype: torch.dtype, softness: float) -> None:
        """A map is made outside of a graph, for the number of its regions is found in values; read inside."""
        regions, other = (RegionMap.from_labels(blobs(seed=k).to(device), softness) for k in (0, 1))

        def shares(of: RegionMap) -> Tensor:
            return of.labels.to(dtype) / of.num_regions + of.size[0] + of.index_of(of.ids).sum()

        self.assert_compiles(shares, regions, backend="aot_eager")
        self.assert_compiles(shares, other, backend="aot_eager")

    def test_feature(self, device: torch.device) -> None:
        """Ids need not be consecutive."""
        regions = RegionMap.from_labels(torch.tensor([[255, 0], [7, 100_000]], device=device))
        assert regions.ids.tolist() == [0, 7, 255, 100_000]
        assert regions.num_regions == 4
        assert regions.index_of(torch.tensor([7, 8, 100_000, 0], device=device)).tolist() == [1, -1, 3, 0]

    @pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int32, torch.int64])
    def test_integer_dtypes(self, dtype: torch.dtype) -> None:
        assert RegionMap.from_labels(torch.tensor([[1, 2]], dtype=dtype)).labels.dtype == torch.int64

    @pytest.mark.parametrize(
        ("labels", "softness", "error", "words"),
        [
            (torch.zeros(3, 3), 0.0, TypeError, "labels must have an integer dtype; got torch.float32"),
            (torch.zeros(3, dtype=torch.long), 0.0, ValueError, "labels must have 2 or 3 dimensions"),
            (torch.zeros(0, 4, dtype=torch.long), 0.0, ValueError, "at least one pixel"),
            (-torch.ones(3, 3, dtype=torch.long), 0.0, ValueError, "non-negative ids; got -1"),
            (torch.zeros(3, 3, dtype=torch.long), -0.1, ValueError, r"softness must be in \[0, 64\] pixels; got -0.1"),
            (torch.zeros(3, 3, dtype=torch.long), math.nan, ValueError, "softness must be in"),
            (torch.zeros(3, 3, dtype=torch.long), "a", TypeError, "softness must be a number of pixels; got 'a'"),
            ([[0]], 0.0, TypeError, "labels must be a Tensor, a numpy array, a PIL image or a path; got list"),
        ],
    )
    def test_exception(self, labels: Tensor, softness: float, error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            RegionMap.from_labels(labels, softness)


class TestPairSoftness:
    def test_one_value_for_every_pair_is_a_number(self) -> None:
        labels = torch.tensor([[3, 5, 9]])
        assert RegionMap.from_labels(labels, {(3, 5): 0.7, (9, 3): 0.7, (5, 9): 0.7}).softness == 0.7
        assert RegionMap.from_labels(labels, {(3, 5): 0.0}).softness == 0.0
        assert RegionMap.from_labels(labels, {}).softness == 0.0
        assert RegionMap.from_labels(torch.ones(2, 2).long(), {}).softness == 0.0

    def test_merged_regions_have_the_mean_along_their_contours(self) -> None:
        regions = RegionMap.from_labels(
            torch.tensor([[1, 2, 3, 4]]), {(1, 2): 0.6, (1, 3): 1.0, (2, 3): 0.5, (3, 4): 0.3}
        )
        merged, new_ids = regions.merge([(2, 3)])
        assert merged is not None and new_ids.tolist() == [1, 2, 2, 4]
        assert merged.labels.tolist() == [[1, 2, 2, 4]]
        assert dict(merged.softness) == {(1, 2): pytest.approx(0.8), (2, 4): 0.3}

    def test_read_in_either_order_and_never_written(self) -> None:
        pairs = {(9, 3): 0.7, (3, 5): 1}
        softness = RegionMap.from_labels(torch.tensor([[3, 5, 9]]), pairs).softness
        assert isinstance(softness, PairSoftness)
        assert list(softness.items()) == [((3, 5), 1.0), ((3, 9), 0.7)]
        assert softness[9, 3] == softness[3, 9] == 0.7 and (5, 9) not in softness
        pairs[9, 3] = 2.0
        assert softness == {(3, 5): 1.0, (3, 9): 0.7}
        with pytest.raises(TypeError):
            softness[3, 9] = 1.0  # type: ignore[index]

    def test_pickle_copy_and_move(self) -> None:
        regions = RegionMap.from_labels(blobs((44, 70)), {(0, 1): 0.7, (2, 3): 1.0})
        regions.tables.membership.tiles(TILE)
        others = (pickle.loads(pickle.dumps(regions)), copy.deepcopy(regions), regions.to("meta"))
        for other in others:
            assert other.softness == regions.softness and other.resize((44, 70)) is other
            assert other.size == other.labels.shape == (44, 70) and other.index.shape == (1, 44, 70)
        assert others[2].labels.device.type == "meta"
        assert torch.equal(others[0].tables.membership.tiles(TILE).masks, regions.tables.membership.tiles(TILE).masks)

    @pytest.mark.parametrize(
        ("softness", "error", "words"),
        [
            ({(0, 4): 0.7}, ValueError, r"softness must map pairs of two different ids in the map; got \(0, 4\)"),
            ({(1, 1): 0.7}, ValueError, "softness must map pairs of two different ids"),
            ({(0, 1): 0.7, (1, 0): 0.7}, ValueError, r"name a pair once; got \(0, 1\) and \(1, 0\)"),
            ({(0, 1): 64.5}, ValueError, r"softness of \(0, 1\) must be in \[0, 64\] pixels; got 64.5"),
            ({(0, 1): -0.5}, ValueError, "softness of"),
            ({(0, 1): math.nan}, ValueError, "softness of"),
            ({(0, 1): "a"}, TypeError, r"softness of \(0, 1\) must be a number of pixels; got 'a'"),
            ({0: 0.7}, TypeError, "softness must map pairs of ids to pixels; got the key 0"),
            ({(0, 1, 2): 0.7}, TypeError, "softness must map pairs"),
            ({(0.0, 1.0): 0.7}, TypeError, "softness must map pairs"),
        ],
    )
    def test_exception(self, softness: object, error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            RegionMap.from_labels(blobs(), softness)  # type: ignore[arg-type]


class TestResize:
    def test_enlarged_centres_keep_their_labels(self) -> None:
        labels = blobs()
        large = RegionMap.from_labels(labels, 0.5).resize((45 * 5, 70 * 5))
        assert torch.equal(large.labels[2::5, 2::5], labels)
        assert large.softness == pytest.approx(2.5)

    def test_softness_scales_along(self) -> None:
        labels = torch.zeros(40, 40).long()
        labels[:, 20:], labels[7, 7] = 1, 2
        widths = {(0, 1): 0.5, (0, 2): 40.0, (1, 2): 0.0}
        regions = RegionMap.from_labels(labels, widths)
        assert regions.resize((80, 80)).softness == {(0, 1): 1.0, (0, 2): 64.0, (1, 2): 0.0}
        small = regions.resize((10, 10))
        assert small.num_regions == 3 and small.softness[0, 1] == 0.125

    @pytest.mark.parametrize("size", [(45, 71), (23, 31), (91, 140), (300, 70), (7, 500), (1, 1)])
    @pytest.mark.parametrize("softness", [0.8, {(0, 1): 0.0, (0, 2): 1.1, (1, 2): 2.3}])
    def test_soft_memberships_are_interpolated(self, size: tuple[int, int], softness: object) -> None:
        regions = RegionMap.from_labels(blobs() % 3, softness)  # type: ignore[arg-type]
        resized = regions.resize(size)
        assert resized.resize((45, 70)) is regions
        table = resized.tables.membership.tiles(16)
        tiles_x = -(-size[1] // 16)
        widths, level = regions.tables.membership.levels
        squares = torch.full((45, 70), widths[0] ** 2, dtype=torch.float64)
        for position, width in enumerate(widths):
            squares = squares if level is None else torch.where(level[0] == position, width**2, squares)
        own = [regions.tables.membership.weights(0, region, torch.float64) for region in range(3)]
        stacked = torch.stack([*own, squares])
        # torch's own bilinear resampling holds the border and puts pixels at their centres, as we do
        *means, variance = torch.nn.functional.interpolate(stacked[None], size, mode="bilinear", align_corners=False)[0]
        variance = variance.clamp_min(1e-6)
        if (lost := 1 - 45 * 70 / (size[0] * size[1])) > 0:
            exponent = ((variance + lost / 6) / (variance - lost / 12).clamp_min(lost / 24)).sqrt()
            powers = torch.stack(means) ** exponent
            means = [*(powers / powers.sum(0))]
        for region, expected in enumerate(means):
            result = resized.tables.membership.weights(0, region, torch.float64)
            assert (result - expected).abs().max() < 1e-8
            for key, mask in zip(table.keys.tolist(), table.mask_rows.tolist(), strict=True):
                if key % 3 != region:
                    continue
                y, x = key // 3 // tiles_x * 16, key // 3 % tiles_x * 16
                part = expected[y : y + 16, x : x + 16]
                shares = torch.ones(16, 16).double() if mask < 0 else table.masks[mask].view(16, 16)
                assert (shares[: part.shape[0], : part.shape[1]] - part).abs().max() < 1e-8
                expected[y : y + 16, x : x + 16] = 0.0
            assert expected.abs().max() < 1e-8, "tiles without the key have none of the region"

    @pytest.mark.parametrize("size", [(9, 9), (12, 18), (60, 66), (5, 7)])
    def test_largest_share_in_exact_arithmetic(self, size: tuple[int, int]) -> None:
        for labels in (torch.arange(36).view(6, 6), torch.arange(36).view(6, 6) % 7 % 2):
            result = RegionMap.from_labels(labels).resize(size).labels
            for i in range(size[0]):
                for j in range(size[1]):
                    shares: dict[int, int] = {}
                    (top, down), (left, across) = (
                        divmod((2 * at + 1) * 6 * 1024 - new * 1024, 2 * new * 1024)
                        for at, new in zip((i, j), size, strict=True)
                    )
                    # offsets in odd 2048ths of a pixel
                    down, across = (2 * (part // (2 * new)) + 1 for part, new in zip((down, across), size, strict=True))
                    for y, weight_y in ((top, 2048 - down), (top + 1, down)):
                        for x, weight_x in ((left, 2048 - across), (left + 1, across)):
                            label = int(labels[min(max(y, 0), 5), min(max(x, 0), 5)])
                            shares[label] = shares.get(label, 0) + weight_y * weight_x
                    best, *others = sorted(shares.values(), reverse=True)
                    assert not others or best > others[0], "no two labels tie"
                    assert shares[int(result[i, j])] == best

    @pytest.mark.parametrize("size", [(0, 3), (3,), (2.5, 3), "ab", None])
    def test_bad_size(self, size: object) -> None:
        with pytest.raises((ValueError, TypeError), match="size must"):
            RegionMap.from_labels(blobs()).resize(size)  # type: ignore[arg-type]


def stated_crisp(labels: Tensor, size: tuple[int, int]) -> Tensor:
    """Weights of crisp contours by their definition, from whole maps: (R, H, W)."""
    shares = []
    for region in labels.unique().tolist():
        inside = (labels == region).double().numpy()
        blurred, ones = (ndimage.gaussian_filter(a, 1.0, mode="constant", radius=4) for a in (inside, 0 * inside + 1))
        shares.append(torch.from_numpy(blurred / ones))
    stacked = torch.stack(shares)
    most, own = stacked.amax(0), torch.nn.functional.one_hot(labels).movedim(-1, 0).bool()
    stacked = torch.where(own & (stacked < most), most + 0.25, stacked)
    large = torch.nn.functional.interpolate(stacked[None], size, mode="bilinear", align_corners=False)[0]
    powers = large ** max(1.0, 2 * math.sqrt(size[0] * size[1] / labels.numel()))
    return powers / powers.sum(0)


class TestCrisp:
    @pytest.mark.parametrize("size", [(45, 70), (45, 71), (180, 280), (100, 70), (23, 31)])
    @pytest.mark.parametrize("softness", [0.0, 1.7])
    def test_weights_are_the_stated_ones(self, size: tuple[int, int], softness: float) -> None:
        """For whole maps and in tiles, whatever the contours' own widths."""
        labels = blobs()
        crisp = RegionMap.from_labels(labels, softness).resize(size, "crisp")
        assert crisp.contours == "crisp" and crisp.softness == 0.5 and crisp.size == size
        expected, table, tiles_x = stated_crisp(labels, size), crisp.tables.membership.tiles(16), -(-size[1] // 16)
        found = torch.zeros(4, -(-size[0] // 16) * 16, tiles_x * 16, dtype=torch.float64)
        for key, mask in zip(table.keys.tolist(), table.mask_rows.tolist(), strict=True):
            y, x = key // 4 // tiles_x * 16, key // 4 % tiles_x * 16
            found[key % 4, y : y + 16, x : x + 16] = 1.0 if mask < 0 else table.masks[mask].view(16, 16)
        # what is beyond the blur's reach of 4 deviations differs by less than its weights there
        assert (found[:, : size[0], : size[1]] - expected).abs().max() < 1e-6
        for region in range(4):
            assert (crisp.tables.membership.weights(0, region, torch.float64) - expected[region]).abs().max() < 1e-9

    def test_a_disc_is_round(self) -> None:
        """The half-way line stays within 0.4 pixels of the map from the circle; stairs are 0.7 off."""
        y, x = torch.meshgrid(*[torch.arange(64) + 0.5] * 2, indexing="ij")
        inside = (((x - 32) ** 2 + (y - 32) ** 2).sqrt() < 20.3).long()
        weights = RegionMap.from_labels(inside).resize((512, 512), "crisp").membership(1)
        y, x = torch.meshgrid(*[(torch.arange(512) + 0.5) / 8] * 2, indexing="ij")
        radius = ((x - 32) ** 2 + (y - 32) ** 2).sqrt()
        assert (weights[radius < 20.3 - 0.4] > 0.5).all() and (weights[radius > 20.3 + 0.4] < 0.5).all()

    @pytest.mark.parametrize("factor", [1, 3, 8])
    def test_one_pixel_wide_at_any_size(self, factor: int) -> None:
        """A straight edge, as steep as that of a blur by half a pixel of the image."""
        labels = (torch.arange(24) > 11).long().expand(24, 24)
        row = RegionMap.from_labels(labels, 2.0).resize((24 * factor, 24 * factor), "crisp").membership(1)[12 * factor]
        assert 0.9 < float(row.diff().max()) / math.erf(0.5 / (0.5 * math.sqrt(2))) < 1.15
        assert int(((row > 0.01) & (row < 0.99)).sum()) <= 4

    def test_thin_lines_stay(self) -> None:
        labels = torch.zeros(30, 40, dtype=torch.long)
        labels[12], labels[:, 20], labels[3, 5] = 1, 2, 3
        large = RegionMap.from_labels(labels).resize((150, 200), "crisp")
        shares = torch.stack([large.membership(k) for k in range(4)])
        assert torch.equal(shares.argmax(0)[2::5, 2::5], labels)
        assert (shares[1].amax(0)[:95] > 0.7).all() and (shares[2].amax(1) > 0.7).all()
        # about as wide as the line, 5 pixels there
        assert 2 <= (shares[1][:, 40] > 0.5).sum() <= 5

    def test_renders_alike_everywhere(self, backend: str) -> None:
        regions = RegionMap.from_labels(blobs(), 1.2)
        field = GaussianField.random(40, (45, 70), regions=regions, seed=0)
        crisp, scaled = RegionSplatRenderer(backend=backend, contours="crisp"), RegionSplatRenderer(backend=backend)
        assert "crisp" in repr(crisp) and "crisp" not in repr(scaled)
        image = crisp(field, regions, (90, 140))
        assert (image - scaled(field, regions, (90, 140))).abs().max() > 0.05
        torch.testing.assert_close(image, Scene(field, regions)((90, 140), "crisp"), rtol=1e-4, atol=1e-4)
        assert torch.equal(image, scaled(field, regions.resize((90, 140), "crisp"), (90, 140)))
        alone = RegionMap.from_labels(regions.labels.clone())  # of which no tables are kept
        assert torch.equal(image, crisp(field, alone, (90, 140)))
        assert torch.equal(crisp(field, regions), crisp(field, alone)) and not torch.equal(
            crisp(field, regions), scaled(field, regions)
        )

    def test_copies_and_parts(self) -> None:
        regions = RegionMap.from_labels(torch.stack([blobs(seed=0), blobs(seed=1)]), 0.7)
        crisp = regions.resize((90, 140), "crisp")
        others = pickle.loads(pickle.dumps(crisp)), copy.deepcopy(crisp), RegionMap.from_state(crisp.state())
        for other in others:
            assert other.contours == "crisp" and torch.equal(
                other.tables.membership.tiles(16).masks, crisp.tables.membership.tiles(16).masks
            )
        expected = crisp.tables.membership.weights(1, 2, torch.float64)
        torch.testing.assert_close(crisp.image(1).membership(2), expected, rtol=0, atol=1e-9)
        assert crisp.resize((45, 70)) is regions and crisp.resize((90, 140), "crisp") is crisp
        assert RegionMap.from_labels(torch.zeros(4, 5).long()).resize((4, 5), "crisp").num_regions == 1

    def test_other_words(self) -> None:
        regions = RegionMap.from_labels(blobs())
        with pytest.raises(ValueError, match="contours must be one of scaled, crisp; got 'sharp'"):
            regions.resize((90, 140), "sharp")
        with pytest.raises(ValueError, match="contours must be one of"):
            RegionSplatRenderer(contours="hard")


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

    @pytest.mark.parametrize("lead", [(), (1,), (3,)])
    def test_cardinality(self, device: torch.device, lead: tuple[int, ...]) -> None:
        maps = torch.stack([blobs(seed=k) for k in range(3)])[: lead[0]] if lead else blobs()
        band = edge_band(maps.to(device))
        assert band.shape == maps.shape
        assert not lead or torch.equal(band[-1], edge_band(maps[-1].to(device)))

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

    @pytest.mark.parametrize("width", [0, 0.5, -1, math.inf, math.nan])
    def test_exception(self, width: float) -> None:
        with pytest.raises(ValueError, match="width must be"):
            edge_band(blobs(), width)
