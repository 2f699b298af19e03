"""Segment Anything: kornia's and SAM 2, small and random, saved and loaded as released weights are."""

from pathlib import Path
from typing import Any

import pytest
import torch
from kornia.models.sam import Sam, SamConfig
from torch import Tensor

from kcgs.segment import segment, segment_with_scores
from kcgs.segment.methods.segment_anything import keep_apart, paint_masks

TINY = SamConfig(
    encoder_embed_dim=8, encoder_depth=1, encoder_num_heads=1, encoder_global_attn_indexes=(), checkpoint=None
)
LOOSE: dict[str, Any] = {"grid": 2, "min_score": 0.0, "min_stability": 0.0}


def two_colors() -> Tensor:
    image = torch.zeros(3, 48, 64)
    image[0, 10:30, 10:40] = 1.0
    image[1, 25:45, 30:60] = 0.7
    return image


def assert_map(labels: Tensor, scores: Tensor | None, size: tuple[int, int] = (48, 64)) -> None:
    assert labels.shape == size
    assert labels.dtype == torch.int64
    areas = labels.flatten().bincount()
    assert (areas > 0).all()
    assert (areas[:-1] >= areas[1:]).all()
    assert scores is not None
    assert scores.shape == areas.shape
    known = scores[scores.isfinite()]
    assert ((known >= 0) & (known <= 1)).all()


@pytest.fixture(scope="module")
def kornia_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Sam.from_config(TINY)
        torch.nn.init.constant_(model.mask_decoder.iou_prediction_head.layers[-1].bias, 0.5)
    path = tmp_path_factory.mktemp("sam") / "tiny.pth"
    torch.save(model.state_dict(), path)
    return path


@pytest.fixture(scope="module")
def sam2_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    transformers = pytest.importorskip("transformers", reason="needs the extra: pip install 'kcgs[segment]'")
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=8,
        image_size=[128, 128],
        blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 24, 32],
        num_attention_heads_per_stage=[1, 1, 1, 1],
        global_attention_blocks=[3],
    )
    vision = transformers.Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[32, 24, 16, 8],
        backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]],
        fpn_hidden_size=32,
    )
    config = transformers.Sam2Config(
        vision_config=vision,
        prompt_encoder_config=transformers.Sam2PromptEncoderConfig(hidden_size=32, image_size=128),
        mask_decoder_config=transformers.Sam2MaskDecoderConfig(
            hidden_size=32, mlp_dim=64, num_attention_heads=2, iou_head_hidden_dim=32
        ),
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = transformers.Sam2Model(config)
    folder = tmp_path_factory.mktemp("sam2")
    model.save_pretrained(folder)
    return folder


class TestOverlap:
    def test_smaller_lies_over_larger(self) -> None:
        masks = torch.zeros(3, 4, 4, dtype=torch.bool)
        masks[0, :2] = masks[1, :, :2] = masks[2, 0, 0] = True
        labels, scores = paint_masks(masks, torch.tensor([0.5, 0.6, 0.1]))
        # The first two are of one size: the better, the second, comes last.
        areas = labels.flatten().bincount().tolist()
        assert areas == [4, 4, 7, 1]
        assert float(scores[0, 0]) == pytest.approx(0.1)
        assert int(scores.isnan().sum()) == 4

    def test_labels_and_scores(self) -> None:
        masks = torch.tensor([[[True, True, True, False]], [[False, True, False, False]]])
        labels, scores = paint_masks(masks, torch.tensor([0.9, 0.8]))
        assert labels.tolist() == [[1, 2, 1, 0]]
        assert scores[0].tolist() == pytest.approx([0.9, 0.8, 0.9, float("nan")], nan_ok=True)

    def test_doubles_go(self) -> None:
        masks = torch.zeros(4, 10, 10, dtype=torch.bool)
        masks[0, :5] = masks[1, :6] = masks[2, 5:] = True
        assert keep_apart(masks, torch.tensor([0.5, 0.9, 0.7, 1.0]), 0.7).tolist() == [1, 2]
        assert keep_apart(masks, torch.tensor([0.5, 0.9, 0.7, 1.0]), 0.9).tolist() == [1, 2, 0]

    def test_none(self) -> None:
        masks = torch.zeros(0, 3, 3, dtype=torch.bool)
        assert keep_apart(masks, torch.zeros(0), 0.5).tolist() == []
        assert (paint_masks(masks, torch.zeros(0))[0] == 0).all()


@pytest.mark.parametrize("source", ["kornia", "sam2"])
class TestPrompts:
    @pytest.fixture
    def options(self, source: str, request: pytest.FixtureRequest) -> dict[str, Any]:
        if source == "kornia":
            return {"model": TINY, "checkpoint": request.getfixturevalue("kornia_checkpoint")}
        return {"model": str(request.getfixturevalue("sam2_folder"))}

    def test_boxes(self, options: dict[str, Any]) -> None:
        boxes = torch.tensor([[10.0, 10.0, 40.0, 30.0], [30.0, 25.0, 60.0, 45.0]])
        labels, scores, _ = segment_with_scores(two_colors(), "sam", boxes=boxes, **options)
        assert_map(labels, scores)
        assert torch.equal(labels, segment(two_colors(), "sam", boxes=boxes, **options))
        assert torch.equal(labels, segment(two_colors(), "sam", boxes=boxes.int().tolist(), **options))

    def test_points(self, options: dict[str, Any]) -> None:
        points = torch.tensor([[[20.0, 20.0], [50.0, 40.0]]])
        labels, scores, _ = segment_with_scores(
            two_colors(), "sam", points=points, point_labels=torch.tensor([[1, 0]]), **options
        )
        assert_map(labels, scores)
        assert_map(*segment_with_scores(two_colors(), "sam", points=points[0], **options)[:2])

    def test_lists(self, options: dict[str, Any]) -> None:
        labels = segment(two_colors(), "sam", points=[[20, 20], [50, 40.5]], point_labels=[1, 0], **options)
        points = torch.tensor([[20.0, 20.0], [50.0, 40.5]])
        assert torch.equal(
            labels, segment(two_colors(), "sam", points=points, point_labels=torch.tensor([1, 0]), **options)
        )
        for wrong in ({"boxes": [[1, 2], [3]]}, {"points": "here"}, {"points": [[1, 2]], "point_labels": [0.5]}):
            with pytest.raises(TypeError, match=f"{list(wrong)[-1]} must"):
                segment(two_colors(), "sam", **wrong, **options)

    def test_grid(self, options: dict[str, Any]) -> None:
        labels, scores, _ = segment_with_scores(two_colors(), "sam", max_regions=5, min_size=4, **LOOSE, **options)
        assert_map(labels, scores)
        assert 1 < len(labels.unique()) <= 5

    def test_large_image(self, options: dict[str, Any]) -> None:
        """Prompts and masks follow, though the model works on a smaller image."""
        boxes = torch.tensor([[100.0, 10.0, 700.0, 60.0]])
        rules: dict[str, Any] = {"min_size": 1, "connected": False}
        expected = segment(torch.full((3, 96, 1024), 0.4), "sam", boxes=boxes, **rules, **options)
        labels = segment(torch.full((3, 192, 2048), 0.4), "sam", boxes=boxes * 2, **rules, **options)
        assert len(expected.unique()) == 2
        assert torch.equal(labels, expected.repeat_interleave(2, 0).repeat_interleave(2, 1))

    def test_no_mask_is_good_enough(self, options: dict[str, Any]) -> None:
        labels, scores, _ = segment_with_scores(two_colors(), "sam", grid=1, min_stability=1.0, **options)
        assert int(labels.max()) == 0
        assert scores is not None
        assert scores.isnan().all()

    @pytest.mark.parametrize(
        ("prompt", "message"),
        [
            ({"boxes": torch.zeros(1, 4)}, "boxes must be left, top"),
            ({"boxes": torch.zeros(4)}, "boxes must have"),
            ({"points": torch.zeros(0, 2)}, "at least one point"),
            ({"points": torch.zeros(1, 3)}, "points must have shape"),
            ({"point_labels": torch.ones(1, dtype=torch.int64)}, "must come with points"),
            ({"points": torch.zeros(1, 2), "point_labels": torch.tensor([3])}, "point_labels must be 0 or 1"),
            ({"points": torch.zeros(1, 2), "boxes": torch.ones(1, 4)}, "not both"),
            ({"grid": 0}, "grid must be"),
            ({"min_score": 1.5}, "min_score must be"),
            ({"max_overlap": -1.0}, "max_overlap must be"),
        ],
    )
    def test_bad_prompt(self, options: dict[str, Any], prompt: dict[str, Any], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            segment(two_colors(), "sam", **prompt, **options)


class TestLoadedSam:
    def test_gives_what_its_checkpoint_gives(self, kornia_checkpoint: Path) -> None:
        model = Sam.from_config(TINY)
        model.load_state_dict(torch.load(kornia_checkpoint))
        boxes = torch.tensor([[10.0, 10.0, 40.0, 30.0]])
        labels = segment(two_colors(), "sam", model=model, boxes=boxes)
        assert torch.equal(labels, segment(two_colors(), "sam", model=TINY, checkpoint=kornia_checkpoint, boxes=boxes))
        with pytest.raises(ValueError, match="checkpoint must be None with a loaded Sam"):
            segment(two_colors(), "sam", model=model, checkpoint=kornia_checkpoint)


class TestKorniaCheckpoint:
    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*gone.pth"):
            segment(two_colors(), "sam", checkpoint=tmp_path / "gone.pth")
        with pytest.raises(ValueError, match="checkpoint must be given"):
            segment(two_colors(), "sam", model=TINY)

    @pytest.mark.parametrize("damage", ["truncated", "text", "other"])
    def test_damaged(self, tmp_path: Path, kornia_checkpoint: Path, damage: str) -> None:
        path = tmp_path / "bad.pth"
        if damage == "truncated":
            path.write_bytes(kornia_checkpoint.read_bytes()[:5000])
        elif damage == "text":
            path.write_text("no weights")
        else:
            torch.save({"weight": torch.zeros(3)}, path)
        with pytest.raises(ValueError, match=r"cannot load .*bad.pth as Segment Anything") as error:
            segment(two_colors(), "sam", model=TINY, checkpoint=path)
        said = str(error.value).replace(str(path), "")  # which is as long as the machine has it
        assert len(said) < 450 and "weights_only" not in said
        if damage == "other":
            assert "Missing key(s)" in str(error.value)

    @pytest.mark.slow
    def test_weights_of_another_size(self, kornia_checkpoint: Path) -> None:
        with pytest.raises(ValueError, match=r"cannot load .*tiny.pth as Segment Anything 'mobile_sam'"):
            segment(two_colors(), "sam", model="mobile_sam", checkpoint=kornia_checkpoint)

    @pytest.mark.slow
    def test_mobile_sam(self, tmp_path: Path) -> None:
        with torch.random.fork_rng():
            torch.manual_seed(0)
            torch.save(Sam.from_config(SamConfig("mobile_sam")).state_dict(), tmp_path / "mobile.pth")
        boxes = torch.tensor([[10.0, 10.0, 40.0, 30.0]])
        found = segment_with_scores(
            two_colors(), "sam", model="mobile_sam", checkpoint=tmp_path / "mobile.pth", boxes=boxes
        )
        assert_map(found.labels, found.scores)


class TestSam2Checkpoint:
    def test_truncated(self, tmp_path: Path, sam2_folder: Path) -> None:
        (tmp_path / "config.json").write_bytes((sam2_folder / "config.json").read_bytes())
        weights = (sam2_folder / "model.safetensors").read_bytes()
        (tmp_path / "model.safetensors").write_bytes(weights[: len(weights) // 2])
        with pytest.raises(ValueError, match=f"cannot load '{tmp_path}' as Sam2Model"):
            segment(two_colors(), "sam", model=tmp_path)

    def test_not_a_model(self, tmp_path: Path, sam2_folder: Path) -> None:
        with pytest.raises(ValueError, match="cannot load .* as Sam2Model"):
            segment(two_colors(), "sam", model=tmp_path)
        with pytest.raises(ValueError, match="checkpoint goes with vit_b"):
            segment(two_colors(), "sam", model=sam2_folder, checkpoint=sam2_folder / "model.safetensors")

    def test_other_weights(self, tmp_path: Path, sam2_folder: Path) -> None:
        from safetensors.torch import save_file

        (tmp_path / "config.json").write_bytes((sam2_folder / "config.json").read_bytes())
        save_file({"weight": torch.zeros(3)}, tmp_path / "model.safetensors", metadata={"format": "pt"})
        with pytest.raises(ValueError, match="as Sam2Model: it lacks"):
            segment(two_colors(), "sam", model=tmp_path)
