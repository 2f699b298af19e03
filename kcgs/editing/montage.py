"""Choose one layer per pixel with the least visible seams: alpha expansion by graph cuts."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

# costs are rounded to multiples of this, since the flow takes integers
_RESOLUTION = 1e-4
# largest cost of a pixel
_LIMIT = 1e4


def choose_layers(layers: Tensor, costs: Tensor, unknown: Tensor) -> Tensor:
    """Choose a layer for each unknown pixel, with the least visible seams between layers and around the hole.

    Two neighbours with different layers cost the difference of these layers at both pixels. A pixel beside a known
    pixel costs the difference of its layer and the image at the known pixel. Each step gives one layer to the pixels
    where this lowers the total cost most: first each layer in turn, then each layer in use again.

    Source: Boykov, Veksler and Zabih, "Fast approximate energy minimization via graph cuts", 2001, for the steps;
    Agarwala et al., "Interactive digital photomontage", 2004, for seams.

    Args:
        layers: :math:`(L, C, H, W)`; the first layer is the image where it is known.
        costs: cost of each layer at each pixel, :math:`(L, H, W)`, at least 0.
        unknown: :math:`(H, W)` bool.

    Returns:
        :math:`(H, W)` int64, 0 where the image is known.
    """
    layers, costs = layers.cpu().double(), costs.cpu().double()
    hole = unknown.cpu()
    seams = _Seams(layers, costs, hole)
    labels = torch.zeros(int(hole.sum()), dtype=torch.int64)
    energy = seams.energy(labels)
    for layers_in_use in (False, True):
        for layer in labels.unique().tolist() if layers_in_use else range(len(layers)):
            expanded = torch.where(seams.expand(labels, layer), layer, labels)
            if (lower := seams.energy(expanded)) < energy:
                labels, energy = expanded, lower
    result = torch.zeros(hole.shape, dtype=torch.int64)
    result[hole] = labels
    return result.to(unknown.device)


class _Seams:
    """The pixels of a hole, their costs by layer, and pairs of neighbours in the hole."""

    def __init__(self, layers: Tensor, costs: Tensor, hole: Tensor) -> None:
        height, width = hole.shape
        number = torch.zeros(hole.shape, dtype=torch.int64)
        number[hole] = torch.arange(int(hole.sum()))
        self.values = layers[:, :, hole]
        self.costs = costs[:, hole]
        pairs = []
        for down, right in ((1, 0), (0, 1)):
            first = slice(0, height - down), slice(0, width - right)
            second = slice(down, height), slice(right, width)
            for inner, outer in ((first, second), (second, first)):
                edge = hole[inner] & ~hole[outer]
                difference = (layers[:, :, *outer] - layers[0, :, *outer]).norm(dim=1)[:, edge]
                self.costs.index_add_(1, number[inner][edge], difference)
            both = hole[first] & hole[second]
            pairs.append(torch.stack([number[first][both], number[second][both]]))
        self.pairs = torch.cat(pairs, 1)

    def energy(self, labels: Tensor) -> float:
        """Return the total cost of a choice of layers."""
        first, second = self.pairs
        seams = self._difference(labels[first], labels[second])
        return float(self.costs.gather(0, labels[None]).sum() + seams.sum())

    def expand(self, labels: Tensor, layer: int) -> Tensor:
        """Return the mask of the pixels that should change to `layer`: no other such mask has less total cost."""
        first, second = self.pairs
        present = self._difference(labels[first], labels[second])
        second_changes = self._difference(labels[first], torch.full_like(first, layer))
        first_changes = self._difference(torch.full_like(first, layer), labels[second])
        gain = self.costs[layer] - self.costs.gather(0, labels[None])[0]
        # x and y are 1 if the first and the second pixel of a pair change; the pair then costs
        # present + (first - present) x - first y + (first + second - present) (1 - x) y
        gain = gain.index_add(0, first, first_changes - present).index_add(0, second, -first_changes)
        return _minimum_cut(gain, self.pairs, (first_changes + second_changes - present).clamp_min(0))

    def _difference(self, one: Tensor, other: Tensor) -> Tensor:
        """Return the difference of two layers at both pixels of all pairs."""
        return torch.stack([
            (self.values[one, :, pixel] - self.values[other, :, pixel]).norm(dim=1) for pixel in self.pairs
        ]).sum(0)  # fmt: skip


def _minimum_cut(gain: Tensor, pairs: Tensor, cost: Tensor) -> Tensor:
    """Return x, 0 or 1 for each pixel, with the least sum of gain x over pixels and of cost (1 - x) y over pairs."""
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    count = len(gain)
    source, sink = count, count + 1
    capacity, weights = _integers(cost), _integers(gain)
    loss, profit = (np.nonzero(condition)[0] for condition in (weights > 0, weights < 0))
    first, second = pairs.numpy()
    rows = np.concatenate([first, np.full(len(loss), source), profit])
    columns = np.concatenate([second, loss, np.full(len(profit), sink)])
    graph = csr_matrix(
        (np.concatenate([capacity, weights[loss], -weights[profit]]), (rows, columns)), shape=(count + 2, count + 2)
    )
    residual = graph - maximum_flow(graph, source, sink).flow
    residual.data = np.maximum(residual.data, 0)
    residual.eliminate_zeros()
    changes = torch.ones(count + 2, dtype=torch.bool)
    changes[torch.from_numpy(breadth_first_order(residual, source, return_predecessors=False)).long()] = False
    return changes[:count]


def _integers(values: Tensor) -> NDArray[np.int32]:
    return (values.clamp(-_LIMIT, _LIMIT) / _RESOLUTION).round().numpy().astype(np.int32)
