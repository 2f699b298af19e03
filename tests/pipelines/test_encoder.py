"""An encoder: a network that predicts the Gaussians of a batch of images, trained and compiled."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator
from pathlib import Path

import kornia
import pytest
import torch
import torch._dynamo.testing
from torch import Tensor, nn
from torch.nn import functional

import kcgs
from kcgs import GaussianField, RegionMap, RegionSplatRenderer
from kcgs.functional import activate_gaussians, edge_band, lookup_regions, region_splat

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


class Encoder(nn.Module):
    """Images (B, 3, H, W) and label maps (B, H, W) to images of Gaussians, one for each cell."""

    cell = 4

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(
            nn.Conv2d(4, 32, 3, stride=2, padding=1), nn.GELU(),
            nn.Conv2d(32, 64, 3, stride=2, padding=1), nn.GELU(),
            nn.Conv2d(64, 64, 3, padding=1), nn.GELU(),
            nn.Conv2d(64, 8, 1),
        )  # fmt: skip

    def predict(self, images: Tensor, labels: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return means, factors, colours and region ids of a batch."""
        contours = edge_band(labels, width=1)[:, None].to(images)
        raw = self.net(torch.cat([images, contours], 1)).flatten(2).mT  # [B, N, 8], any real numbers
        height, width = images.shape[-2:]
        cells = kornia.geometry.create_meshgrid(height // self.cell, width // self.cell, False).flatten(0, 2)
        means, cholesky, colors = activate_gaussians(raw, (cells + 0.5) * self.cell, self.cell)
        colors = colors + 0.6 * functional.avg_pool2d(images, self.cell).flatten(2).mT
        return means, cholesky, colors, lookup_regions(means, labels)

    def forward(self, images: Tensor, labels: Tensor) -> Tensor:
        """Predict and render."""
        return region_splat(*self.predict(images, labels), labels)


@pytest.mark.parametrize("page", ["notebooks/06_differentiable_layer.ipynb", "docs/kornia.md"])
def test_is_the_one_that_people_start_from(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    if page.endswith("ipynb"):
        text = "\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
    assert inspect.getsource(Encoder) in text


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
