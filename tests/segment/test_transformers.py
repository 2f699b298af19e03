"""DINO, Segment Anything and CLIPSeg: small random models, saved and loaded as released ones are."""

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from kcgs.segment import segment, segment_with_scores
from kcgs.segment.methods.sam import suppress_duplicates
from tests.segment.checks import assert_segmentation, split_image

transformers = pytest.importorskip("transformers", reason="needs the extra: pip install transformers")

IMAGE = split_image(40, 60, 25)
VIT: dict[str, Any] = {"hidden_size": 24, "num_hidden_layers": 1, "num_attention_heads": 2, "image_size": 56}
DECODER = {"hidden_size": 32, "mlp_dim": 64, "num_attention_heads": 2, "iou_head_hidden_dim": 32}
Folder = Callable[[str], Path]


def sam() -> nn.Module:
    sizes = {"hidden_size": 32, "image_size": 128, "patch_size": 16}
    vision = transformers.SamVisionConfig(
        **sizes, output_channels=32, num_hidden_layers=1, num_attention_heads=1, mlp_dim=32, global_attn_indexes=[0],
        window_size=4, num_pos_feats=16,
    )  # fmt: skip
    prompts, decoder = transformers.SamPromptEncoderConfig(**sizes), transformers.SamMaskDecoderConfig(**DECODER)
    return transformers.SamModel(
        transformers.SamConfig(vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config=decoder)
    )


def sam2() -> nn.Module:
    backbone = transformers.Sam2HieraDetConfig(
        hidden_size=8, image_size=[128, 128], blocks_per_stage=[1, 1, 2, 1], embed_dim_per_stage=[8, 16, 24, 32],
        num_attention_heads_per_stage=[1, 1, 1, 1], global_attention_blocks=[3],
    )  # fmt: skip
    vision = transformers.Sam2VisionConfig(
        backbone_config=backbone, backbone_channel_list=[32, 24, 16, 8],
        backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]], fpn_hidden_size=32,
    )  # fmt: skip
    prompts = transformers.Sam2PromptEncoderConfig(hidden_size=32, image_size=128)
    decoder = transformers.Sam2MaskDecoderConfig(**DECODER)
    return transformers.Sam2Model(
        transformers.Sam2Config(vision_config=vision, prompt_encoder_config=prompts, mask_decoder_config=decoder)
    )


def clipseg() -> nn.Module:
    sizes = {"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2}
    text = {**sizes, "vocab_size": 54, "max_position_embeddings": 12, "bos_token_id": 52, "eos_token_id": 53}
    config = transformers.CLIPSegConfig(
        text_config=text, vision_config={**sizes, "image_size": 32, "patch_size": 8}, projection_dim=16, reduce_dim=8,
        extract_layers=[0, 1], decoder_num_attention_heads=2, decoder_intermediate_size=16,
    )  # fmt: skip
    return transformers.CLIPSegForImageSegmentation(config)


def clip_tokenizer() -> Any:
    letters = list("abcdefghijklmnopqrstuvwxyz")
    words = [*letters, *(letter + "</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    return transformers.CLIPTokenizer(vocab={word: k for k, word in enumerate(words)}, merges=[])


def color_dino() -> nn.Module:
    """Return a DINOv2 whose features are the mean colour of the patch, so that the right regions are known."""
    model = transformers.Dinov2Model(transformers.Dinov2Config(**(VIT | {"num_hidden_layers": 0}), patch_size=8))
    with torch.no_grad():
        for parameter in model.embeddings.parameters():
            parameter.zero_()
        for channel in range(3):
            model.embeddings.patch_embeddings.projection.weight[channel, channel] = 1 / 64
    return model


def vit(name: str, **options: Any) -> nn.Module:
    return getattr(transformers, f"{name}Model")(getattr(transformers, f"{name}Config")(**VIT, **options))


MODELS: dict[str, Callable[[], nn.Module]] = {
    "dino": lambda: vit("ViT", patch_size=8, intermediate_size=32),
    "dinov2": lambda: vit("Dinov2", patch_size=14),
    "dinov2-registers": lambda: vit("Dinov2WithRegisters", patch_size=14, num_register_tokens=4),
    "dinov3": lambda: vit("DINOv3ViT", patch_size=16, intermediate_size=32, num_register_tokens=4),
    "color-dino": color_dino,
    "sam": sam,
    "sam2": sam2,
    "clipseg": clipseg,
}
DINOS = ("dino", "dinov2", "dinov2-registers", "dinov3")
SAMS = ("sam", "sam2")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    @cache
    def save(name: str) -> Path:
        path = tmp_path_factory.mktemp(name)
        with torch.random.fork_rng():
            torch.manual_seed(0)
            model = MODELS[name]()
            if name not in (*SAMS, "color-dino"):  # maps that depend on the pixels, though nothing was learned
                for parameter in model.parameters():
                    if parameter.ndim > 1:
                        nn.init.normal_(parameter, std=0.3)
        model.save_pretrained(path)
        if name == "clipseg":
            clip_tokenizer().save_pretrained(path)
        return path

    return save


@pytest.fixture(autouse=True)
def stable_masks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let masks of random networks pass."""
    monkeypatch.setattr("kcgs.segment.methods.sam._MIN_STABILITY", 0.0)


BOX = [10, 10, 40, 30]
PROMPTS = ["a dog", "the grass", "god"]
SMALL_DINO = {"longer_side": 112, "num_clusters": 3}
CASES = [
    *(("dino", model, SMALL_DINO | {"max_regions": 2}, None) for model in DINOS),
    ("dino", "dinov2", {"longer_side": 64, "num_clusters": 1}, 1),
    ("dino", "color-dino", {"longer_side": 120, "num_clusters": 2}, 2),
    ("sam", "sam2", {"foreground": [[20, 20]], "background": [[50, 38]]}, None),
    ("sam", "sam", {"box": torch.tensor(BOX), "foreground": torch.tensor([[20, 20]])}, None),
    *(("sam", model, {"grid": 2, "min_score": 0.0, "max_regions": 5, "min_size": 4}, None) for model in SAMS),
    ("text", "clipseg", {"prompts": PROMPTS}, None),
    ("text", "clipseg", {"prompts": ["a dog"], "threshold": 0.5, "connected": False}, None),
]


class TestSegment:
    @pytest.mark.parametrize(("method", "model", "options", "count"), CASES)
    def test_map_and_scores(
        self, folder: Folder, method: str, model: str, options: dict[str, Any], count: int | None
    ) -> None:
        """They are the same every time, and no global seed moves."""
        state = torch.get_rng_state()
        first = segment_with_scores(IMAGE, method, model=folder(model), **options)
        assert torch.equal(torch.get_rng_state(), state)
        assert_segmentation(first, (40, 60))
        assert first.scores is not None
        assert len(first.scores) == count or (count is None and len(first.scores) <= options.get("max_regions", 99))
        assert torch.equal(segment(IMAGE, method, model=str(folder(model)), **options), first.labels)

    def test_contours_follow_pixels_not_patches(self, folder: Folder) -> None:
        labels = segment(IMAGE, "dino", model=folder("color-dino"), num_clusters=2, longer_side=120)
        assert ((labels == 0) == (IMAGE[2] == 1)).float().mean() > 0.98  # 25 is no border of patches of 4 pixels

    def test_small_images(self, folder: Folder) -> None:
        labels = segment(torch.rand(3, 1, 50), "dino", model=folder("dinov2"), longer_side=64)
        assert labels.shape == (1, 50)

    @pytest.mark.parametrize("model", SAMS)
    def test_a_prompt_asks_for_an_object(self, folder: Folder, model: str) -> None:
        names = segment_with_scores(IMAGE, "sam", model=folder(model), box=BOX, min_size=1).names
        assert names is not None and set(names.values()) == {"object", "background"}
        whole = segment_with_scores(IMAGE, "sam", model=folder(model), grid=1, min_score=1.0)  # that no mask covers
        assert whole.names is None and whole.scores is not None and whole.scores.isnan().all()

    def test_the_object_of_a_prompt_is_not_lost(self, folder: Folder, monkeypatch: pytest.MonkeyPatch) -> None:
        logits = torch.full((1, 1, 32, 32), -1.0)
        logits[..., 9:12, 9:12] = 1.0
        monkeypatch.setattr("kcgs.segment.methods.sam._predict_masks", lambda *_: (logits, torch.ones(1, 1)))
        with pytest.raises(ValueError, match=r"min_size must be smaller than the object, \d+ pixels in all; got 49"):
            segment(IMAGE, "sam", model=folder("sam"), box=BOX)
        assert segment(IMAGE, "sam", model=folder("sam"), box=BOX, min_size=1).any()

    def test_names_are_prompts(self, folder: Folder) -> None:
        def names(**options: Any) -> set[str]:
            return set((segment_with_scores(IMAGE, "text", model=folder("clipseg"), **options).names or {}).values())

        assert names(prompts=PROMPTS) <= set(PROMPTS)
        assert names(prompts=["a dog"], threshold=0.0) == {"a dog"}
        assert names(prompts=["a dog"], threshold=1.0) == {"background"}

    @pytest.mark.parametrize(
        ("method", "options", "message"),
        [
            ("dino", {"num_clusters": 0}, "num_clusters must be at least 1; got 0"),
            ("dino", {"longer_side": 0}, "longer_side must be at least 1; got 0"),
            ("sam", {"box": [1, 2, 3]}, "box must be 4 numbers"),
            ("sam", {"box": BOX, "foreground": [[50, 38]]}, r"foreground must be in the box; got \(50"),
            ("sam", {"background": [[1, 2]]}, "foreground must be given where there is no box"),
            ("sam", {"grid": 0}, "grid must be"),
            ("sam", {"min_score": 1.5}, "min_score must be"),
            ("text", {"prompts": "dog"}, "prompts must be a list of strings"),
            ("text", {"prompts": ["dog"]}, "prompts must be at least 2"),
            ("text", {"prompts": ["dog", "cat"], "threshold": 2.0}, "threshold must be in"),
        ],
    )
    def test_bad_options(self, folder: Folder, method: str, options: dict[str, Any], message: str) -> None:
        model = folder({"dino": "dino", "sam": "sam", "text": "clipseg"}[method])
        with pytest.raises((TypeError, ValueError), match=message):
            segment(IMAGE, method, model=model, **options)

    @pytest.mark.parametrize("damage", ["truncated", "of another model", "no files"])
    def test_bad_model(self, tmp_path: Path, folder: Folder, damage: str) -> None:
        from safetensors.torch import save_file

        weights = tmp_path / "model.safetensors"
        if damage != "no files":
            shutil.copytree(folder("dino"), tmp_path, dirs_exist_ok=True)
            weights.write_bytes(weights.read_bytes()[:200])
        if damage == "of another model":
            save_file({"weight": torch.zeros(3)}, weights, metadata={"format": "pt"})
        with pytest.raises(ValueError, match=f"cannot load .*{tmp_path}"):
            segment(IMAGE, "dino", model=tmp_path)


def test_no_patches() -> None:
    sizes = {"vocab_size": 5, "hidden_size": 8, "intermediate_size": 8}
    model = transformers.CLIPTextModel(transformers.CLIPTextConfig(**sizes, num_hidden_layers=1, num_attention_heads=1))
    with pytest.raises(ValueError, match="must be a vision transformer with patches; got CLIPTextModel"):
        segment(IMAGE, "dino", model=model)


def test_suppress_duplicates() -> None:
    masks = torch.zeros(4, 10, 10, dtype=torch.bool)
    masks[0, :5] = masks[1, :6] = masks[2, 5:] = True
    scores = torch.tensor([0.5, 0.9, 0.7, 1.0])
    assert suppress_duplicates(masks, scores, 0.7) == [1, 2]
    assert suppress_duplicates(masks, scores, 0.9) == [1, 0, 2]
    assert suppress_duplicates(masks[:0], torch.zeros(0), 0.5) == []
