"""Progressive fits: the strongest Gaussians alone are an image."""

from __future__ import annotations

import torch
from skimage import data

from kcgs import Scene, fit
from kcgs.fitting import FitConfig
from kcgs.fitting.prefixes import strongest
from kcgs.functional import psnr, region_splat


def test_a_share_of_the_strongest_now_and_then() -> None:
    generator = torch.Generator().manual_seed(0)
    colors = torch.rand(200, 3, generator=generator)
    cholesky = torch.tensor([2.0, 0.0, 3.0]).repeat(200, 1)
    cholesky[0] = torch.tensor([1e9, 0.0, 1e9])  # counts as wide as the image
    chosen = [strongest(cholesky, colors, (10, 10), 0, iteration) for iteration in range(60)]
    counts = {len(index) for index in chosen if index is not None}
    assert [index is None for index in chosen] == [True, True, False] * 20
    assert counts == {22, 32, 50, 77, 120}
    index = chosen[2]
    assert index is not None
    energy = colors.square().sum(-1) * torch.full((200,), 6 * torch.pi).index_fill(0, torch.tensor(0), 100.0)
    assert torch.equal(index, energy.argsort(descending=True)[: len(index)])
    assert torch.equal(index, strongest(cholesky, colors, (10, 10), 0, 2))


def psnr_of(scene: Scene, image: torch.Tensor, share: float) -> float:
    """PSNR of a share of the Gaussians, the strongest."""
    field = scene.field
    means, cholesky, colors = (t.detach() for t in (field.means, field.cholesky, field.colors))
    energy = colors.square().sum(-1) * cholesky[:, 0] * cholesky[:, 2]
    index = energy.argsort(descending=True)[: round(share * field.num_gaussians)]
    ids = None if field.region_ids is None else field.region_ids[index]
    render = region_splat(means[index], cholesky[index], colors[index], ids, scene.regions, size=scene.size)
    return float(psnr(render.clamp(0, 1), image))


def test_the_strongest_show_the_image() -> None:
    image = torch.from_numpy(data.astronaut()[:96, 160:288] / 255).permute(2, 0, 1).float()
    labels = (image.mean(0) > 0.5).long()
    scenes = [fit(image, labels, 150, iterations=250, objective=name).scene for name in ("psnr", "progressive")]
    for share, gain in ((0.25, 1.5), (0.5, 0.75), (1.0, -1.5)):
        usual, progressive = (psnr_of(scene, image, share) for scene in scenes)
        assert progressive > usual + gain, share


def test_takes_longer_and_repeats() -> None:
    assert FitConfig(objective="progressive").usual_iterations == 900 > FitConfig().usual_iterations
    assert FitConfig(objective="progressive", iterations=5).usual_iterations == 5
    image = torch.rand(3, 24, 32, generator=torch.Generator().manual_seed(0))
    first, second = (fit(image, None, 20, iterations=60, objective="progressive").scene.render() for _ in range(2))
    assert torch.equal(first, second)
