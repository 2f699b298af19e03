"""An encoder: a network that predicts the Gaussians of a batch of images, trained and compiled."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import kornia
import pytest
import torch
import torch._dynamo.testing
from torch import Tensor, nn

import kcgs
from kcgs import GaussianField, RegionMap, RegionSplatRenderer
from kcgs.functional import region_splat

ROOT = Path(kcgs.__file__).resolve().parent.parent
SIZE = (24, 32)
BATCH = 4


def draw_shapes(seed: int) -> tuple[Tensor, Tensor]:
    """Draw a coloured disc on a shaded ground of another colour, (B, 3, H, W), and the label maps, (B, H, W).

    Every second image has a third region, of another id for each, in a corner.
    """
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(BATCH, 10, generator=generator)
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in SIZE), indexing="ij")
    center_x, center_y = (8 + 16 * draw[:, 0])[:, None, None], (8 + 8 * draw[:, 1])[:, None, None]
    inside = (x - center_x) ** 2 + (y - center_y) ** 2 < (4 + 3 * draw[:, 2])[:, None, None] ** 2
    ground = draw[:, 3:6, None, None] * (0.5 + 0.5 * x / SIZE[1])
    images, labels = torch.where(inside[:, None], draw[:, 6:9, None, None], ground), inside.long()
    images[::2, :, :8, :8] = draw[::2, 9, None, None, None]
    labels[::2, :8, :8] = 2 + torch.arange(0, BATCH, 2)[:, None, None]
    return images, labels


PAGE = (ROOT / "docs/kornia.md").read_text(encoding="utf-8")
BLOCK = re.search(r"^from kcgs[^`]*^class Encoder[^`]*", PAGE, re.MULTILINE)[0]
NAMES = {"kornia": kornia, "torch": torch, "nn": nn, "functional": nn.functional, "Tensor": Tensor}
exec(BLOCK, NAMES)
Encoder = NAMES["Encoder"]


def test_is_that_of_the_tutorial() -> None:
    notebook = json.loads((ROOT / "notebooks/06_differentiable_layer.ipynb").read_text(encoding="utf-8"))
    text = "\n".join("".join(cell["source"]) for cell in notebook["cells"])
    assert BLOCK[BLOCK.index("class Encoder") :] in text


def test_trains_through_the_renderer() -> None:
    """The loss over a batch falls to a fifth in 60 steps."""
    torch.manual_seed(0)
    encoder = Encoder()
    images, labels = draw_shapes(0)
    regions = RegionMap(labels, 0.7)
    optimizer = torch.optim.Adam(encoder.parameters(), lr=5e-3)
    losses = []
    for step in range(60):
        loss = (region_splat(*encoder.predict(images, labels), regions) - images).square().mean()
        optimizer.zero_grad()
        loss.backward()
        if step in (0, 59):
            for name, parameter in encoder.named_parameters():
                assert parameter.grad is not None and parameter.grad.isfinite().all(), name
                assert parameter.grad.any(), name
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.2 * losses[0]


class TestOneGraph:
    """Network, renderer and Kornia's loss in one graph."""

    @pytest.fixture(autouse=True)
    def fresh(self) -> Iterator[None]:
        torch._dynamo.reset()
        yield
        torch._dynamo.reset()

    @pytest.mark.filterwarnings("ignore:.*torch.autograd.function.Function.* should not be:DeprecationWarning")
    @pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf:UserWarning")
    def test_trains_compiled(self) -> None:
        """Images and maps with other numbers of regions at every step: compiled once, the losses of eager mode."""

        def train(name: str | None) -> tuple[list[float], int]:
            torch.manual_seed(0)
            encoder = Encoder()
            optimizer = torch.optim.SGD(encoder.parameters(), lr=0.1)

            def batch_loss(images: Tensor, labels: Tensor) -> Tensor:
                return kornia.losses.ssim_loss(encoder(images, labels), images, window_size=5)

            counter = torch._dynamo.testing.CompileCounterWithBackend(name or "eager")
            step_loss = torch.compile(batch_loss, fullgraph=True, backend=counter) if name else batch_loss
            losses = []
            for step in range(4):
                loss = step_loss(*draw_shapes(step % 2))
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                losses.append(float(loss.detach()))
            return losses, counter.frame_count

        losses, compiled = train("aot_eager")
        assert compiled == 1 and losses == pytest.approx(train(None)[0], rel=1e-4)
        assert losses[-2] < losses[0]

    @pytest.mark.filterwarnings("ignore:.*torch.autograd.function.Function.* should not be:DeprecationWarning")
    def test_a_field_and_its_checks_are_in_the_graph(self) -> None:
        """A field may be made there, too, of tensors with a graph; what is not finite is refused as it runs."""
        encoder = Encoder()

        def render(images: Tensor, labels: Tensor) -> Tensor:
            field = GaussianField(*encoder.predict(images, labels)[:3], size=SIZE).assign_regions(labels)
            return RegionSplatRenderer()(field, labels)

        compiled, (images, labels) = torch.compile(render, fullgraph=True, backend="eager"), draw_shapes(0)
        assert torch.equal(compiled(images, labels), encoder(images, labels))
        with pytest.raises(RuntimeError, match="means must be finite"):
            compiled(images * torch.nan, labels)
        with pytest.raises(RuntimeError, match="labels must hold non-negative ids"):
            compiled(images, labels - 1)
