"""`torch.onnx.export` of modules that hold the renderer."""

from __future__ import annotations

from typing import Any

import onnxruntime
import pytest
import torch
from torch import Tensor, nn
from torch._higher_order_ops.scan import generic_scan
from torch._higher_order_ops.while_loop import while_loop_dense
from torch.utils._python_dispatch import TorchDispatchMode

from kcgs import GaussianField, RegionMap, Scene
from kcgs.functional import region_splat
from kcgs.functional.decomposition import decompose
from kcgs.maps import MapTable, table_and_size

SIZE = (40, 56)
PAIRS = {(0, 3): 1.1, (0, 7): 0.0, (3, 7): 2.0}
exporter_warnings = pytest.mark.filterwarnings(
    "ignore:.*:DeprecationWarning", "ignore:.*:FutureWarning", "ignore:.*:UserWarning"
)


def labels_of(size: tuple[int, int]) -> Tensor:
    """A disc, a slanted part, and what is left."""
    y, x = torch.meshgrid(*(torch.arange(n) for n in size), indexing="ij")
    labels = torch.where(x > size[1] * 0.6 + y // 3, 7, 0)
    return torch.where((y - 16) ** 2 + (x - 20) ** 2 < 100, 3, labels)


def gaussians(batch: int, count: int, size: tuple[int, int]) -> list[Tensor]:
    """Slanted ones, of the three regions and one that no map has."""
    fields = [GaussianField.random(count, size, seed=k) for k in range(batch)]
    means, cholesky, colors = (
        torch.stack([getattr(f, n).detach() for f in fields]) for n in ("means", "cholesky", "colors")
    )
    cholesky[..., 1] += 1.5
    ids = torch.tensor([0, 3, 7, 99])[torch.arange(batch * count) % 4]
    return [means, cholesky, colors, ids.reshape(batch, count)]


def run(program: Any, *inputs: Tensor) -> Tensor:
    session = onnxruntime.InferenceSession(program.SerializeToString())
    feeds = {node.name: t.numpy() for node, t in zip(session.get_inputs(), inputs, strict=True)}
    return torch.from_numpy(session.run(None, feeds)[0])


def assert_close(image: Tensor, expected: Tensor, error: float = 1e-5) -> None:
    assert expected.abs().max() > 0.1
    torch.testing.assert_close(image, expected.detach(), rtol=0, atol=error)


@pytest.mark.filterwarnings("ignore:.* Gaussians paint nothing:UserWarning")
class TestDecomposition:
    @pytest.mark.parametrize(("size", "softness"), [(SIZE, 0.7), ((77, 101), PAIRS), ((33, 41), 0.0)])
    def test_maps(self, size: tuple[int, int], softness: Any) -> None:
        regions = RegionMap(labels_of(SIZE), softness)
        args = (*gaussians(2, 30, size), *table_and_size(regions)[0], *size, 1e-4, "reference")
        assert_close(decompose(*args), torch.ops.kcgs.region_splat(*args))

    @pytest.mark.parametrize(("cutoff", "dtype"), [(0.0, torch.float64), (1e-2, torch.float32)])
    def test_without_a_map(self, cutoff: float, dtype: torch.dtype) -> None:
        tensors = [t.to(dtype) for t in gaussians(2, 30, SIZE)[:3]]
        args = (*tensors, *[None] * (1 + len(MapTable._fields)), *SIZE, cutoff, "reference")
        assert decompose(*args).dtype == dtype
        assert_close(decompose(*args), torch.ops.kcgs.region_splat(*args))

    def test_a_map_for_each_image_of_large_ids(self) -> None:
        labels = torch.stack([labels_of(SIZE), labels_of(SIZE).flip(1)]) << 40
        tensors = gaussians(2, 30, SIZE)
        tensors[3] <<= 40
        args = (*tensors, *MapTable(labels), *SIZE, 1e-4, "reference")
        assert_close(decompose(*args), torch.ops.kcgs.region_splat(*args))

    def test_no_gaussians(self) -> None:
        args = (*gaussians(1, 0, SIZE), *MapTable(labels_of(SIZE)), *SIZE, 1e-4, "reference")
        assert torch.equal(decompose(*args), torch.zeros(1, 3, *SIZE))

    def test_memory_is_that_of_a_chunk_and_the_image(self, monkeypatch: pytest.MonkeyPatch) -> None:
        loops = torch.ops.higher_order
        monkeypatch.setattr(loops, "scan", lambda body, carry, xs, inputs: generic_scan(body, carry, xs, 0, inputs))
        monkeypatch.setattr(loops, "while_loop", while_loop_dense)

        class Largest(TorchDispatchMode):
            numel = 0

            def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
                result = func(*args, **(kwargs or {}))
                self.numel = max(self.numel, result.numel() if isinstance(result, Tensor) else 0)
                return result

        size, largest = (96, 128), Largest()
        tensors = gaussians(1, 400, size)
        with largest:
            decompose(*tensors, *MapTable(labels_of(size)), *size, 1e-4, "tiled")
        assert largest.numel == 64 * 32 * 32 > 3 * 96 * 128


class Predictor(nn.Module):
    """A network that predicts Gaussians, the renderer, and a filter of Kornia."""

    def __init__(self) -> None:
        super().__init__()
        from kornia.filters import GaussianBlur2d

        self.shift = nn.Linear(2, 2)
        self.blur = GaussianBlur2d((3, 3), (1.0, 1.0))

    def forward(self, means: Tensor, cholesky: Tensor, colors: Tensor, ids: Tensor, labels: Tensor) -> Tensor:
        return self.blur(region_splat(means + self.shift(means).tanh(), cholesky, colors, ids, labels))


class Resized(nn.Module):
    """A scene behind an image of any size."""

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.scene = scene

    def forward(self, image: Tensor) -> Tensor:
        return image + self.scene(size=tuple(image.shape[-2:]))


@exporter_warnings
class TestTorchExport:
    def test_a_network_with_kornia_behind_the_renderer(self) -> None:
        """Sizes, numbers and batches that were not traced, a map for each image."""
        names = {0: "B", 1: "N"}
        maps = torch.stack([labels_of(SIZE), labels_of(SIZE).flip(0)])
        module = Predictor().eval()
        program = torch.onnx.export(
            module, (*gaussians(2, 20, SIZE), maps), dynamo=True, verbose=False,
            dynamic_shapes=(*[names] * 4, {0: "B", 1: "H", 2: "W"}),
        )  # fmt: skip
        session = program.model_proto
        for batch, count, size in ((3, 70, (61, 35)), (1, 5, (24, 100))):
            inputs = (*gaussians(batch, count, size), torch.stack([labels_of(size).roll(k, 1) for k in range(batch)]))
            assert_close(run(session, *inputs), module(*inputs), 3e-4)  # the kernel interpolates wide Gaussians

    @pytest.mark.slow
    def test_a_scene_at_sizes_below_and_above_its_own(self) -> None:
        regions = RegionMap(labels_of(SIZE), PAIRS)
        module = Resized(Scene(GaussianField.random(40, SIZE, seed=0, regions=regions), regions)).eval()
        program = torch.onnx.export(
            module, (torch.rand(3, 13, 99),), dynamo=True, verbose=False, dynamic_shapes=({1: "H", 2: "W"},)
        )
        for size in ((13, 17), SIZE, (90, 33), (90, 99)):
            image = torch.rand(3, *size)
            assert_close(run(program.model_proto, image), module(image), 3e-4)
