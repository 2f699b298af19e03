"""Segment Anything: kornia's and SAM 2, small and random, saved and loaded as released weights are."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs.segment import segment, segment_with_scores
from kcgs.segment.methods.segment_anything import keep_apart

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
def sam_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    transformers = pytest.importorskip("transformers", reason="needs the extra: pip install 'kcgs[segment]'")
    sizes = {"hidden_size": 32, "image_size": 128}
    config = transformers.SamConfig(
        vision_config=transformers.SamVisionConfig(
            **sizes,
            output_channels=32,
            num_hidden_layers=1,
            num_attention_heads=1,
            patch_size=16,
            mlp_dim=32,
            global_attn_indexes=[0],
            window_size=4,
            num_pos_feats=16,
        ),
        prompt_encoder_config=transformers.SamPromptEncoderConfig(**sizes, patch_size=16),
        mask_decoder_config=transformers.SamMaskDecoderConfig(
            hidden_size=32, mlp_dim=64, num_attention_heads=2, iou_head_hidden_dim=32
        ),
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = transformers.SamModel(config)
    folder = tmp_path_factory.mktemp("sam")
    model.save_pretrained(folder)
    return folder


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


def test_doubles_go_and_smaller_masks_come_last() -> None:
    masks = torch.zeros(4, 10, 10, dtype=torch.bool)
    masks[0, :5] = masks[1, :6] = masks[2, 5:] = True
    assert keep_apart(masks, torch.tensor([0.5, 0.9, 0.7, 1.0]), 0.7) == [1, 2]
    assert keep_apart(masks, torch.tensor([0.5, 0.9, 0.7, 1.0]), 0.9) == [1, 0, 2]
    assert keep_apart(masks[:0], torch.zeros(0), 0.5) == []


@pytest.mark.parametrize("source", ["sam", "sam2"])
class TestPrompts:
    @pytest.fixture
    def options(self, source: str, request: pytest.FixtureRequest) -> dict[str, Any]:
        return {"model": str(request.getfixturevalue(f"{source}_folder"))}

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

    def test_grid(self, options: dict[str, Any]) -> None:
        labels, scores, _ = segment_with_scores(two_colors(), "sam", max_regions=5, min_size=4, **LOOSE, **options)
        assert_map(labels, scores)
        assert 1 < len(labels.unique()) <= 5

    def test_no_mask_is_good_enough(self, options: dict[str, Any]) -> None:
        labels, scores, _ = segment_with_scores(two_colors(), "sam", grid=1, min_stability=1.0, **options)
        assert int(labels.max()) == 0
        assert scores is not None
        assert scores.isnan().all()

    @pytest.mark.parametrize(
        ("prompt", "message"),
        [
            ({"boxes": torch.zeros(4)}, r"boxes must be numbers of shape \(any, 4\); got \(4,\)"),
            ({"boxes": [[1, 2], [3]]}, "boxes must be numbers"),
            ({"points": torch.zeros(0, 1, 2)}, "points must be numbers"),
            ({"points": [[[1, 2]]], "point_labels": [1, 0]}, "point_labels must be numbers"),
            ({"points": [[[1, 2]]], "boxes": torch.ones(1, 4)}, "boxes must be None"),
            ({"grid": 0}, "grid must be"),
            ({"min_score": 1.5}, "min_score must be"),
            ({"max_overlap": -1.0}, "max_overlap must be"),
        ],
    )
    def test_bad_prompt(self, options: dict[str, Any], prompt: dict[str, Any], message: str) -> None:
        with pytest.raises(ValueError, match=message):
            segment(two_colors(), "sam", **prompt, **options)


def test_other_weights(tmp_path: Path, sam2_folder: Path) -> None:
    from safetensors.torch import save_file

    (tmp_path / "config.json").write_bytes((sam2_folder / "config.json").read_bytes())
    save_file({"weight": torch.zeros(3)}, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(ValueError, match="as AutoModelForMaskGeneration: it lacks"):
        segment(two_colors(), "sam", model=tmp_path)
