"""Networks in ONNX: every kind of output by hand-made graphs, real objects by U-2-Net."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor

from kcgs.data import Davis
from kcgs.segment import segment, segment_with_scores

PLAIN: dict[str, Any] = {"mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}
SEQUENCES = ("blackswan", "car-shadow", "cows", "dance-jump", "dog", "horsejump-low", "lucia", "surf", "tennis")


def two_colors() -> Tensor:
    """Red on the left, blue on the right."""
    image = torch.zeros(3, 24, 40)
    image[0, :, :25] = 1.0
    image[2, :, 25:] = 1.0
    return image


def mixing(path: Path, weights: list[list[float]], *, tail: str = "", size: Any = ("h", "w"), **kinds: int) -> Path:
    """Write a network that is a 1 x 1 convolution of the three channels and perhaps one operator more."""
    weight = numpy_helper.from_array(np.array(weights, dtype=np.float32)[:, :, None, None], "weight")
    source = kinds.get("source", TensorProto.FLOAT)
    nodes = [helper.make_node("Cast", ["image"], ["values"], to=TensorProto.FLOAT)]
    nodes.append(helper.make_node("Conv", ["values", "weight"], ["mixed" if tail else "out"]))
    if tail == "ArgMax":
        nodes.append(helper.make_node("ArgMax", ["mixed"], ["out"], axis=1, keepdims=0))
    elif tail:
        nodes.append(helper.make_node(tail, ["mixed"], ["out"], **({"axis": 1} if tail == "Softmax" else {})))
    result = TensorProto.INT64 if tail == "ArgMax" else TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "mixing",
        [helper.make_tensor_value_info("image", source, [1, 3, *size])],
        [helper.make_tensor_value_info("out", result, [None] * (3 if tail == "ArgMax" else 4))],
        [weight],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
    return path


EYE = [[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 4.0]]
LEFT = (torch.arange(40) >= 25).long().expand(24, 40)  # The larger left side is region 0.


class TestKinds:
    @pytest.mark.parametrize(
        ("tail", "score"),
        [
            ("", np.exp(4) / (np.exp(4) + 2)),
            ("Softmax", np.exp(4) / (np.exp(4) + 2)),
            ("ArgMax", None),
        ],
    )
    def test_several_classes(self, tmp_path: Path, tail: str, score: float | None) -> None:
        path = mixing(tmp_path / "net.onnx", EYE, tail=tail)
        labels, scores, _ = segment_with_scores(two_colors(), "onnx", model=path, **PLAIN)
        assert torch.equal(labels, LEFT)
        if score is None:
            assert scores is None
        else:
            assert scores is not None
            assert scores.tolist() == pytest.approx([score, score], rel=1e-5)

    @pytest.mark.parametrize(
        ("weights", "tail", "scores"),
        [
            ([[0.8, 0.0, 0.1]], "", [1.0, 1.0]),
            ([[2.0, 0.0, -2.0]], "", [0.8808, 0.8808]),
        ],
    )
    def test_one_channel(self, tmp_path: Path, weights: list[list[float]], tail: str, scores: list[float]) -> None:
        path = mixing(tmp_path / "net.onnx", weights, tail=tail)
        labels, found, _ = segment_with_scores(two_colors(), "onnx", model=path, **PLAIN)
        assert torch.equal(labels, LEFT)
        assert found is not None
        assert found.tolist() == pytest.approx(scores, abs=1e-4)

    def test_constant_saliency_is_one_region(self, tmp_path: Path) -> None:
        path = mixing(tmp_path / "net.onnx", [[0.3, 0.3, 0.3]])
        assert int(segment(two_colors(), "onnx", model=path, **PLAIN).max()) == 0

    def test_pieces_and_budget(self, tmp_path: Path) -> None:
        image = two_colors()
        image[:, :, :8] = image[:, :, 30:31]
        path = mixing(tmp_path / "net.onnx", EYE)
        counts = [
            int(segment(image, "onnx", model=path, **PLAIN, **options).max()) + 1
            for options in ({"min_size": 1}, {"connected": False}, {"max_regions": 1})
        ]
        assert counts == [3, 2, 1]


class TestNames:
    NAMES = ("red", "green", "blue")

    @pytest.mark.parametrize("tail", ["", "Softmax", "ArgMax"])
    def test_classes(self, tmp_path: Path, tail: str) -> None:
        path = mixing(tmp_path / "net.onnx", EYE, tail=tail)
        found = segment_with_scores(two_colors(), "onnx", model=path, names=self.NAMES, **PLAIN)
        assert found.names == {0: "red", 1: "blue"}
        assert segment_with_scores(two_colors(), "onnx", model=path, **PLAIN).names is None

    def test_foreground(self, tmp_path: Path) -> None:
        path = mixing(tmp_path / "net.onnx", [[0.8, 0.0, 0.1]])
        found = segment_with_scores(two_colors(), "onnx", model=path, names=["rest", "thing"], **PLAIN)
        assert found.names == {0: "thing", 1: "rest"}

    @pytest.mark.parametrize(
        ("tail", "names", "message"),
        [
            ("", ["red", "green"], "names must be 3, one for each class, class 0 first; got 2"),
            ("ArgMax", ["red", "green"], "names must say what label 2 is; got 2 names"),
        ],
    )
    def test_of_another_number(self, tmp_path: Path, tail: str, names: list[str], message: str) -> None:
        path = mixing(tmp_path / "net.onnx", EYE, tail=tail)
        with pytest.raises(ValueError, match=message):
            segment(two_colors(), "onnx", model=path, names=names, **PLAIN)


class TestPreprocessing:
    def test_mean_and_std(self, tmp_path: Path) -> None:
        # Red above 200 / 255 is above 0.
        path = mixing(tmp_path / "net.onnx", [[1.0, 0.0, 0.0]])
        image = torch.full((3, 20, 20), 195 / 255)
        image[0, :, 12:] = 205 / 255
        options: dict[str, Any] = {"mean": (200 / 255, 0.0, 0.0), "std": (5 / 255, 1.0, 1.0)}
        labels, scores, _ = segment_with_scores(image, "onnx", model=path, **options)
        assert torch.equal(labels, (torch.arange(20) >= 12).long().expand(20, 20))
        assert scores is not None
        assert scores.tolist() == pytest.approx([0.7311, 0.7311], abs=1e-3)

    @pytest.mark.parametrize("size", [(12, 20), ("h", "w")])
    def test_results_are_enlarged(self, tmp_path: Path, size: Any) -> None:
        path = mixing(tmp_path / "net.onnx", EYE, size=size)
        assert torch.equal(segment(two_colors(), "onnx", model=path, size=(12, 20), **PLAIN), LEFT)
        if size == (12, 20):
            assert torch.equal(segment(two_colors(), "onnx", model=path, **PLAIN), LEFT)


class TestErrors:
    def test_files(self, tmp_path: Path) -> None:
        path = mixing(tmp_path / "net.onnx", EYE)
        path.write_bytes(path.read_bytes()[:60])
        for model in (path, tmp_path / "gone.onnx"):
            with pytest.raises(ValueError, match="cannot read .*onnx as an ONNX network"):
                segment(two_colors(), "onnx", model=model)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"threshold": 2.0}, "threshold must be in"),
            ({"mean": (0.0,)}, "mean must be 3 numbers"),
            ({"std": (0.0, 1.0, 1.0)}, "std must be finite and above 0"),
            ({"min_size": 0}, "min_size must be"),
        ],
    )
    def test_options(self, tmp_path: Path, options: dict[str, Any], message: str) -> None:
        path = mixing(tmp_path / "net.onnx", EYE)
        with pytest.raises(ValueError, match=message):
            segment(two_colors(), "onnx", model=path, **options)

    @pytest.mark.parametrize("options", [{"mean": "half"}, {"std": (1.0, "one", 1.0)}])
    def test_numbers(self, tmp_path: Path, options: dict[str, Any]) -> None:
        with pytest.raises(TypeError, match=f"{next(iter(options))} must be .*number.*; got"):
            segment(two_colors(), "onnx", model=mixing(tmp_path / "net.onnx", EYE), **options)

    def test_input_of_another_shape(self, tmp_path: Path) -> None:
        graph = helper.make_graph(
            [helper.make_node("Relu", ["x"], ["y"])],
            "flat",
            [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 224, 224, 3])],
            [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 224, 224, 3])],
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
        (tmp_path / "net.onnx").write_bytes(model.SerializeToString())
        with pytest.raises(ValueError, match="does not run on"):
            segment(two_colors(), "onnx", model=tmp_path / "net.onnx")


class TestLseg:
    def test_nearest_text(self, tmp_path: Path) -> None:
        path = mixing(tmp_path / "encoder.onnx", EYE)
        texts = np.array([[0.0, 0.1, 9.0], [0.5, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=np.float32)
        np.save(tmp_path / "texts.npy", texts)
        labels, scores, names = segment_with_scores(
            two_colors(), "lseg", model=path, embeddings=tmp_path / "texts.npy", names=["sea", "rose", "grass"], **PLAIN
        )
        assert names == {0: "rose", 1: "sea"}
        assert torch.equal(labels, LEFT)
        assert scores is not None
        assert (scores > 0.99).all()
        assert torch.equal(labels, segment(two_colors(), "lseg", model=path, embeddings=texts, **PLAIN))

    def test_errors(self, tmp_path: Path) -> None:
        path = mixing(tmp_path / "encoder.onnx", EYE)
        with pytest.raises(ValueError, match=r"embeddings must have shape \(K, 3\)"):
            segment(two_colors(), "lseg", model=path, embeddings=np.ones((2, 5), dtype=np.float32))
        with pytest.raises(ValueError, match="names must be 2, one for each class"):
            segment(two_colors(), "lseg", model=path, embeddings=np.ones((2, 3), dtype=np.float32), names=["sea"])
        with pytest.raises(TypeError, match="embeddings must have a real floating dtype"):
            segment(two_colors(), "lseg", model=path, embeddings=np.ones((2, 3), dtype=int))
        (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY")
        with pytest.raises(ValueError, match=r"cannot read .*bad.npy"):
            segment(two_colors(), "lseg", model=path, embeddings=tmp_path / "bad.npy")


@pytest.fixture(scope="module")
def u2net(data_root: Path) -> Path:
    path = data_root / "weights" / "u2netp.onnx"
    if not path.is_file() or not (data_root / "DAVIS").is_dir():
        pytest.skip(f"no weights/u2netp.onnx and DAVIS in {data_root}")
    return path


class TestRealNetwork:
    @pytest.mark.parametrize("every", [3, pytest.param(1, marks=pytest.mark.slow)])
    def test_objects_are_found(self, data_root: Path, u2net: Path, every: int) -> None:
        scores = {}
        for frame in Davis(data_root / "DAVIS", sequences=SEQUENCES[::every]):
            labels = segment(frame.image, "onnx", model=u2net, connected=False)
            assert labels.unique().tolist() == [0, 1]
            found, truth = labels == 1, frame.labels > 0
            scores[frame.sequence] = float((found & truth).sum() / (found | truth).sum())
        assert min(scores.values()) >= 0.8, scores
        assert sum(scores.values()) / len(scores) >= 0.88, scores

    def test_same_every_time_and_pieces_are_regions(self, data_root: Path, u2net: Path) -> None:
        image = Davis(data_root / "DAVIS")["blackswan"].image
        first = segment_with_scores(image, "onnx", model=u2net, snap=2)
        again = segment_with_scores(image, "onnx", model=u2net, snap=2)
        assert torch.equal(first.labels, again.labels)
        assert first.scores is not None
        assert again.scores is not None
        assert torch.equal(first.scores, again.scores)
        assert (first.scores > 0.8).all()
        areas = first.labels.flatten().bincount()
        assert (areas[:-1] >= areas[1:]).all()
        assert int(areas.min()) >= 0.0039 * first.labels.numel()
