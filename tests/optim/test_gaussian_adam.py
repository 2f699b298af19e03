"""GaussianAdam: its steps, valid fields at any rate, torch's optimizer protocol, rows that come and go."""

from __future__ import annotations

import copy
import io
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from kcgs import GaussianField, RegionSplatRenderer, Scene
from kcgs.optim import GaussianAdam
from kcgs.optim.frame import widen

SIZE = (24, 36)


def image(channels: int = 3) -> Tensor:
    return torch.rand(channels, *SIZE, generator=torch.Generator().manual_seed(0))


def field_of(kind: str = "plain", num_gaussians: int = 20) -> GaussianField:
    """A random field: plain, in float64, with opacities and region ids, or of a batch of two."""
    field = GaussianField.random(num_gaussians, SIZE, seed=1)
    tensors = [field.means.detach(), field.cholesky.detach(), field.colors.detach()]
    if kind == "double":
        tensors = [tensor.double() for tensor in tensors]
    if kind == "batch":
        tensors = [torch.stack([tensor, 0.9 * tensor]) for tensor in tensors]
    if kind != "opacities":
        return GaussianField(*tensors, size=SIZE)
    ids = torch.arange(num_gaussians) % 2
    return GaussianField(*tensors, ids, torch.full((num_gaussians,), 0.7), size=SIZE)


def network_output() -> GaussianField:
    means, cholesky = torch.ones(5, 2, requires_grad=True), torch.tensor([[1.0, 0.0, 1.0]] * 5)
    return GaussianField(2 * means, cholesky, torch.ones(5, 3), size=SIZE)


def regions_of(kind: str) -> Tensor | None:
    return (torch.arange(SIZE[1]) > 17).long().expand(SIZE).contiguous() if kind == "opacities" else None


def descend(field: GaussianField, optimizer: GaussianAdam, steps: int, regions: Tensor | None = None) -> list[float]:
    """Descend on the squared error; return the losses."""
    renderer, losses = RegionSplatRenderer(), []
    for _ in range(steps):
        optimizer.zero_grad()
        loss = (renderer(field, regions) - image()).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    return losses


def tensors(field: GaussianField) -> list[Tensor]:
    return [parameter.detach() for parameter in field.parameters()]


def same(first: GaussianField, second: GaussianField) -> bool:
    return all(torch.equal(a, b) for a, b in zip(tensors(first), tensors(second), strict=True))


KINDS = ["plain", "double", "opacities", "batch"]


class TestStep:
    @pytest.mark.parametrize(("kind", "factor"), [("plain", 4.0), ("double", 1e6), ("opacities", 1e6), ("batch", 1e6)])
    def test_leaves_a_valid_field_at_any_rate(self, kind: str, factor: float) -> None:
        field = field_of(kind)
        descend(field, GaussianAdam(field, 0.14 * factor, color_lr=0.03 * min(factor, 4.0)), 30, regions_of(kind))
        GaussianField(field.means, field.cholesky, field.colors, field.region_ids, field.opacities, size=SIZE)
        l11, l21, l22 = field.cholesky.detach().double().unbind(-1)
        factors = torch.stack([l11, torch.zeros_like(l11), l21, l22], -1).unflatten(-1, (2, 2))
        sigma = torch.linalg.svdvals(factors)
        assert float(sigma.min()) >= 0.4999
        outside = torch.maximum(-field.means, field.means - torch.tensor([36.0, 24.0])).detach()
        assert float(outside.max()) <= 2 * float(sigma.max()) + 1e-3

    @pytest.mark.parametrize("kind", ["double", "batch"])
    def test_bounded(self, kind: str) -> None:
        """Rows that are added, too."""
        field = field_of(kind)
        optimizer = GaussianAdam(field, 1.0, color_lr=1.0, bounded=True)
        descend(field, optimizer, 30, regions_of(kind))
        added = field_of(kind)
        added.colors.data *= 9.0
        optimizer.append(field, added)
        assert ((field.means >= 0) & (field.means <= torch.tensor([36.0, 24.0]))).all()
        assert (field.cholesky.abs() <= 36).all() and ((field.colors >= -1) & (field.colors <= 2)).all()
        assert field.colors.max() == 2

    @pytest.mark.parametrize("kind", ["plain", "double"])
    def test_a_field_without_gradients_stays(self, kind: str) -> None:
        field = field_of(kind)
        before = copy.deepcopy(field)
        GaussianAdam(field).step()
        assert same(field, before)


class TestAlgorithm:
    def test_is_adam_of_the_steps_in_each_frame(self) -> None:
        """Against torch's Adam on the numbers of exp K and d, which begin at 0 in each step."""
        field, steps = field_of("double"), 5
        means, cholesky, colors = (tensor.clone() for tensor in tensors(field))
        numbers = torch.zeros(20, 5, dtype=torch.float64, requires_grad=True)
        tones = colors.clone().requires_grad_()
        settings: dict[str, Any] = {"betas": (0.9, 0.99), "eps": 1e-12}
        reference = torch.optim.Adam([{"params": [numbers], "lr": 0.14}, {"params": [tones], "lr": 0.03}], **settings)
        for _ in range(steps):
            reference.zero_grad()
            k = torch.zeros(20, 2, 2, dtype=torch.float64)
            k[:, 0, 0], k[:, 1, 0], k[:, 1, 1] = numbers[:, 2], numbers[:, 3], numbers[:, 4]
            matrix = torch.zeros_like(k)
            matrix[:, 0, 0], matrix[:, 1, 0], matrix[:, 1, 1] = cholesky.T
            factor = matrix @ torch.linalg.matrix_exp(k)
            places = means + (matrix @ numbers[:, :2, None])[..., 0]
            triangle = torch.stack([factor[:, 0, 0], factor[:, 1, 0], factor[:, 1, 1]], -1)
            rendered = RegionSplatRenderer()(GaussianField(places, triangle, tones * 1.0, size=SIZE))
            (rendered - image()).square().mean().backward()
            reference.step()
            with torch.no_grad():  # the step, applied
                d1, d2, k11, k21, k22 = numbers.detach().clone().unbind(-1)
                means = means + torch.stack([cholesky[:, 0] * d1, cholesky[:, 1] * d1 + cholesky[:, 2] * d2], -1)
                k = torch.zeros(20, 2, 2, dtype=torch.float64)
                k[:, 0, 0], k[:, 1, 0], k[:, 1, 1] = k11, k21, k22
                factor = matrix @ torch.linalg.matrix_exp(k)
                cholesky = widen(torch.stack([factor[:, 0, 0], factor[:, 1, 0], factor[:, 1, 1]], -1), 0.5)
                numbers.zero_()
        descend(field, GaussianAdam(field), steps)
        for value, expected in zip(tensors(field), (means, cholesky, tones.detach()), strict=True):
            torch.testing.assert_close(value, expected, rtol=1e-6, atol=1e-8)

    @pytest.mark.parametrize("kind", ["plain", "opacities", "batch", "strided", "bounded"])
    def test_compiled_loops_take_the_steps_of_torch_operations(self, kind: str) -> None:
        """In float32 and in float64, with the same gradients, of rows that are of two ages and reach the bounds."""
        field = field_of(kind if kind in KINDS else "plain")
        if kind == "strided":
            field.means = nn.Parameter(field.means.detach().mT.contiguous().mT)
        twin, generator = copy.deepcopy(field).double(), torch.Generator().manual_seed(2)
        optimizers = [GaussianAdam(each, 0.5, min_sigma=2.0, bounded=kind == "bounded") for each in (field, twin)]
        for step in range(6):
            if step == 3:
                for each, optimizer in zip((field, twin), optimizers, strict=True):
                    optimizer.append(each, copy.deepcopy(each))
            for parameter, other in zip(field.parameters(), twin.parameters(), strict=True):
                gradient = torch.randn(*parameter.shape, 2, generator=generator)[..., 0]
                parameter.grad, other.grad = gradient, gradient.double()
            version = field.means._version
            for optimizer in optimizers:
                optimizer.step()
            assert field.means._version > version  # autograd refuses a backward through an older render
        for value, expected in zip(tensors(field), tensors(twin), strict=True):
            torch.testing.assert_close(value, expected, rtol=1e-5, atol=2e-5, check_dtype=False)
        for state, reference in zip(*(optimizer.state.values() for optimizer in optimizers), strict=True):
            for name, expected in reference.items():
                torch.testing.assert_close(state[name], expected, rtol=1e-5, atol=1e-6, check_dtype=False)


class TestProtocol:
    def test_schedulers_and_groups(self) -> None:
        first, second = field_of(), field_of("opacities")
        optimizer = GaussianAdam([first, second], lr=0.1, color_lr=0.02)
        schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.5)
        assert [len(group["params"]) for group in optimizer.param_groups] == [2, 1, 2, 2]
        descend(first, optimizer, 1)
        schedule.step()
        assert [group["lr"] for group in optimizer.param_groups] == [0.05, 0.01] * 2

    def test_closure(self) -> None:
        field, twin = field_of(), field_of()
        optimizer = GaussianAdam(field)

        def closure() -> Tensor:
            optimizer.zero_grad()
            loss = (RegionSplatRenderer()(field) - image()).square().mean()
            loss.backward()
            return loss

        losses = [float(optimizer.step(closure).detach()) for _ in range(3)]
        assert losses == descend(twin, GaussianAdam(twin), 3) and same(field, twin)

    @pytest.mark.parametrize("kind", ["opacities", "batch"])
    def test_resumes_bit_for_bit_from_a_file(self, kind: str) -> None:
        field, regions = field_of(kind), regions_of(kind)
        optimizer = GaussianAdam(field, 0.2)
        descend(field, optimizer, 4, regions)
        torch.save((field.state_dict(), optimizer.state_dict()), file := io.BytesIO())
        file.seek(0)
        twin = field_of(kind)
        resumed = GaussianAdam(twin)
        for module, state in zip((twin, resumed), torch.load(file, weights_only=True), strict=True):
            module.load_state_dict(state)
        assert descend(field, optimizer, 4, regions) == descend(twin, resumed, 4, regions) and same(field, twin)

    @pytest.mark.parametrize(
        ("fields", "settings", "error", "words"),
        [
            ([torch.zeros(3)], {}, TypeError, "fields must be GaussianFields, such as scene.field; got Tensor"),
            (Scene(field_of()), {}, TypeError, "fields must be GaussianFields, such as scene.field; got Scene"),
            (network_output(), {}, ValueError, "fields must be of parameters; got a network's output"),
            ([], {}, ValueError, "empty parameter list"),
            (field_of(), {"lr": -1.0}, ValueError, "^lr must be finite and at least 0; got -1.0"),
            (field_of(), {"color_lr": torch.tensor(math.nan)}, ValueError, "color_lr must be .*; got nan"),
            (field_of(), {"betas": (0.9, 1.0)}, ValueError, r"betas must be two numbers in \[0, 1\); got \(0.9, 1.0\)"),
            (field_of(), {"eps": 0.0}, ValueError, "eps must be finite and above 0; got 0.0"),
            (field_of(), {"max_step": 0}, ValueError, "max_step must be finite and above 0; got 0"),
        ],
    )
    def test_bad_input(self, fields: Any, settings: dict[str, Any], error: type[Exception], words: str) -> None:
        with pytest.raises(error, match=words):
            GaussianAdam(fields, **settings)

    @pytest.mark.parametrize(("count", "channels"), [(7, 3), (20, 1)])
    def test_a_state_of_other_fields(self, count: int, channels: int) -> None:
        other = GaussianField.random(count, SIZE, channels=channels)
        optimizer = GaussianAdam(other)
        optimizer.freeze(other, torch.ones(count, dtype=torch.bool))
        with pytest.raises(ValueError, match=r"state_dict must be of {'age': \(20, 1\), 'average': .*; got {'age': "):
            GaussianAdam(field_of()).load_state_dict(optimizer.state_dict())

    def test_a_state_of_a_field_of_another_size(self) -> None:
        """The field keeps its own size, to which its centres are bound."""
        large = GaussianField.random(20, (240, 360))
        optimizer = GaussianAdam(field := field_of(), bounded=True)
        optimizer.load_state_dict(GaussianAdam(large, bounded=True).state_dict())
        field.means.data[-1] = 300.0
        descend(field, optimizer, 1)
        assert field.means[-1].tolist() == [SIZE[1], SIZE[0]]

    @pytest.mark.parametrize("name", ["means", "cholesky", "colors"])
    def test_a_frozen_parameter_stays(self, name: str) -> None:
        """Even one that is out of bounds: far outside, or thinner than `min_sigma`."""
        field = field_of()
        field.means.data[0] = -300.0
        frozen = getattr(field, name).requires_grad_(False)
        before = frozen.clone()
        descend(field, GaussianAdam(field, min_sigma=8.0), 3)
        assert torch.equal(frozen, before)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_a_colour_that_is_frozen_later_stays(self, dtype: torch.dtype) -> None:
        """The averages of its steps, and a gradient from before, move only what trains."""
        field = GaussianField.random(20, SIZE, seed=0, dtype=dtype)
        field.opacities = torch.nn.Parameter(torch.full((20,), 0.5, dtype=dtype))
        optimizer = GaussianAdam(field)
        descend(field, optimizer, 3)
        field.colors.requires_grad_(False)
        colors, opacities = field.colors.clone(), field.opacities.detach().clone()
        for _ in range(3):
            optimizer.step()
        assert torch.equal(field.colors, colors) and not torch.equal(field.opacities, opacities)

    def test_new_rows_are_as_wide_as_a_loaded_state_asks(self) -> None:
        field = field_of()
        optimizer = GaussianAdam(field)
        optimizer.load_state_dict(GaussianAdam(field_of(), min_sigma=2.0).state_dict())
        thin = GaussianField(torch.ones(1, 2), torch.tensor([[1.0, 0.0, 1.0]]), torch.ones(1, 3), size=SIZE)
        optimizer.append(field, thin)
        torch.testing.assert_close(field.cholesky.detach()[-1], torch.tensor([2.0, 0.0, 2.0]))


THREE, HALF = torch.ones(3, dtype=torch.bool), torch.arange(20) < torch.tensor([[10], [11]])


class TestBadRows:
    @pytest.mark.parametrize(
        ("kind", "change", "words"),
        [
            ("plain", lambda adam, field: adam.append(field_of(), field), "field must be one that .* made for; got an"),
            ("plain", lambda adam, _: adam.keep(field_of(), THREE), "field must be one that .* was made for"),
            ("plain", lambda adam, field: adam.keep(field, THREE), r"mask must be boolean, \(20,\); got torch.bool, "),
            ("plain", lambda adam, field: adam.keep(field, torch.ones(20)), r"mask must be boolean, .*; got torch.flo"),
            ("plain", lambda adam, field: adam.freeze(field, THREE), r"mask must be boolean, \(20,\); got torch.bool,"),
            ("batch", lambda adam, field: adam.keep(field, THREE), r"mask must be boolean, \(20,\) or \(2, 20\); got"),
            ("batch", lambda adam, field: adam.keep(field, HALF), r"as many Gaussians in each image; got \[10, 11\]"),
            ("opacities", lambda adam, field: adam.append(field, field_of()),
             r"added must have colors \(N, 3\) and region_ids and opacities; got colors \(N, 3\)"),
            ("plain", lambda adam, field: adam.append(field, GaussianField.random(2, SIZE, channels=1)), r"\(N, 1\)"),
            ("plain", lambda adam, field: adam.append(field, field_of("batch")), r"got colors \(2, N, 3\)"),
            ("plain", lambda adam, _: adam.add_param_group({"params": [torch.zeros(3, requires_grad=True)]}),
             "param_group must be a GaussianField's: train other parameters with"),
        ],
    )  # fmt: skip
    def test_leave_the_field(self, kind: str, change: Callable[[Any, Any], object], words: str) -> None:
        field = field_of(kind)
        with pytest.raises(ValueError, match=words):
            change(GaussianAdam(field), field)
        assert field.num_gaussians == 20


class TestRows:
    @pytest.mark.parametrize(("kind", "shift"), [("opacities", 0), ("batch", 0), ("batch", 1)])
    def test_keep_leaves_the_rows_and_averages_of_the_others(self, kind: str, shift: int) -> None:
        field, mask = field_of(kind), torch.arange(20) % 3 > 0
        if shift:
            mask = torch.stack([mask, mask.roll(shift)])
        optimizer, chosen = GaussianAdam(field), mask.expand(field.means.shape[:-1])

        def tables() -> list[Tensor]:
            averages = [table for state in optimizer.state.values() for table in state.values()]
            return [*tensors(field), *([] if field.region_ids is None else [field.region_ids]), *averages]

        descend(field, optimizer, 3, regions_of(kind))
        expected = [t[chosen].reshape(*chosen.shape[:-1], -1, *t.shape[chosen.ndim :]) for t in tables()]
        optimizer.keep(field, mask)
        assert all(torch.equal(*pair) for pair in zip(tables(), expected, strict=True))
        descend(field, optimizer, 1, regions_of(kind))

    @pytest.mark.parametrize("kind", ["opacities", "batch"])
    def test_append_starts_new_averages(self, kind: str) -> None:
        field, added = field_of(kind), field_of(kind, 5)
        optimizer = GaussianAdam(field)
        descend(field, optimizer, 3, regions_of(kind))
        before = copy.deepcopy(field)
        optimizer.append(field, added)
        assert field.num_gaussians == 25
        for value, old in zip((field.means, field.colors), (before.means, before.colors), strict=True):
            assert torch.equal(value[..., :20, :], old)
        assert torch.equal(field.colors[..., 20:, :], added.colors)
        for state in optimizer.state.values():
            assert all(bool((value[..., 20:, :] == 0).all()) for value in state.values())
            assert bool((state["age"][..., :20, :] == 3).all())
        losses = descend(field, optimizer, 10, regions_of(kind))
        assert losses[-1] < losses[0]
        assert all(parameter in {*field.parameters()} for g in optimizer.param_groups for parameter in g["params"])

    @pytest.mark.parametrize("kind", KINDS)
    def test_frozen_rows_stay_and_the_others_do_not_notice(self, kind: str) -> None:
        """Also after others are removed, whatever the gradients."""
        field, twin = field_of(kind), field_of(kind)
        optimizer, other = GaussianAdam(field), GaussianAdam(twin)
        mask = (torch.arange(20) % 7 == 0).expand(field.means.shape[:-1])
        optimizer.freeze(field, mask)
        before = [tensor.clone() for tensor in tensors(field)]
        stays = torch.arange(20) != 3
        for step in range(3):
            if step == 2:
                optimizer.keep(field, stays)
                other.keep(twin, stays)
            for parameter, of_twin in zip(field.parameters(), twin.parameters(), strict=True):
                generator = torch.Generator().manual_seed(step)
                parameter.grad = torch.randn(parameter.shape, generator=generator).to(parameter)
                of_twin.grad = parameter.grad.clone()
            optimizer.step()
            other.step()
        rows = mask[..., stays]
        assert torch.equal(optimizer.frozen_rows(field), rows)
        for value, expected, first in zip(tensors(field), tensors(twin), before, strict=True):
            assert torch.equal(value[~rows], expected[~rows])
            assert torch.equal(value[rows], first[mask]) and not torch.equal(value[rows], expected[rows])
