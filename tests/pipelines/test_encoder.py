"""An amortised encoder: a network that predicts the Gaussians of a batch of images, trained through the renderer."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from kcgs import GaussianField, RegionMap, RegionSplatRenderer
from kcgs.functional import region_splat

SIZE = (24, 32)
COUNT = 16  # Gaussians of an image
BATCH = 6


def draw_shapes(seed: int, batch: int = BATCH) -> tuple[Tensor, Tensor]:
    """Draw a coloured disc on a shaded ground of another colour, (B, 3, H, W), and the label maps, (B, H, W)."""
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(batch, 10, generator=generator)
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in SIZE), indexing="ij")
    center_x, center_y = (8 + 16 * draw[:, 0])[:, None, None], (8 + 8 * draw[:, 1])[:, None, None]
    inside = (x - center_x) ** 2 + (y - center_y) ** 2 < (4 + 3 * draw[:, 2])[:, None, None] ** 2
    ground = draw[:, 3:6, None, None] * (0.5 + 0.5 * x / SIZE[1])
    return torch.where(inside[:, None], draw[:, 6:9, None, None], ground), inside.long()


class Encoder(nn.Module):
    """Image and label map to Gaussians on a loose grid."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(4, 16, 3, stride=2, padding=1), nn.GELU(), nn.Conv2d(16, 32, 3, stride=2, padding=1), nn.GELU(),
            nn.AdaptiveAvgPool2d((3, 4)), nn.Flatten(),
        )  # fmt: skip
        self.head = nn.Sequential(nn.Linear(32 * 12, 64), nn.GELU(), nn.Linear(64, COUNT * 8))
        rows, cols = torch.meshgrid(torch.arange(4.0), torch.arange(4.0), indexing="ij")
        grid = torch.stack([(cols + 0.5) * SIZE[1] / 4, (rows + 0.5) * SIZE[0] / 4], -1)
        self.register_buffer("grid", grid.view(COUNT, 2), persistent=False)

    def forward(self, images: Tensor, labels: Tensor) -> GaussianField:
        raw = self.head(self.features(torch.cat([images, labels[:, None].to(images)], 1))).unflatten(1, (COUNT, 8))
        means = self.grid + 4 * raw[..., :2].tanh()
        scales = 1 + 4 * nn.functional.softplus(raw[..., 2:4])
        cholesky = torch.stack([scales[..., 0], raw[..., 4], scales[..., 1]], -1)
        return GaussianField(means, cholesky, raw[..., 5:], size=SIZE).assign_regions(labels)


@pytest.mark.parametrize("softness", [0.0, 0.7])
def test_trains_through_the_renderer(softness: float) -> None:
    """The loss over a batch falls to a twentieth in 200 steps."""
    torch.manual_seed(0)
    encoder, render = Encoder(), RegionSplatRenderer()
    images, labels = draw_shapes(0)
    regions = RegionMap.from_labels(labels, softness)
    optimizer = torch.optim.Adam(encoder.parameters(), lr=3e-3)
    losses = []
    for step in range(200):
        field = encoder(images, labels)
        assert not list(field.parameters())  # part of the encoder's graph, nothing to train of its own
        loss = (render(field, regions) - images).square().mean()
        optimizer.zero_grad()
        loss.backward()
        if step in (0, 199):
            for name, parameter in encoder.named_parameters():
                assert parameter.grad is not None and parameter.grad.isfinite().all(), name
                assert parameter.grad.any(), name
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.05 * losses[0]


def test_generalises_to_images_not_seen() -> None:
    """Trained on fresh images at every step, it draws others better than a field of their mean colours."""
    torch.manual_seed(0)
    encoder, render = Encoder(), RegionSplatRenderer()
    optimizer = torch.optim.Adam(encoder.parameters(), lr=3e-3)
    for step in range(400):
        images, labels = draw_shapes(step + 1)
        loss = (render(encoder(images, labels), labels) - images).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    images, labels = draw_shapes(100_000, batch=32)
    with torch.no_grad():
        error = (render(encoder(images, labels), labels) - images).square().mean()
    flat = images - images.mean((-2, -1), keepdim=True)
    assert error < 0.5 * flat.square().mean()


def test_a_batch_is_its_images(backend: str) -> None:
    """Ids and label maps of a batch: each image has its own, and drawn alone it is the same."""
    torch.manual_seed(0)
    images, labels = draw_shapes(3)
    field = Encoder()(images, labels)
    assert field.region_ids is not None and field.region_ids.shape == (BATCH, COUNT)
    together = RegionSplatRenderer(backend=backend)(field, labels)
    assert together.shape == images.shape
    for b in range(BATCH):
        alone = region_splat(
            field.means[b], field.cholesky[b], field.colors[b], field.region_ids[b], labels[b], backend=backend
        )
        torch.testing.assert_close(together[b], alone, rtol=1e-5, atol=1e-5)


def test_gradients_agree_between_backends() -> None:
    torch.manual_seed(0)
    encoder = Encoder()
    images, labels = draw_shapes(3)
    gradients = {}
    for name in ("reference", "tiled", "cpu"):
        picture = RegionSplatRenderer(backend=name)(encoder(images, labels), labels)
        gradients[name] = torch.autograd.grad((picture - images).square().sum(), list(encoder.parameters()))
    for name in ("tiled", "cpu"):
        for got, want in zip(gradients[name], gradients["reference"], strict=True):
            torch.testing.assert_close(got, want, rtol=1e-3, atol=1e-3 * float(want.abs().max()))
