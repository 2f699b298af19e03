"""The script that trains the tables of the label model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from kcgs.codec import encode_labels
from kcgs.codec.labels import coding
from kcgs.codec.labels.contexts import FEATURE, INPUT, INPUTS, PRIORS, TEMPLATE, layout, load_prior, make_network
from kcgs.codec.labels.wavefront import new_work
from kcgs.data import save_labels

from . import train_prior
from .test_labels import shapes


def test_tables_have_the_format(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train_prior, "SHAPES", 3)  # maps beside those given
    labels = train_prior.shapes(np.random.default_rng(1))
    data = train_prior.pack(train_prior.train([labels], steps=3, seed=0, units=(8, 4)))
    assert len(data) == sum(np.dtype(kind).itemsize * int(np.prod(shape)) for kind, shape in layout(8, 4))


@pytest.mark.parametrize("name", PRIORS)
def test_the_network_is_the_one_that_codes(name: str) -> None:
    tables = [torch.from_numpy(table).float() for table in load_prior(name)[:-1]]
    parameters = [t / scale for t, (scale, _) in zip(tables, train_prior.limits(), strict=True)]
    parameters[0] = parameters[0].flatten(0, 1)
    features = torch.randint(3, (50, len(TEMPLATE)), generator=torch.Generator().manual_seed(0), dtype=torch.int8)
    rows = new_work(50, load_prior(name))[0]
    rows[:, FEATURE : FEATURE + len(TEMPLATE)] = features.numpy()
    network = make_network(load_prior(name)).py_func
    for row in rows:
        network(row)
    coded = torch.from_numpy(rows[:, INPUT : INPUT + 2 * INPUTS : INPUTS]) / 256
    assert (train_prior.network(features, parameters) - coded).abs().max() < 0.1


def test_compare_codes_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With the tables of files: no weights are other bytes, from whatever folder."""
    monkeypatch.chdir(tmp_path)
    labels = torch.from_numpy(shapes(0))
    save_labels("mask.png", labels)
    prior = Path(coding.__file__).with_name("prior2.bin").read_bytes()
    train_prior.compare(bytes(len(prior) - 16) + prior[-16:], [Path("mask.png")])
    _, present, other = capsys.readouterr().out.splitlines()[0].split()
    assert int(present) == len(encode_labels(labels)) < int(other)
