"""Scene decoders against the renderer: any size, any contours, and what they leave out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene
from kcgs.functional import region_splat
from kcgs.maps import membership_at, table_and_size
from kcgs.onnx import describe_decoder, plan, scene_decoder

PAIRS = {(2, 5): 0.0, (5, 8): 1.7, (2, 11): 0.6}
WIDE_PAIRS = {(2, 5): 5.0, (5, 8): 0.4}
SOFTNESS: dict[str, Any] = {"hard": 0.0, "soft": 0.8, "pairs": PAIRS, "wide": 6.0, "wide-pairs": WIDE_PAIRS}


def blobs(size: tuple[int, int], count: int) -> Tensor:
    """Voronoi regions of random points: `count` regions, ids not consecutive."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 2, generator=generator) * torch.tensor(size)
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in size), indexing="ij")
    nearest = ((y[..., None] - points[:, 0]) ** 2 + (x[..., None] - points[:, 1]) ** 2).argmin(-1)
    return 3 * nearest + 2


def scattered(count: int, size: tuple[int, int], regions: RegionMap | None = None, channels: int = 3) -> Scene:
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 2, generator=generator) * torch.tensor([size[1], size[0]]) * 1.2 - 2
    sigma = 0.5 + 0.1 * min(size) * torch.rand(count, 1, generator=generator)
    factors = torch.rand(count, 3, generator=generator) + torch.tensor([0.4, -0.5, 0.4])
    colors = torch.rand(count, channels, generator=generator) - 0.2
    colors /= max(1, count // 300)  # an image, not a sum of thousands
    field = GaussianField(means, sigma * factors, colors, size=size)
    return Scene(field if regions is None else field.assign_regions(regions), regions)


def with_regions(kind: str, count: int, size: tuple[int, int], regions: int = 7, channels: int = 3) -> Scene:
    if kind == "none":
        return scattered(count, size, None, channels)
    return scattered(count, size, RegionMap(blobs(size, regions), SOFTNESS[kind]), channels)


def one_pixel_regions() -> Scene:
    y, x = torch.meshgrid(*(torch.arange(n) for n in (33, 34)), indexing="ij")
    scene = scattered(100, (33, 34), RegionMap((y + x) % 2))
    scene.field.cholesky.data[::2] *= 0.02  # far below a pixel wide
    return scene


def needles_and_giants() -> Scene:
    means = torch.tensor([[20.0, 20.0], [1e5, 0.0], [30.0, 10.0], [-400.0, 20.0], [10.0, 30.0]])
    factors = [[1e3, 1e3, 0.3], [1.0, 0.0, 1.0], [1e4, 0.0, 1e4], [100.0, 0.0, 5.0], [2e-6, 0.0, 2e-6]]
    return Scene(GaussianField(means, torch.tensor(factors), torch.full((5, 3), 0.3), size=(48, 64)))


def nothing_to_render() -> Scene:
    means, factors = torch.tensor([[-1e4, 0.0]]), torch.tensor([[1.0, 0.0, 1.0]])
    return Scene(GaussianField(means, factors, torch.ones(1, 3), size=(20, 30)))


def with_opacities() -> Scene:
    scene, generator = scattered(20, (30, 30)), torch.Generator().manual_seed(0)
    field = scene.field
    return Scene(GaussianField(field.means, field.cholesky, 2 * field.colors, None, torch.rand(20, generator=generator),
                               size=(30, 30)))  # fmt: skip


def foreign_ids(regions: int) -> Scene:
    scene = with_regions("hard", 30, (40, 50), regions)
    scene.field.region_ids[::2] = 999
    return scene


def only_wide(kind: str) -> Scene:
    scene = with_regions(kind, 8, (48, 80), 3)
    scene.field.cholesky.data = torch.tensor([[12.0, 3.0, 9.0]]).repeat(8, 1)
    return scene


def session_of(model: onnx.ModelProto) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model.SerializeToString(), options)


def decode(session: onnxruntime.InferenceSession, size: tuple[int, int], **feeds: object) -> Tensor:
    (image,) = session.run(None, {"size": np.array(size), **feeds})
    return torch.from_numpy(image)[0]


class Interactive:
    """A decoder with inputs for a view and for regions."""

    def __init__(self, scene: Scene, **options: Any) -> None:
        self.session = session_of(scene_decoder(scene, clamp=False, interactive=True, **options))
        self.every = np.ones(1 if scene.regions is None else scene.regions.num_regions, np.float32)
        self.whole = np.array([0, 0, *scene.size[::-1]], np.float32)

    def render(self, size: tuple[int, int], view: Any = None, hidden: int | None = None) -> Tensor:
        visible = self.every.copy()
        if hidden is not None:
            visible[hidden] = 0
        view = self.whole if view is None else np.array(view, np.float32)
        return decode(self.session, size, view=view, visible=visible)


def assert_as_rendered(scene: Scene, sizes: list[tuple[int, int]], cutoff: float = 1e-4, **options: Any) -> None:
    options = {"clamp": False} | options
    session = session_of(scene_decoder(scene, cutoff=cutoff, **options))
    render = RegionSplatRenderer(cutoff=cutoff, **options)
    for size in (scene.size, *sizes):
        with torch.no_grad():
            expected = render(scene.field, scene.regions, size)
        image = decode(session, size)
        assert image.shape == expected.shape
        assert (image - expected).abs().max() < (1e-3 if cutoff >= 1e-4 else 1e-4), size


@pytest.fixture
def grids(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """Coarse grids for wide Gaussians, however small the image is, or none."""
    monkeypatch.setattr(plan, "_GRIDS_COST", -(10**9) if request.param else 10**9)
    return bool(request.param)


class TestImage:
    @pytest.mark.parametrize(
        ("kind", "grids", "cutoff"),
        [
            ("none", False, 1e-4), ("none", True, 1e-4), ("hard", False, 1e-6), ("soft", True, 1e-4),
            ("pairs", False, 0.0), ("wide", False, 1e-4), ("wide-pairs", True, 1e-4),
        ],
        indirect=["grids"],
    )  # fmt: skip
    def test_any_size(self, kind: str, grids: bool, cutoff: float) -> None:
        scene = with_regions(kind, 60, (75, 101))
        assert (plan.plan_decoder(scene.field, scene.regions, cutoff).nodes is not None) == grids
        assert_as_rendered(scene, [(150, 202), (1, 1), (5, 300)], cutoff)

    @pytest.mark.filterwarnings("ignore:.* Gaussians paint nothing")
    @pytest.mark.parametrize(
        ("make", "size", "options"),
        [
            (lambda: with_regions("soft", 300, (90, 120), 50), (131, 200), {}),
            (lambda: with_regions("soft", 5_000, (64, 96), 4), (100, 100), {}),
            (lambda: with_regions("hard", 60, (40, 56), 3, channels=4), (41, 57), {}),
            (one_pixel_regions, (66, 68), {"cutoff": 1e-6}),
            (needles_and_giants, (47, 65), {}),
            (nothing_to_render, (40, 50), {}),
            (with_opacities, (60, 40), {"clamp": True}),
            (lambda: foreign_ids(1), (33, 71), {}),
            (lambda: foreign_ids(2), (33, 71), {}),
        ],
    )  # fmt: skip
    def test_scenes(self, make: Callable[[], Scene], size: tuple[int, int], options: dict[str, Any]) -> None:
        assert_as_rendered(make(), [size], **options)

    def test_clamp_is_the_default(self) -> None:
        scene = scattered(40, (40, 60))
        scene.field.colors.data = 8 * scene.field.colors.data - 2
        plain, clipped = (
            decode(session_of(scene_decoder(scene, **options)), (40, 60)) for options in ({"clamp": False}, {})
        )
        assert plain.min() < -0.1 and plain.max() > 1.1
        assert torch.equal(clipped, plain.clamp(0, 1))

    @pytest.mark.parametrize(("kind", "grids"), [("none", True), ("soft", True)], indirect=["grids"])
    def test_wide_gaussians_alone(self, kind: str, grids: bool) -> None:
        """No list of Gaussians is left for the pixels."""
        scene = only_wide(kind)
        assert_as_rendered(scene, [(96, 160)])
        # beyond the border its values are held
        around = Interactive(scene).render((56, 88), [-4, -4, 84, 52])
        inside = RegionSplatRenderer()(scene).detach()
        assert (around[:, 4:-4, 4:-4] - inside).abs().max() < 1e-3
        assert torch.equal(around[:, :3], around[:, 1:4]) and (around[:, 3] - around[:, 4]).abs().max() < 0.05
        assert torch.equal(around[:, :, -3:], around[:, :, -4:-1])


class TestInteractive:
    @pytest.mark.parametrize(("kind", "grids"), [("hard", False), ("soft", True)], indirect=["grids"])
    def test_view_and_visible(self, kind: str, grids: bool) -> None:
        scene = with_regions(kind, 80, (80, 112), 5)
        decoder, render = Interactive(scene), RegionSplatRenderer()
        with torch.no_grad():
            large = scene((320, 448))
            part = decoder.render((50, 100), [10, 7, 35, 19.5])  # at the same scale, across tiles
            assert (part - large[:, 28:78, 40:140]).abs().max() < 1e-3
            for hidden in range(5):
                others = scene.field.subset(scene.field.region_ids != scene.regions.ids[hidden])
                image = decoder.render(scene.size, hidden=hidden)
                assert (image - render(others, scene.regions)).abs().max() < 1e-3

    @pytest.mark.parametrize("kind", ["hard", "soft"])
    def test_beyond_the_border_its_labels_are_held(self, kind: str) -> None:
        size, pad = (48, 64), 64
        scene = with_regions(kind, 60, size, 5)
        field, regions = scene.field, scene.regions
        shares = [membership_at(*table_and_size(regions)).weights(0, r, torch.float64) for r in range(5)]
        shares = [torch.nn.functional.pad(s[None, None], (pad,) * 4, mode="replicate")[0, 0] for s in shares]
        padded = shares[0].shape
        moved = (field.means.detach() + pad, field.cholesky.detach(), field.colors.detach())
        expected = torch.zeros(3, *padded)
        for r, share in enumerate(shares):
            inside = field.region_ids == regions.ids[r]
            expected += share * region_splat(*(t[inside] for t in moved), size=tuple(padded))
        image = Interactive(scene).render(tuple(padded), [-pad, -pad, size[1] + pad, size[0] + pad])
        # lists are of the tiles of the scene: near its border they hold what reaches
        for margin, bound in ((0, 1e-3), (4, 0.15)):
            y, x = (slice(pad - margin, pad + side + margin) for side in size)
            assert (image[:, y, x] - expected[:, y, x]).abs().max() < bound

    @pytest.mark.parametrize("grids", [False, True], indirect=True)
    def test_pans_at_native_scale_are_sharp(self, grids: bool) -> None:
        """Rounding of a view's ends asks for no more pixels than it has: moved by a pixel, it shows the same."""
        decoder = Interactive(scattered(60, (32, 64)))
        for left in (0.1, 3.3, 7.7, 11.9, 12.30001):
            first, second = (decoder.render((24, 32), [left + k, 0.2, left + k + 32, 24.2]) for k in (0, 1))
            assert (first[:, :, 1:] - second[:, :, :-1]).abs().max() < 1e-3

    @pytest.mark.parametrize(
        ("size", "view"),
        [((9, 9), [-3e5, -3e5, 3e5, 3e5]), ((50, 50), [-30, -30, 5, 5]), ((400, 500), [40, 24, 40.5, 24.4])],
    )
    def test_extreme_views(self, size: tuple[int, int], view: list[float]) -> None:
        """Far out no more is rendered than twice the scene; far in nothing breaks."""
        image = Interactive(with_regions("hard", 150, (48, 80), 5)).render(size, view)
        assert image.shape == (3, *size) and torch.isfinite(image).all()


class TestModel:
    @pytest.mark.parametrize("interactive", [False, True])
    def test_every_constant_and_result_is_read(self, interactive: bool) -> None:
        """The runtime warns of others, at every load."""
        graphs = [scene_decoder(with_regions("soft", 40, (37, 53), 4), interactive=interactive).graph]
        read: set[str] = set()
        stored: set[str] = set()
        for graph in graphs:  # grows by the graphs inside
            stored |= {value.name for value in graph.initializer}
            read |= {name for node in graph.node for name in node.input} | {value.name for value in graph.output}
            graphs += [attribute.g for node in graph.node for attribute in node.attribute if attribute.HasField("g")]
        assert stored and stored <= read
        assert all(read & {*node.output} for graph in graphs for node in graph.node)

    @pytest.mark.parametrize("kind", ["none", "hard", "soft"])
    def test_metadata(self, kind: str) -> None:
        scene = with_regions(kind, 30, (64, 96), 2)
        metadata = describe_decoder(scene_decoder(Scene(scene.field, scene.regions, {"recipe": "[mine] v2"})))
        expected = {"format": "kcgs.decoder", "height": "64", "recipe": "[mine] v2", "contours": kind}
        assert metadata.items() >= (expected | {"region_ids": [0] if kind == "none" else [2, 5]}).items()

    def test_leaves_out_operators(self) -> None:
        def operators(kind: str) -> list[str]:
            return [node.op_type for node in scene_decoder(with_regions(kind, 30, (64, 96), 2)).graph.node]

        none, hard, soft = map(operators, ("none", "hard", "soft"))
        assert "ReduceMax" in hard and "Clip" in none and len(none) < len(hard)
        assert not {"Loop", "NonZero"} & {*none, *hard, *soft}
        assert not any(name.startswith("Scatter") for name in (*none, *hard, *soft))

    def test_stores_what_reaches_a_pixel(self) -> None:
        scene = needles_and_giants()
        (means,) = (t for t in scene_decoder(scene).graph.initializer if t.dims[1:] == [2])
        assert means.dims[0] == scene.num_gaussians - 1

    def test_says_order_range_and_units(self) -> None:
        graph = scene_decoder(scattered(3, (20, 30)), interactive=True).graph
        docs = {value.name: value.doc_string for value in (*graph.input, *graph.output)}
        words = {"size": "height and width", "view": "left, top, right, bottom", "visible": "region_ids"}
        assert all(words[name] in docs[name] for name in words) and graph.doc_string
        assert "red, green, blue" in docs["image"] and "clipped to [0, 1]" in docs["image"]

    def test_bytes_of_a_scene_with_regions(self, tmp_path: object) -> None:
        scene = with_regions("soft", 1250, (480, 854), 6)
        scene.field.cholesky.data *= 0.2
        stored = scene.save(f"{tmp_path}/s.safetensors")
        assert len(scene_decoder(scene).SerializeToString()) < 2.7 * stored

    def test_a_scene_writes_its_own(self, tmp_path: Path) -> None:
        scene, path = with_regions("soft", 30, (20, 30), 2), tmp_path / "decoder.onnx"
        model = scene.to_onnx(path, clamp=False, interactive=True)
        expected = scene_decoder(scene, clamp=False, interactive=True).SerializeToString()
        assert path.read_bytes() == model.SerializeToString() == expected
        with pytest.raises(ValueError, match=r"path must end in .onnx; got '.*decoder.safetensors'"):
            scene.to_onnx(path.with_suffix(".safetensors"))


def batch() -> Scene:
    return Scene(GaussianField(torch.rand(2, 3, 2), torch.ones(2, 3, 3), torch.rand(2, 3, 3), size=(8, 8)))


def resized() -> Scene:
    regions = RegionMap(blobs((20, 30), 3), 0.7).resize((40, 60))
    return scattered(5, (40, 60), regions)


def with_value(table: str, value: float) -> Scene:
    scene = scattered(5, (20, 30))
    getattr(scene.field, table).data[2, 0] = value
    return scene


class TestBadInput:
    @pytest.mark.parametrize(
        ("make", "options", "message"),
        [
            (lambda: scattered(5, (20, 30)).field, {}, "scene must be a Scene; got GaussianField"),
            (lambda: scattered(5, (20, 30)), {"cutoff": 2.0}, "cutoff must"),
            (lambda: Scene(scattered(5, (20, 30)).field, torch.zeros(1, 20, 30).long()), {}, "scene must have one map"),
            (lambda: Scene(scattered(5, (20, 30)).field, torch.zeros(20, 30).long()), {}, "scene must have region ids"),
            (resized, {}, "resized"),
            (batch, {}, "scene must be of one image; got a batch of"),
            (lambda: with_value("means", float("nan")), {}, "means must be finite"),
            (lambda: with_value("cholesky", -1.0), {}, "cholesky must be finite, l11 and l22 in"),
            (lambda: with_value("colors", float("inf")), {}, "colors must be finite"),
        ],
    )
    def test_says_what_is_wrong(self, make: Callable[[], Any], options: dict[str, Any], message: str) -> None:
        with pytest.raises((ValueError, TypeError), match=message):
            scene_decoder(make(), **options)
