"""Patch features of DINO, DINOv2 and DINOv3: small random models, saved and loaded as released ones are."""

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs.segment import segment, segment_with_scores
from kcgs.segment.methods.patch_features import patch_features

transformers = pytest.importorskip("transformers", reason="needs the extra: pip install 'kcgs[segment]'")

COMMON: dict[str, Any] = {
    "hidden_size": 24,
    "num_hidden_layers": 1,
    "num_attention_heads": 2,
    "image_size": 56,
}
CONFIGS = {
    "dino": ("ViT", {"patch_size": 8, "intermediate_size": 32}),
    "dinov2": ("Dinov2", {"patch_size": 14}),
    "dinov2-registers": ("Dinov2WithRegisters", {"patch_size": 14, "num_register_tokens": 4}),
    "dinov3": ("DINOv3ViT", {"patch_size": 16, "intermediate_size": 32, "num_register_tokens": 4}),
}


@pytest.fixture(scope="module", params=list(CONFIGS))
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    name, options = CONFIGS[request.param]
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = getattr(transformers, f"{name}Model")(getattr(transformers, f"{name}Config")(**COMMON, **options))
        for parameter in model.parameters():  # Features that depend on the patch, though nothing was learned.
            if parameter.ndim > 1:
                torch.nn.init.normal_(parameter, std=0.2)
    path = tmp_path_factory.mktemp(request.param)
    model.save_pretrained(path)
    return path


def two_colors(width: int = 120) -> Tensor:
    image = torch.zeros(3, 80, width)
    image[0, :, 51:] = 1.0
    image[1, 37:, 51:] = 1.0
    return image


class TestDino:
    def test_label_map(self, folder: Path) -> None:
        labels, scores, _ = segment_with_scores(two_colors(), "dino", model=folder, num_clusters=3, longer_side=112)
        areas = labels.flatten().bincount()
        assert labels.shape == (80, 120)
        assert labels.dtype == torch.int64
        assert (areas[:-1] >= areas[1:]).all()
        assert len(areas) > 1
        assert scores is not None
        assert scores.shape == areas.shape
        assert ((scores > 0) & (scores <= 1)).all()

    def test_same_every_time_and_no_global_seed_moves(self, folder: Path) -> None:
        state = torch.get_rng_state()
        first = segment(two_colors(), "dino", model=str(folder), longer_side=112, max_regions=4)
        assert torch.equal(torch.get_rng_state(), state)
        torch.rand(3)
        assert torch.equal(segment(two_colors(), "dino", model=str(folder), longer_side=112, max_regions=4), first)
        assert int(first.max()) + 1 <= 4

    def test_features(self, folder: Path) -> None:
        model = transformers.AutoModel.from_pretrained(folder)
        patch = model.config.patch_size
        features = patch_features(two_colors(), model, 8 * patch)
        assert features.shape == (round(80 / 120 * 8), 8, 24)
        features = patch_features(two_colors(), folder, patch)
        assert features.shape == (1, 1, 24)

    def test_one_cluster_and_tiny_images(self, folder: Path) -> None:
        assert int(segment(two_colors(), "dino", model=folder, num_clusters=1, longer_side=64).max()) == 0
        assert segment(torch.zeros(1, 1, 1), "dino", model=folder, longer_side=64).tolist() == [[0]]
        assert segment(torch.rand(3, 1, 50), "dino", model=folder, longer_side=64).shape == (1, 50)


@pytest.fixture(scope="module")
def linear(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a DINOv2 whose features are the mean colour of the patch, so that the right regions are known."""
    config = transformers.Dinov2Config(**(COMMON | {"num_hidden_layers": 0}), patch_size=8)
    model = transformers.Dinov2Model(config)
    with torch.no_grad():
        for parameter in model.embeddings.parameters():
            parameter.zero_()
        for channel in range(3):
            model.embeddings.patch_embeddings.projection.weight[channel, channel] = 1 / 64
    path = tmp_path_factory.mktemp("linear")
    model.save_pretrained(path)
    return path


class TestColors:
    def test_contours_lie_on_pixel_edges(self, linear: Path) -> None:
        """Neither 51 nor 37 is a border of patches of 8 pixels."""
        labels = segment(two_colors(), "dino", model=linear, num_clusters=3, longer_side=120)
        truth = (two_colors()[0] + two_colors()[1]).long()
        assert int(labels.max()) + 1 == 3
        joint = (truth * 3 + labels).flatten().bincount(minlength=9).reshape(3, 3)
        assert float(joint.max(dim=1).values.sum() / joint.sum()) > 0.98


class TestErrors:
    def test_folder(self, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match=f"cannot load '{tmp_path}' as AutoModel"):
            segment(two_colors(), "dino", model=tmp_path)

    @pytest.mark.parametrize("damage", ["truncated", "other"])
    def test_weights(self, tmp_path: Path, linear: Path, damage: str) -> None:
        from safetensors.torch import save_file

        (tmp_path / "config.json").write_bytes((linear / "config.json").read_bytes())
        if damage == "truncated":
            (tmp_path / "model.safetensors").write_bytes((linear / "model.safetensors").read_bytes()[:300])
        else:
            save_file({"weight": torch.zeros(3)}, tmp_path / "model.safetensors", metadata={"format": "pt"})
        with pytest.raises(ValueError, match=f"cannot load '{tmp_path}' as AutoModel"):
            segment(two_colors(), "dino", model=tmp_path)

    @pytest.mark.parametrize("option", ["num_clusters", "longer_side", "min_size"])
    def test_options(self, linear: Path, option: str) -> None:
        with pytest.raises(ValueError, match=f"{option} must be at least 1; got 0"):
            segment(two_colors(), "dino", model=linear, **{option: 0})

    def test_no_patches(self) -> None:
        model = transformers.CLIPTextModel(
            transformers.CLIPTextConfig(
                vocab_size=5, hidden_size=8, intermediate_size=8, num_hidden_layers=1, num_attention_heads=1
            )
        )
        with pytest.raises(ValueError, match="must be a vision transformer with patches; got CLIPTextModel"):
            segment(two_colors(), "dino", model=model)
