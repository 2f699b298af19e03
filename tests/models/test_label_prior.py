"""The script that trains the tables of the label model."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kcgs.codec.labels.contexts import PIXEL, PRIORS, TEMPLATE, layout, load_prior, make_network
from models import label_prior
from tests.codec.conftest import make_labels


def test_tables_have_the_format(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(label_prior, "SHAPES", 1)
    data = label_prior.pack(label_prior.train([make_labels(1, (40, 50))], steps=3, seed=0, units=(8, 4)))
    assert len(data) == sum(np.dtype(kind).itemsize * int(np.prod(shape)) for kind, shape in layout(8, 4))


@pytest.mark.parametrize("name", PRIORS)
def test_the_network_is_the_codec_s(name: str) -> None:
    prior = load_prior(name)
    tables = [torch.from_numpy(table).float() for table in prior[:-1]]
    parameters = [t / scale for t, (scale, _) in zip(tables, label_prior.limits(), strict=True)]
    parameters[0] = parameters[0].flatten(0, 1)
    features = torch.randint(3, (50, len(TEMPLATE)), generator=torch.Generator().manual_seed(0), dtype=torch.int8)
    pixels = np.zeros(50, PIXEL).view(np.recarray)
    pixels["features"] = features.numpy()
    for pixel in pixels:
        make_network(prior).py_func(pixel, np.zeros(sum(PRIORS[name]), np.int32))
    coded = torch.from_numpy(pixels["estimates"][:, :, 0]) / 256
    assert (label_prior.network(features, parameters) - coded).abs().max() < 0.1
