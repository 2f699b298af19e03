"""CLIPSeg: a small random model and tokenizer, saved and loaded as released ones are."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs.segment import segment, segment_with_scores

transformers = pytest.importorskip("transformers", reason="needs the extra: pip install 'kcgs[segment]'")

PROMPTS = ["a dog", "the grass", "god"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    letters = list("abcdefghijklmnopqrstuvwxyz")
    words = [*letters, *(letter + "</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    tokenizer = transformers.CLIPTokenizer(vocab={word: k for k, word in enumerate(words)}, merges=[])
    sizes = {"hidden_size": 16, "intermediate_size": 24, "num_hidden_layers": 2, "num_attention_heads": 2}
    config = transformers.CLIPSegConfig(
        text_config={
            **sizes,
            "vocab_size": len(words),
            "max_position_embeddings": 12,
            "bos_token_id": len(words) - 2,
            "eos_token_id": len(words) - 1,
        },
        vision_config={**sizes, "image_size": 32, "patch_size": 8},
        projection_dim=16,
        reduce_dim=8,
        extract_layers=[0, 1],
        decoder_num_attention_heads=2,
        decoder_intermediate_size=16,
    )
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = transformers.CLIPSegForImageSegmentation(config)
        for parameter in model.parameters():  # Maps that depend on words and pixels, though nothing was learned.
            if parameter.ndim > 1:
                torch.nn.init.normal_(parameter, std=0.3)
    path = tmp_path_factory.mktemp("clipseg")
    model.save_pretrained(path)
    tokenizer.save_pretrained(path)
    return path


def two_colors() -> Tensor:
    image = torch.zeros(3, 60, 90)
    image[0, :, 30:] = 1.0
    image[1, 25:, 50:] = 0.8
    return image


def assert_map(labels: Tensor, scores: Tensor | None) -> None:
    assert labels.shape == (60, 90)
    assert labels.dtype == torch.int64
    areas = labels.flatten().bincount()
    assert (areas[:-1] >= areas[1:]).all()
    assert scores is not None
    assert scores.shape == areas.shape
    assert ((scores > 0) & (scores <= 1)).all()


class TestText:
    def test_prompts(self, folder: Path) -> None:
        labels, scores, names = segment_with_scores(two_colors(), "text", prompts=PROMPTS, model=folder)
        assert_map(labels, scores)
        assert names is not None
        assert list(names) == labels.unique().tolist()
        assert set(names.values()) <= set(PROMPTS)
        assert torch.equal(labels, segment(two_colors(), "text", prompts=PROMPTS, model=str(folder)))

    @pytest.mark.parametrize("threshold", [0.0, 0.5, 1.0])
    def test_background(self, folder: Path, threshold: float) -> None:
        options: dict[str, Any] = {"prompts": ["a dog"], "threshold": threshold, "model": folder}
        labels, scores, names = segment_with_scores(two_colors(), "text", connected=False, **options)
        assert_map(labels, scores)
        if threshold in (0.0, 1.0):
            assert int(labels.max()) == 0
            assert names == {0: "background" if threshold else "a dog"}


class TestErrors:
    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            ({"prompts": "dog"}, TypeError, "prompts must be a list of strings"),
            ({"prompts": ["dog", 3]}, TypeError, "prompts must be a list of strings"),
            ({"prompts": ["dog"]}, ValueError, "prompts must be at least 2"),
            ({"prompts": [], "threshold": 0.5}, ValueError, "prompts must be at least 2"),
            ({"prompts": ["dog", "cat"], "threshold": 2.0}, ValueError, "threshold must be in"),
        ],
    )
    def test_options(self, folder: Path, options: dict[str, Any], error: type[Exception], message: str) -> None:
        with pytest.raises(error, match=message):
            segment(two_colors(), "text", model=folder, **options)

    @pytest.mark.parametrize("damage", ["no weights", "truncated"])
    def test_folder(self, tmp_path: Path, folder: Path, damage: str) -> None:
        path = tmp_path / "model"
        shutil.copytree(folder, path)
        if damage == "truncated":
            (path / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes()[:200])
        else:
            (path / "model.safetensors").unlink()
        with pytest.raises(ValueError, match=f"cannot load .*{path}"):
            segment(two_colors(), "text", prompts=PROMPTS, model=path)
