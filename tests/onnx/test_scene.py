"""Scene decoders against the renderer: any size, any contours, and what they leave out."""

from __future__ import annotations

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene
from kcgs.functional import region_splat
from kcgs.onnx import describe_decoder, plan, scene_decoder

SIZES = [(37, 53), (74, 106), (111, 160), (20, 31), (1, 1), (5, 300)]


def blobs(size: tuple[int, int], count: int, seed: int = 0) -> Tensor:
    """Voronoi regions of random points: `count` regions, ids not consecutive."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 2, generator=generator) * torch.tensor(size)
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in size), indexing="ij")
    nearest = ((y[..., None] - points[:, 0]) ** 2 + (x[..., None] - points[:, 1]) ** 2).argmin(-1)
    return 3 * nearest + 2


def scattered(
    count: int, size: tuple[int, int], regions: RegionMap | None = None, channels: int = 3, seed: int = 0
) -> GaussianField:
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 2, generator=generator) * torch.tensor([size[1], size[0]]) * 1.2 - 2
    sigma = 0.5 + 0.1 * min(size) * torch.rand(count, 1, generator=generator)
    factors = torch.rand(count, 3, generator=generator) + torch.tensor([0.4, -0.5, 0.4])
    colors = torch.rand(count, channels, generator=generator) - 0.2
    field = GaussianField(means, sigma * factors, colors, size=size)
    if regions is not None:
        field.assign_regions(regions)
    return field


def session_of(model: onnx.ModelProto) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model.SerializeToString(), options)


def decode(session: onnxruntime.InferenceSession, size: tuple[int, int], **feeds: object) -> Tensor:
    (image,) = session.run(None, {"size": np.array(size), **feeds})
    return torch.from_numpy(image)[0]


def assert_same(
    field: GaussianField,
    regions: RegionMap | None,
    sizes: list[tuple[int, int]],
    cutoff: float = 1e-4,
    clamp: bool = False,
    contours: str = "scaled",
) -> None:
    session = session_of(scene_decoder(Scene(field, regions), cutoff=cutoff, clamp=clamp, contours=contours))
    bound = 1e-3 if cutoff >= 1e-4 else 1e-4
    for size in sizes:
        with torch.no_grad():
            want = RegionSplatRenderer(cutoff=cutoff, clamp=clamp, contours=contours)(field, regions, size)
        got = decode(session, size)
        assert got.shape == want.shape
        assert (got - want).abs().max() < bound, size


@pytest.mark.parametrize("interactive", [False, True])
def test_every_constant_is_read(interactive: bool) -> None:
    """The runtime says so of others, at every load."""
    regions = RegionMap.from_labels(blobs((37, 53), 4), 0.8)
    graphs = [scene_decoder(Scene(scattered(40, (37, 53), regions), regions), interactive=interactive).graph]
    read: set[str] = set()
    stored: set[str] = set()
    for graph in graphs:  # grows by the graphs inside
        stored |= {value.name for value in graph.initializer}
        read |= {name for node in graph.node for name in node.input} | {value.name for value in graph.output}
        graphs += [attribute.g for node in graph.node for attribute in node.attribute if attribute.HasField("g")]
    assert stored and stored <= read


class TestImage:
    @pytest.mark.parametrize("contours", ["scaled", "crisp"])
    @pytest.mark.parametrize("cutoff", [1e-4, 1e-6, 0.0])
    @pytest.mark.parametrize("kind", ["none", "hard", "soft", "pairs"])
    def test_any_size(self, kind: str, cutoff: float, contours: str) -> None:
        size = (37, 53)
        labels = blobs(size, 7)
        regions = {
            "none": None,
            "hard": RegionMap.from_labels(labels),
            "soft": RegionMap.from_labels(labels, 0.8),
            "pairs": RegionMap.from_labels(labels, {(2, 5): 0.0, (5, 8): 1.7, (2, 11): 0.6}),
        }[kind]
        assert_same(scattered(80, size, regions), regions, [size, *SIZES], cutoff, contours=contours)

    @pytest.mark.parametrize("softness", [3.9, 6.0, {(2, 5): 5.0, (5, 8): 0.4}])
    def test_wide_contours(self, softness: float | dict[tuple[int, int], float]) -> None:
        """Those that are blurred in the graph, and those that are stored as weights."""
        size = (40, 72)
        regions = RegionMap.from_labels(blobs(size, 5), softness)
        assert_same(scattered(80, size, regions), regions, [size, (55, 90)])

    @pytest.mark.parametrize("softness", [0.0, 0.7])
    @pytest.mark.parametrize("count", [1, 2, 50])
    def test_any_number_of_regions(self, count: int, softness: float) -> None:
        size = (90, 120)
        regions = RegionMap.from_labels(blobs(size, count), softness)
        assert_same(scattered(300, size, regions), regions, [size, (131, 200)])

    @pytest.mark.parametrize("count", [1, 17, 10_000])
    def test_any_number_of_gaussians(self, count: int) -> None:
        size = (64, 96)
        regions = RegionMap.from_labels(blobs(size, 4), 0.7)
        field = scattered(count, size, regions)
        field.colors.data /= max(1, count // 300)  # an image, not a sum of thousands
        assert_same(field, regions, [size, (100, 100)])

    @pytest.mark.parametrize("channels", [1, 4])
    def test_channels(self, channels: int) -> None:
        size = (40, 56)
        regions = RegionMap.from_labels(blobs(size, 3))
        assert_same(scattered(60, size, regions, channels), regions, [size, (41, 57)])

    def test_one_pixel_regions_and_narrow_gaussians(self) -> None:
        size = (33, 34)
        y, x = torch.meshgrid(*(torch.arange(n) for n in size), indexing="ij")
        regions = RegionMap.from_labels((y + x) % 2)
        field = scattered(100, size, regions)
        field.cholesky.data[::2] *= 0.02
        assert_same(field, regions, [size, (66, 68)])
        assert_same(field, regions, [size, (66, 68)], 1e-6)

    def test_needles_giants_and_absent(self) -> None:
        field = GaussianField(
            torch.tensor([[20.0, 20.0], [1e5, 0.0], [30.0, 10.0], [-400.0, 20.0], [10.0, 30.0]]),
            torch.tensor([[1e3, 1e3, 0.3], [1.0, 0.0, 1.0], [1e4, 0.0, 1e4], [100.0, 0.0, 5.0], [2e-6, 0.0, 2e-6]]),
            torch.full((5, 3), 0.3),
            size=(48, 64),
        )
        assert_same(field, None, [(48, 64), (96, 128), (47, 65)])
        (means,) = (t for t in scene_decoder(Scene(field)).graph.initializer if t.dims[1:] == [2])
        assert means.dims[0] == field.num_gaussians - 1

    def test_nothing_to_render(self) -> None:
        field = GaussianField(
            torch.tensor([[-1e4, 0.0]]), torch.tensor([[1.0, 0.0, 1.0]]), torch.ones(1, 3), size=(20, 30)
        )
        assert decode(session_of(scene_decoder(Scene(field))), (40, 50)).abs().max() == 0

    def test_clipped_unless_asked_otherwise(self) -> None:
        field = scattered(40, (40, 60))
        field.colors.data = 8 * field.colors.data - 2
        plain, clipped = (
            decode(session_of(scene_decoder(Scene(field), **o)), (40, 60)) for o in ({"clamp": False}, {})
        )
        assert plain.min() < -0.1 and plain.max() > 1.1
        assert torch.equal(clipped, plain.clamp(0, 1))

    def test_opacities_and_clamp(self) -> None:
        field = GaussianField(
            torch.rand(20, 2) * 30, torch.tensor([[4.0, 0.0, 4.0]]).repeat(20, 1), 2 * torch.rand(20, 3) - 0.5,
            opacities=torch.rand(20), size=(30, 30),
        )  # fmt: skip
        assert_same(field, None, [(30, 30), (60, 40)], clamp=True)

    @pytest.mark.filterwarnings("ignore:.* Gaussians paint nothing")
    @pytest.mark.parametrize("count", [1, 2])
    def test_ids_that_the_map_has_not(self, count: int) -> None:
        size = (40, 50)
        regions = RegionMap.from_labels(blobs(size, count))
        field = scattered(30, size, regions)
        field.region_ids[::2] = 999
        assert_same(field, regions, [size, (33, 71)])
        session = session_of(scene_decoder(Scene(field, regions), clamp=False, interactive=True))
        view, every = np.array([0, 0, 50, 40], np.float32), np.ones(count, np.float32)
        with torch.no_grad():
            assert (
                decode(session, size, view=view, visible=every) - RegionSplatRenderer()(field, regions)
            ).abs().max() < 1e-3


class TestCoarseGrids:
    """Wide Gaussians on grids that the decoder makes when it is loaded."""

    @pytest.fixture(autouse=True)
    def always(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """However small the image is."""
        monkeypatch.setattr(plan, "_GRIDS_COST", -(10**9))

    @pytest.mark.parametrize("kind", ["none", "hard", "soft", "wide", "pairs"])
    def test_any_size(self, kind: str) -> None:
        size = (75, 101)
        labels = blobs(size, 7)
        regions = {
            "none": None,
            "hard": RegionMap.from_labels(labels),
            "soft": RegionMap.from_labels(labels, 0.8),
            "wide": RegionMap.from_labels(labels, 6.0),
            "pairs": RegionMap.from_labels(labels, {(2, 5): 0.0, (5, 8): 1.7, (2, 11): 0.6}),
        }[kind]
        field = scattered(60, size, regions)
        assert plan.plan_decoder(field, regions, 1e-4).nodes is not None
        assert_same(field, regions, [size, (150, 202), (110, 160), (41, 51), (1, 1), (5, 300)])

    def test_only_wide_gaussians(self) -> None:
        """No list of Gaussians is left for the pixels."""
        size = (48, 80)
        regions = RegionMap.from_labels(blobs(size, 3), 0.6)
        for chosen in (None, regions):
            field = scattered(8, size, chosen)
            field.cholesky.data = torch.tensor([[12.0, 3.0, 9.0]]).repeat(8, 1)
            assert_same(field, chosen, [size, (96, 160)])
        # beyond the border its values are held
        session = session_of(scene_decoder(Scene(field, regions), clamp=False, interactive=True))
        around = decode(session, (56, 88), view=np.array([-4, -4, 84, 52], np.float32), visible=np.ones(3, np.float32))
        inside = RegionSplatRenderer()(field, regions).detach()
        assert (around[:, 4:-4, 4:-4] - inside).abs().max() < 1e-3
        assert torch.equal(around[:, :3], around[:, 1:4]) and (around[:, 3] - around[:, 4]).abs().max() < 0.05
        assert torch.equal(around[:, :, -3:], around[:, :, -4:-1])

    def test_pans_at_native_scale_are_sharp(self) -> None:
        """Rounding of a view's ends asks for no more pixels than it has: moved by a pixel, it shows the same."""
        size = (32, 64)
        field = scattered(60, size)
        session = session_of(scene_decoder(Scene(field), clamp=False, interactive=True))
        every = np.ones(1, np.float32)
        for left in (0.1, 3.3, 7.7, 11.9, 12.30001):
            views = [np.array([left + k, 0.2, left + k + 32, 24.2], np.float32) for k in (0, 1)]
            first, second = (decode(session, (24, 32), view=view, visible=every) for view in views)
            assert (first[:, :, 1:] - second[:, :, :-1]).abs().max() < 1e-3

    def test_views_far_beyond_the_scene_are_bounded(self) -> None:
        size = (32, 64)
        session = session_of(scene_decoder(Scene(scattered(60, size)), interactive=True))
        view = np.array([-3e5, -3e5, 3e5, 3e5], np.float32)
        assert decode(session, (9, 9), view=view, visible=np.ones(1, np.float32)).shape == (3, 9, 9)

    @pytest.mark.parametrize("contours", ["scaled", "crisp"])
    def test_view_and_visible(self, contours: str) -> None:
        size = (80, 112)
        regions = RegionMap.from_labels(blobs(size, 5), 0.6)
        field, render = scattered(80, size, regions), RegionSplatRenderer(contours=contours)
        model = scene_decoder(Scene(field, regions), clamp=False, interactive=True, contours=contours)
        assert describe_decoder(model)["contours"] == {"scaled": "soft", "crisp": "crisp"}[contours]
        session = session_of(model)
        whole, every = np.array([0, 0, 112, 80], np.float32), np.ones(5, np.float32)
        with torch.no_grad():
            large = render(field, regions, (80 * 4, 112 * 4))
        part = decode(session, (50, 100), view=np.array([10, 7, 35, 19.5], np.float32), visible=every)
        assert (part - large[:, 28:78, 40:140]).abs().max() < 1e-3
        for hidden in range(5):
            factor = every.copy()
            factor[hidden] = 0
            left = field.subset(field.region_ids != regions.ids[hidden])
            with torch.no_grad():
                want = render(left, regions)
            assert (decode(session, size, view=whole, visible=factor) - want).abs().max() < 1e-3


class TestInteractive:
    def test_view_and_visible(self) -> None:
        size = (48, 80)
        regions = RegionMap.from_labels(blobs(size, 5), 0.6)
        field = scattered(150, size, regions)
        session = session_of(scene_decoder(Scene(field, regions), clamp=False, interactive=True))
        whole = np.array([0, 0, 80, 48], np.float32)
        every = np.ones(5, np.float32)
        with torch.no_grad():
            large = RegionSplatRenderer()(field, regions, (48 * 8, 80 * 8))
        assert (decode(session, (48 * 8, 80 * 8), view=whole, visible=every) - large).abs().max() < 1e-3
        # a part at the same scale, across tiles
        part = decode(session, (100, 200), view=np.array([10, 7, 35, 19.5], np.float32), visible=every)
        assert (part - large[:, 56:156, 80:280]).abs().max() < 1e-3
        # beyond the border there is what the formula says, and nothing breaks
        assert torch.isfinite(
            decode(session, (50, 50), view=np.array([-30, -30, 5, 5], np.float32), visible=every)
        ).all()
        for hidden in range(5):
            factor = every.copy()
            factor[hidden] = 0
            left = field.subset(field.region_ids != regions.ids[hidden])
            with torch.no_grad():
                want = RegionSplatRenderer()(left, regions)
            assert (decode(session, size, view=whole, visible=factor) - want).abs().max() < 1e-3

    @pytest.mark.parametrize("softness", [0.0, 0.8])
    def test_beyond_the_border_its_labels_are_held(self, softness: float) -> None:
        size, pad = (48, 64), 64
        labels = blobs(size, 5)
        regions = RegionMap.from_labels(labels, softness)
        field = scattered(60, size, regions)
        session = session_of(scene_decoder(Scene(field, regions), clamp=False, interactive=True))
        held = torch.nn.functional.pad(labels[None, None].double(), (pad,) * 4, mode="replicate")[0, 0].long()
        shares = [regions.tables.membership.weights(0, r, torch.float64) for r in range(5)]
        shares = [torch.nn.functional.pad(s[None, None], (pad,) * 4, mode="replicate")[0, 0] for s in shares]
        moved = (field.means.detach() + pad, field.cholesky.detach(), field.colors.detach())
        want = torch.zeros(3, *held.shape)
        for r, share in enumerate(shares):
            own = field.region_ids == regions.ids[r]
            want += share * region_splat(*(t[own] for t in moved), size=tuple(held.shape))
        view = np.array([-pad, -pad, size[1] + pad, size[0] + pad], np.float32)
        got = decode(session, tuple(held.shape), view=view, visible=np.ones(5, np.float32))
        inside = (slice(None), slice(pad, pad + size[0]), slice(pad, pad + size[1]))
        assert (got[inside] - want[inside]).abs().max() < 1e-3
        # lists are of the tiles of the scene: near its border they hold what reaches
        rim = (slice(None), slice(pad - 4, pad + size[0] + 4), slice(pad - 4, pad + size[1] + 4))
        assert (got[rim] - want[rim]).abs().max() < 0.15

    def test_far_in(self) -> None:
        size = (48, 80)
        regions = RegionMap.from_labels(blobs(size, 5))
        session = session_of(
            scene_decoder(Scene(scattered(150, size, regions), regions), clamp=False, interactive=True)
        )
        view = np.array([40, 24, 40.5, 24.4], np.float32)
        assert torch.isfinite(decode(session, (400, 500), view=view, visible=np.ones(5, np.float32))).all()


class TestFile:
    def test_metadata(self) -> None:
        size = (64, 96)
        labels = torch.zeros(size, dtype=torch.long)
        labels[:, 40:] = 7
        hard = RegionMap.from_labels(labels)
        field = scattered(30, size, hard)
        facts = describe_decoder(scene_decoder(Scene(field, hard, {"recipe": "best"})))
        assert facts["region_ids"] == [0, 7] and facts["recipe"] == "best" and facts["contours"] == "hard"
        assert facts["format"] == "kcgs.decoder" and facts["height"] == "64"
        assert describe_decoder(scene_decoder(Scene(scattered(30, size))))["contours"] == "none"

    def test_leaves_out_operators(self) -> None:
        size = (64, 96)
        labels = torch.zeros(size, dtype=torch.long)
        labels[:, 40:] = 1

        def operators(field: GaussianField, regions: RegionMap | None, **options: bool) -> set[str]:
            return {node.op_type for node in scene_decoder(Scene(field, regions), **options).graph.node}  # type: ignore[arg-type]

        soft, hard = (RegionMap.from_labels(labels, s) for s in (0.7, 0.0))
        field = scattered(30, size, hard)
        none, some = operators(field, None), operators(field, hard)
        assert "ReduceMax" in some and not any(name.startswith("Scatter") for name in some | operators(field, soft))
        assert "Clip" in operators(field, None)
        counts = [len(scene_decoder(Scene(field, m)).graph.node) for m in (None, hard)]
        assert counts[0] < counts[1]
        assert not {"Loop", "NonZero"} & (none | some)

    def test_says_order_range_and_units(self) -> None:
        graph = scene_decoder(Scene(scattered(3, (20, 30))), interactive=True).graph
        docs = {value.name: value.doc_string for value in (*graph.input, *graph.output)}
        words = {"size": "height and width", "view": "left, top, right, bottom", "visible": "region_ids"}
        assert all(words[name] in docs[name] for name in words) and graph.doc_string
        assert "red, green, blue" in docs["image"] and "clipped to [0, 1]" in docs["image"]

    def test_recipe_of_any_name(self) -> None:
        assert (
            describe_decoder(scene_decoder(Scene(scattered(3, (20, 30)), metadata={"recipe": "[mine] v2"})))["recipe"]
            == "[mine] v2"
        )

    def test_same_scene_same_bytes(self) -> None:
        field = scattered(30, (40, 60))
        assert len({scene_decoder(Scene(field)).SerializeToString(deterministic=True) for _ in range(2)}) == 1

    def test_bytes_of_a_scene_with_regions(self, tmp_path: object) -> None:
        size = (480, 854)
        regions = RegionMap.from_labels(blobs(size, 6), 0.7)
        field = scattered(1250, size, regions)
        field.cholesky.data *= 0.2
        scene = Scene(field, regions)
        size_of_decoder = len(scene_decoder(scene).SerializeToString())
        assert size_of_decoder < 2.2 * scene.save(f"{tmp_path}/s.safetensors")


class TestBadInput:
    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"scene": scattered(5, (20, 30))}, "scene must be a Scene; got GaussianField"),
            ({"cutoff": 2.0}, "cutoff must"),
        ],
    )  # fmt: skip
    def test_says_what_is_wrong(self, change: dict[str, object], words: str) -> None:
        with pytest.raises((ValueError, TypeError), match=words):
            scene_decoder(**{"scene": Scene(scattered(5, (20, 30))), **change})  # type: ignore[arg-type]

    @pytest.mark.parametrize(
        ("shape", "words"), [((1, 20, 30), "scene must have one map"), ((20, 30), "scene must have region ids")]
    )
    def test_map_that_does_not_fit(self, shape: tuple[int, ...], words: str) -> None:
        with pytest.raises(ValueError, match=words):
            scene_decoder(Scene(scattered(5, (20, 30)), torch.zeros(shape).long()))

    def test_resized_map(self) -> None:
        regions = RegionMap.from_labels(blobs((20, 30), 3), 0.7)
        field = scattered(5, (40, 60), regions.resize((40, 60)))
        with pytest.raises(ValueError, match="resized"):
            scene_decoder(Scene(field, regions.resize((40, 60))))

    def test_batch(self) -> None:
        batch = GaussianField(torch.rand(2, 3, 2), torch.ones(2, 3, 3), torch.rand(2, 3, 3), size=(8, 8))
        with pytest.raises(ValueError, match="scene must be of one image; got a batch of"):
            scene_decoder(Scene(batch))


@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning", "ignore:.*:FutureWarning", "ignore:.*:UserWarning")
def test_chains_with_kornia(tmp_path: object) -> None:
    """A decoder before a Kornia module as torch exports it, through Kornia's own way of chaining."""
    from kornia.color import RgbToGrayscale
    from kornia.onnx import ONNXSequential

    path = f"{tmp_path}/gray.onnx"
    shape = {2: torch.export.Dim("height"), 3: torch.export.Dim("width")}
    example = torch.rand(1, 3, 24, 32)
    torch.onnx.export(
        RgbToGrayscale(), (example,), path, input_names=["color"], output_names=["gray"],
        dynamo=True, opset_version=18, dynamic_shapes=({**shape},), external_data=False, verbose=False,
    )  # fmt: skip
    field = scattered(20, (32, 48))
    chain = ONNXSequential(scene_decoder(Scene(field), clamp=False), onnx.load(path), io_maps=[[("image", "color")]])
    (got,) = chain(np.array([40, 50]))
    with torch.no_grad():
        want = RgbToGrayscale()(RegionSplatRenderer()(field, size=(40, 50))[None])
    assert np.abs(got - want.numpy()).max() < 1e-3
