"""The generic decoder against the renderer, its graph, its memory."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from torch import Tensor

import kcgs
from kcgs import GaussianField, RegionSplatRenderer, Scene
from kcgs.onnx import describe_decoder, generic_decoder

from .test_scene import foreign_ids, session_of, with_regions

ERROR = {0.0: 1e-4, 1e-6: 1e-4, 1e-4: 1e-3}  # allowed, by cutoff
SIDE = 300


@cache
def session(cutoff: float = 1e-4, clamp: bool = False) -> onnxruntime.InferenceSession:
    return session_of(generic_decoder(cutoff=cutoff, clamp=clamp))


def feeds_of(scene: Scene) -> dict[str, np.ndarray]:
    field, regions = scene.field, scene.regions
    tensors = {"means": field.means, "cholesky": field.cholesky, "colors": field.merged_colors()}
    tensors["memberships"] = torch.stack([regions.membership(region) for region in regions.ids.tolist()])
    feeds = {name: tensor.detach().float().numpy() for name, tensor in tensors.items()}
    return feeds | {"region_ids": regions.index_of(field.region_ids).numpy()}


def decode(scene: Scene, cutoff: float = 1e-4, clamp: bool = False) -> Tensor:
    (image,) = session(cutoff, clamp).run(None, feeds_of(scene))
    assert image.dtype == np.float32 and image.shape == (1, scene.field.colors.shape[-1], *scene.size)
    return torch.from_numpy(image[0])


def render(scene: Scene, cutoff: float = 1e-4) -> Tensor:
    with torch.no_grad():
        return RegionSplatRenderer(cutoff)(scene)


def one(mean: tuple[float, float], cholesky: tuple[float, float, float], size: tuple[int, int]) -> Scene:
    tensors = [torch.tensor([row]) for row in (mean, cholesky, (1.0,))]
    ids, labels = torch.zeros(1, dtype=torch.int64), torch.zeros(size, dtype=torch.int64)
    return Scene(GaussianField(*tensors, ids, size=size), labels)


def needle(angle: float, along: float) -> Scene:
    """A needle of 300 x 0.3 pixels; `along` moves it by its length."""
    c, s = math.cos(angle), math.sin(angle)
    long, short = 300.0, 0.3
    l11 = math.hypot(c * long, s * short)
    mean = (150.3 + along * long * c, 149.8 + along * long * s)
    return one(mean, (l11, c * s * (long**2 - short**2) / l11, long * short / l11), (SIDE, SIDE))


class TestAgainstRenderer:
    @pytest.mark.parametrize(
        ("kind", "count", "regions", "channels", "size", "cutoff"),
        [
            ("hard", 9, 1, 4, (1, 1), 1e-4),
            ("soft", 9, 2, 1, (1, 50), 1e-6),
            ("hard", 65, 1, 3, (33, 31), 0.0),
            ("hard", 300, 50, 3, (64, 96), 0.0),
            ("soft", 1000, 12, 3, (130, 97), 1e-4),
        ],
    )
    def test_sizes_numbers_and_regions(
        self, kind: str, count: int, regions: int, channels: int, size: tuple[int, int], cutoff: float
    ) -> None:
        scene = with_regions(kind, count, size, regions, channels)
        expected = render(scene, cutoff)
        assert expected.abs().max() > 1e-3
        assert (decode(scene, cutoff) - expected).abs().max() < ERROR[cutoff]

    @pytest.mark.parametrize(("angle", "along", "cutoff"), [(0.3, 2.5, 1e-6), (2.0, 0.0, 1e-4)])
    def test_needles(self, angle: float, along: float, cutoff: float) -> None:
        """Anisotropy 1,000, also where the image shows one end alone."""
        scene = needle(angle, along)
        expected = render(scene, cutoff)
        assert expected.max() > (0.3 if along == 0.0 else 0.01)
        assert (decode(scene, cutoff) - expected).abs().max() < ERROR[cutoff]

    @pytest.mark.parametrize(
        ("mean", "cholesky"),
        [
            ((20.5, 20.5), (0.05, 0.0, 0.05)),  # one pixel
            ((20.0, 20.0), (0.05, 0.0, 0.05)),  # between pixels
            ((20.0, 20.0), (1e5, 0.0, 1e5)),
            ((1e8, -1e8), (1e8, 0.0, 1e8)),
            ((-60.0, 20.0), (20.0, 0.0, 20.0)),
            ((-1e6, 20.0), (1.0, 0.0, 1.0)),
            ((20.0, 20.0), (1e-6, 1e8, 1e-6)),
            ((20.0, 20.0), (1e8, -1e8, 1e8)),
        ],
    )
    def test_extremes(self, mean: tuple[float, float], cholesky: tuple[float, float, float]) -> None:
        scene = one(mean, cholesky, (40, 70))
        assert (decode(scene) - render(scene)).abs().max() < 1e-3

    @pytest.mark.parametrize("cutoff", [1e-4, 0.3])
    def test_weights_below_the_cutoff_are_exactly_zero(self, cutoff: float) -> None:
        scene = one((18.3, 21.9), (3.0, 1.0, 2.0), (40, 40))
        image, exact = decode(scene, cutoff), render(scene, 0.0)
        assert image[exact < cutoff * 0.999].abs().max() == 0
        above = exact > cutoff * 1.001
        assert above.any()
        assert torch.allclose(image[above], exact[above], rtol=1e-4)

    @pytest.mark.filterwarnings("ignore:.* Gaussians paint nothing")
    @pytest.mark.parametrize("regions", [1, 4])
    def test_ids_that_the_map_does_not_hold(self, regions: int) -> None:
        scene = foreign_ids(regions)
        assert (decode(scene) - render(scene)).abs().max() < 1e-3

    def test_no_gaussian_gives_black(self) -> None:
        scene = with_regions("hard", 1, (3, 4), 1)
        assert decode(Scene(scene.field.subset(torch.tensor([False])), scene.regions)).abs().max() == 0.0

    def test_clamp(self) -> None:
        scene = with_regions("hard", 50, (37, 53), 3)
        scene.field.colors.data = 8 * scene.field.colors.data - 2
        plain = decode(scene)
        assert plain.max() > 1.0 and plain.min() < 0.0
        assert torch.equal(decode(scene, clamp=True), plain.clamp(0, 1))


def all_nodes(graph: onnx.GraphProto) -> Iterator[onnx.NodeProto]:
    for node in graph.node:
        yield node
        for attribute in node.attribute:
            if attribute.HasField("g"):
                yield from all_nodes(attribute.g)


class TestModel:
    def test_checked_scatter_free_and_small(self) -> None:
        model = generic_decoder()
        onnx.checker.check_model(model, full_check=True)
        operators = {node.op_type for node in all_nodes(model.graph)}
        assert {"Loop", "Exp", "MatMul"} <= operators
        assert not any(name.startswith("Scatter") or name == "NonZero" for name in operators)
        assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", 18)]
        content = model.SerializeToString(deterministic=True)
        assert len(content) < 5_000 and content == generic_decoder().SerializeToString(deterministic=True)

    def test_signature(self) -> None:
        run = session()
        assert [(value.name, value.type, value.shape) for value in (*run.get_inputs(), *run.get_outputs())] == [
            ("means", "tensor(float)", ["N", 2]),
            ("cholesky", "tensor(float)", ["N", 3]),
            ("colors", "tensor(float)", ["N", "C"]),
            ("region_ids", "tensor(int64)", ["N"]),
            ("memberships", "tensor(float)", ["R", "H", "W"]),
            ("image", "tensor(float)", [1, "C", "H", "W"]),
        ]

    def test_metadata(self) -> None:
        assert describe_decoder(generic_decoder(cutoff=1e-6, clamp=False)) == {
            "format": "kcgs.decoder",
            "format_version": "1",
            "kind": "generic",
            "kcgs_version": kcgs.__version__,
            "cutoff": "1e-06",
            "clamp": "false",
        }

    def test_bad_cutoff(self) -> None:
        with pytest.raises(ValueError, match=r"cutoff must be in \[0, 1\); got 1.0"):
            generic_decoder(cutoff=1.0)


_MEASURE = """
import sys
import numpy as np
import onnxruntime

def memory(key):
    with open("/proc/self/status") as status:
        return int(next(line for line in status if line.startswith(key)).split()[1]) * 1024

options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1
session = onnxruntime.InferenceSession(sys.argv[1], options, providers=["CPUExecutionProvider"])
with np.load(sys.argv[2]) as file:
    feeds = {name: file[name] for name in file.files}
before = memory("VmRSS")
session.run(None, feeds)
print(memory("VmHWM") - before)
"""


class TestMemory:
    @pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="the peak is read from /proc")
    def test_bounded(self, tmp_path: Path) -> None:
        """Dense weights would take 16 GB."""
        scene = with_regions("hard", 10_000, (480, 854), 6)
        scene.field.cholesky.data *= 0.1
        model, data = tmp_path / "generic.onnx", tmp_path / "scene.npz"
        onnx.save(generic_decoder(), model)
        np.savez(data, **feeds_of(scene))
        command = [sys.executable, "-c", _MEASURE, str(model), str(data)]
        growth = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        assert growth < 80e6
