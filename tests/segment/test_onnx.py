"""Networks in ONNX: every kind of output by hand-made graphs, real objects by U-2-Net."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from kcgs.data import Davis
from kcgs.segment import segment, segment_with_scores
from tests.segment.checks import assert_segmentation, split_image

IMAGE = split_image(24, 40, 25)
LABELS = (torch.arange(40) >= 25).long().expand(24, 40)  # the larger left side is region 0
EYE = [[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0]]
EYE_SCORE = float(np.exp(4) / (np.exp(4) + 2))
PLAIN: dict[str, Any] = {"mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}
COLORS = ("red", "green", "blue")
SEQUENCES = ("blackswan", "lucia")


def write_model(path: Path, nodes: list[Any], shape: list[Any], rank: int, kind: int, weights: list[Any]) -> Path:
    graph = helper.make_graph(
        nodes,
        "network",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("out", kind, [None] * rank)],
        weights,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


def write_mixer(path: Path, weights: list[list[float]], tail: str = "", size: tuple[Any, Any] = ("h", "w")) -> Path:
    """Write a 1 x 1 convolution of the three channels, and perhaps one operator more."""
    weight = numpy_helper.from_array(np.array(weights, dtype=np.float32)[:, :, None, None], "weight")
    options = {"ArgMax": {"axis": 1, "keepdims": 0}, "Softmax": {"axis": 1}, "Cast": {"to": TensorProto.INT64}}
    nodes = [helper.make_node("Conv", ["image", "weight"], ["mixed" if tail else "out"])]
    if tail:
        nodes.append(helper.make_node(tail, ["mixed"], ["out"], **options[tail]))
    rank, kind = 4 - (tail == "ArgMax"), TensorProto.INT64 if tail in ("ArgMax", "Cast") else TensorProto.FLOAT
    return write_model(path, nodes, [1, 3, *size], rank, kind, [weight])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "net.onnx"


class TestOnnx:
    @pytest.mark.parametrize(
        ("weights", "tail", "options", "score", "names"),
        [
            (EYE, "", {"names": COLORS}, EYE_SCORE, ["red", "blue"]),
            (EYE, "Softmax", {"names": COLORS}, EYE_SCORE, ["red", "blue"]),
            (EYE, "ArgMax", {"names": COLORS}, None, ["red", "blue"]),
            ([[0.8, 0.0, 0.1]], "", {"names": ["rest", "thing"]}, 1.0, ["thing", "rest"]),
            ([[2.0, 0.0, -2.0]], "", {}, 0.8808, None),
            # a mean and a deviation that put red and blue about 0
            ([[1.0, 0.0, 0.0]], "", {"mean": (0.5, 0.0, 0.0), "std": (0.5, 1.0, 1.0)}, 0.7311, None),
        ],
    )
    def test_kinds_of_output(
        self, path: Path, weights: Any, tail: str, options: dict[str, Any], score: float | None, names: Any
    ) -> None:
        write_mixer(path, weights, tail)
        result = segment_with_scores(IMAGE, "onnx", model=path, **(PLAIN | options))
        assert torch.equal(result.labels, LABELS)
        assert (result.scores is None) == (score is None)
        if result.scores is not None:
            assert result.scores.tolist() == pytest.approx([score, score], abs=1e-4)
        assert result.names == (None if names is None else dict(enumerate(names)))

    @pytest.mark.parametrize(("sides", "size"), [((12, 20), None), (("h", "w"), (12, 20))])
    def test_output_is_enlarged(self, path: Path, sides: tuple[Any, Any], size: tuple[int, int] | None) -> None:
        write_mixer(path, EYE, size=sides)
        assert torch.equal(segment(IMAGE, "onnx", model=path, size=size, **PLAIN), LABELS)

    def test_constant_saliency_is_one_region(self, path: Path) -> None:
        write_mixer(path, [[0.3, 0.3, 0.3]])
        assert int(segment(IMAGE, "onnx", model=path, **PLAIN).max()) == 0

    @pytest.mark.parametrize(
        ("tail", "options", "message"),
        [
            ("", {"names": COLORS[:2]}, "names must be 3, one for each class, class 0 first; got 2"),
            ("ArgMax", {"names": COLORS[:2]}, "names must have one for label 2; got 2 names"),
            ("Cast", {}, "model must be a network of labels in one channel, or of floating scores; got 3 channels"),
            ("", {"threshold": 2.0}, "threshold must be in"),
            ("", {"mean": (0.0,)}, "mean must be 3 numbers"),
            ("", {"std": (0.0, 1.0, 1.0)}, "std must be finite and above 0"),
        ],
    )
    def test_bad_options(self, path: Path, tail: str, options: dict[str, Any], message: str) -> None:
        write_mixer(path, EYE, tail)
        with pytest.raises((TypeError, ValueError), match=message):
            segment(IMAGE, "onnx", model=path, **(PLAIN | options))

    def test_bad_files(self, path: Path) -> None:
        path.write_bytes(write_mixer(path, EYE).read_bytes()[:60])
        for model in (path, path.with_name("gone.onnx")):
            with pytest.raises(ValueError, match="cannot read .*onnx as an ONNX network"):
                segment(IMAGE, "onnx", model=model)

    @pytest.mark.parametrize(
        ("shape", "node", "message"),
        [
            ([1, 224, 224, 3], ("Relu", {}), "does not run on"),
            ([1, 3, "h", "w"], ("ReduceMean", {"keepdims": 0}), "must be finite, .*; got"),
        ],
    )
    def test_other_networks(self, path: Path, shape: list[Any], node: tuple[str, Any], message: str) -> None:
        nodes = [helper.make_node(node[0], ["image"], ["out"], **node[1])]
        write_model(path, nodes, shape, 4 if node[0] == "Relu" else 0, TensorProto.FLOAT, [])
        with pytest.raises(ValueError, match=message):
            segment(IMAGE, "onnx", model=path)


class TestLseg:
    TEXTS = np.array([[0.0, 0.1, 9.0], [0.5, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=np.float32)

    def test_nearest_text(self, path: Path) -> None:
        write_mixer(path, EYE)
        np.save(path.with_name("texts.npy"), self.TEXTS)
        for embeddings in (self.TEXTS, path.with_name("texts.npy")):
            names = ["sea", "rose", "grass"]
            result = segment_with_scores(IMAGE, "lseg", model=path, embeddings=embeddings, names=names, **PLAIN)
            assert torch.equal(result.labels, LABELS) and result.names == {0: "rose", 1: "sea"}
            assert result.scores is not None and (result.scores > 0.99).all()

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"embeddings": np.ones((2, 5), dtype=np.float32)}, r"embeddings must have shape \(K, 3\)"),
            ({"embeddings": np.ones((2, 3), dtype=int)}, "embeddings must have a real floating dtype"),
            ({"embeddings": TEXTS, "names": ["sea"]}, "names must be 3, one for each class"),
            ({"embeddings": "gone.npy"}, "cannot read gone.npy as an .npy array"),
        ],
    )
    def test_bad_options(self, path: Path, options: dict[str, Any], message: str) -> None:
        write_mixer(path, EYE)
        with pytest.raises((TypeError, ValueError), match=message):
            segment(IMAGE, "lseg", model=path, **options)


def test_real_network_finds_objects(data_root: Path) -> None:
    model = data_root / "weights" / "u2netp.onnx"
    if not model.is_file() or not (data_root / "DAVIS").is_dir():
        pytest.skip(f"no weights/u2netp.onnx and DAVIS in {data_root}")
    overlaps = {}
    davis = Davis(data_root / "DAVIS")
    for frame in (davis[name] for name in SEQUENCES):
        labels = segment(frame.image, "onnx", model=model, connected=False)
        assert labels.unique().tolist() == [0, 1]
        union, common = (labels == 1) | (frame.labels > 0), (labels == 1) & (frame.labels > 0)
        overlaps[frame.sequence] = float(common.sum() / union.sum())
    assert min(overlaps.values()) >= 0.8 and sum(overlaps.values()) / len(overlaps) >= 0.88, overlaps
    result = segment_with_scores(frame.image, "onnx", model=model, snap=2)
    assert_segmentation(result, (480, 854))
    assert result.scores is not None and (result.scores > 0.8).all()
