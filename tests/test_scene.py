"""Scene as a module: it renders, moves, copies and keeps its map."""

from __future__ import annotations

import copy
import io
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene, evaluate, load, save
from tests.tester import BaseTester

SIZE = (20, 30)
MAPS = {
    "none": None,
    "hard": RegionMap((torch.arange(30) // 11).expand(SIZE)),
    "soft": RegionMap((torch.arange(30) // 11).expand(SIZE), 0.8),
    "pairs": RegionMap((torch.arange(30) // 11).expand(SIZE), {(0, 1): 0.5, (1, 2): 1.5}),
    "resized": RegionMap((torch.arange(60) // 23).expand(40, 60), 1.0).resize(SIZE),
}


def batch_of(one: RegionMap) -> RegionMap:
    """Make a batch of three maps, the last of one region."""
    if one._source is not None:
        return batch_of(one._source).resize(one.size)
    labels = torch.stack([one.labels, one.labels.flip(-1), torch.ones_like(one.labels)])
    return RegionMap(labels, one.softness)


def make_field(regions: RegionMap | None = None) -> GaussianField:
    return GaussianField.random(40, SIZE, regions=regions, seed=0)


def make_scene(name: str = "soft") -> Scene:
    return Scene(make_field(MAPS[name]), MAPS[name], {"title": name})


def state_of(scene: torch.nn.Module) -> dict[str, Any]:
    """Send a state through a file that holds tensors and plain values only."""
    torch.save(scene.state_dict(), file := io.BytesIO())
    file.seek(0)
    state: dict[str, Any] = torch.load(file, weights_only=True)
    return state


@pytest.mark.parametrize("name", MAPS)
class TestCopies:
    """Copies of a scene keep the map and the notes."""

    def test_deepcopy_and_pickle(self, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        """The copies render alike, with gradients of their own, and make nothing of the map anew."""
        scene = make_scene(name)
        scene().sum().backward()
        copies = copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))
        image = scene()
        monkeypatch.setattr(RegionMap, "__init__", None)
        for other in copies:
            assert torch.equal(other(), image) and other.metadata == {"title": name}
            other().square().sum().backward()
            assert not torch.equal(other.field.colors.grad, scene.field.colors.grad)

    @pytest.mark.parametrize("labels", [None, torch.eye(9).long()])
    def test_state_dict(self, name: str, labels: Tensor | None) -> None:
        """Size, ids, map and notes of a scene of another size, with or without a map, become those of the state."""
        scene = make_scene(name)
        field = GaussianField.random(40, (9, 9), regions=labels, seed=1)
        other = torch.nn.ModuleDict({"scene": Scene(field, labels, {"title": "small", "by": "test"})})
        assert other["scene"]().shape == (3, 9, 9)
        other.load_state_dict(state_of(torch.nn.ModuleDict({"scene": scene})))
        loaded = other["scene"]
        assert torch.equal(loaded(), scene()) and loaded.size == SIZE and loaded.metadata == {"title": name}
        assert (loaded.regions is None) == (loaded.field.region_ids is None) == (name == "none")
        with torch.device("meta"):
            empty = Scene(GaussianField.random(40, SIZE))
        empty.load_state_dict(scene.state_dict(), assign=True)
        assert torch.equal(empty(), scene())


def scene_on(device: torch.device, dtype: torch.dtype, name: str = "soft") -> Scene:
    """Make a scene of a dtype that a field may have."""
    return make_scene(name).to(device, torch.promote_types(dtype, torch.float32))


class TestScene(BaseTester):
    @pytest.mark.parametrize("name", MAPS)
    def test_smoke(self, device: torch.device, dtype: torch.dtype, name: str) -> None:
        scene = scene_on(device, dtype, name)
        image = scene()
        assert image.dtype == scene.field.colors.dtype and image.device.type == device.type
        assert image.isfinite().all() and image.any()

    @pytest.mark.parametrize("size", [None, (10, 50)])
    @pytest.mark.parametrize("lead", [(), (1,), (2,)])
    def test_cardinality(self, device: torch.device, lead: tuple[int, ...], size: tuple[int, int] | None) -> None:
        tensors = [torch.ones(*lead, 5, n, device=device) for n in (2, 3, 4)]
        scene = Scene(GaussianField(*tensors, size=SIZE), metadata={"title": "ones"})
        assert scene(size).shape == scene.render(size).shape == (*lead, 4, *(size or SIZE)) and scene(size).any()
        assert scene.num_gaussians == 5 and scene.size == SIZE and scene.num_images == (lead[0] if lead else None)

    def test_feature(self, device: torch.device, dtype: torch.dtype) -> None:
        """Within a hard contour, a scene is what the Gaussians of the region render without a map."""
        scene = scene_on(device, dtype, "hard")
        regions, ids = scene.regions, scene.field.region_ids
        assert regions is not None and ids is not None
        for region in regions.ids:
            part = scene.field.subset(ids == region)
            part.region_ids = None
            inside = regions.labels == region
            self.assert_close(scene()[:, inside], Scene(part)()[:, inside])

    def test_gradcheck(self, device: torch.device) -> None:
        scene = scene_on(device, torch.float64)
        scene = Scene(scene.field.subset(torch.arange(4, device=device)), scene.regions)
        names = [name for name, _ in scene.named_parameters()]

        def draw(*tensors: Tensor) -> Tensor:
            image: Tensor = torch.func.functional_call(scene, dict(zip(names, tensors, strict=True)), ())
            return image

        self.gradcheck(draw, list(scene.parameters()))

    @pytest.mark.parametrize("name", ["none", "hard", "resized"])
    def test_dynamo(self, device: torch.device, dtype: torch.dtype, name: str) -> None:
        compiler = "inductor" if name == "hard" else "eager"
        self.assert_compiles(scene_on(device, dtype, name), backend=compiler, rtol=1e-4, atol=1e-5)

    def test_module(self) -> None:
        """It renders as the renderer does, and its parameters take gradients."""
        scene = make_scene()
        assert torch.equal(scene(), RegionSplatRenderer()(scene.field, scene.regions))
        assert torch.equal(scene((40, 60)), RegionSplatRenderer()(scene, size=(40, 60)))
        scene().sum().backward()
        assert scene.field.colors.grad is not None and bool(scene.field.colors.grad.any())

    def test_render_is_clipped_without_a_graph(self) -> None:
        scene = make_scene()
        with torch.no_grad():
            scene.field.colors.mul_(50.0)
        image = scene.render()
        assert not image.requires_grad and 0.0 <= float(image.min()) and float(image.max()) == 1.0

    @pytest.mark.parametrize(("name", "needed"), [("none", "1.2"), ("soft", "1.8")])
    def test_renders_that_do_not_fit(self, monkeypatch: pytest.MonkeyPatch, name: str, needed: str) -> None:
        monkeypatch.setattr("kcgs._memory.free_memory", lambda: 1e9)
        with pytest.raises(ValueError, match=f"size asks for 8192 x 4096 pixels, which need about {needed} GB of mem"):
            make_scene(name).render(size=(4096, 8192))

    def test_to_moves_the_map(self) -> None:
        scene = make_scene().to("meta")
        assert scene.regions is not None and scene.regions.labels.device.type == "meta"
        assert make_scene().double().field.means.dtype == torch.float64

    def test_labels_are_a_map_with_hard_contours(self) -> None:
        mask = (torch.arange(30) >= 11).expand(SIZE)
        expected = Scene(GaussianField.random(40, SIZE, regions=mask, seed=0), RegionMap(mask))()
        for labels in (mask, mask.long(), mask.numpy(), mask.numpy().astype("uint8")):
            assert torch.equal(Scene(GaussianField.random(40, SIZE, regions=labels, seed=0), labels)(), expected)

    @pytest.mark.parametrize("name", MAPS)
    def test_batch(self, name: str) -> None:
        """Each image has its own map, with regions that others lack, but for "none" and one map for all."""
        one = MAPS[name]
        maps = one if one is None or name == "hard" else batch_of(one)
        parts = [GaussianField.random(40, SIZE, regions=one, seed=seed) for seed in range(3)]
        field = GaussianField.stack(parts)
        batch = Scene(field if maps is None else field.assign_regions(maps), maps, {"title": name})
        assert repr(batch).startswith("Scene(3 x 40 Gaussians, 3 channels, ")
        scenes = tuple(batch)
        assert torch.equal(torch.stack([scene() for scene in scenes]), batch())
        assert len(batch) == 3 and scenes[2].metadata == {"title": name}
        assert torch.equal(batch[1:](), batch()[1:]) and torch.equal(batch[-1](), batch()[2])
        with pytest.raises(TypeError, match="a scene of one image has no len; num_gaussians is"):
            len(scenes[0])
        with pytest.raises(IndexError):
            batch[3]
        with pytest.raises(ValueError, match=r"must be of one image; got a batch of 3: scene\[t\] is one of them"):
            evaluate(batch, torch.rand(3, 3, *SIZE))

    @pytest.mark.parametrize(
        ("arguments", "error", "message"),
        [
            ((make_scene("none"),), TypeError, "field must be a GaussianField; got Scene"),
            ((make_field(), 3), TypeError, "regions must be a RegionMap, a label map or None; got int"),
            ((make_field(), None, {"n": 3}), TypeError, "metadata must map str to str; got 'n': 3"),
            (
                (make_field(), torch.zeros(30, 20).long()),
                ValueError,
                r"the size \(20, 30\) of the field; got \(30,",
            ),
            ((make_field(), torch.zeros(2, *SIZE).long()), ValueError, "hold 1 map or one for each of 1 images; got 2"),
        ],
    )
    def test_exception(self, arguments: tuple[Any, ...], error: type[Exception], message: str) -> None:
        with pytest.raises(error, match=message):
            Scene(*arguments)


class TestFiles:
    def test_kcgs(self, tmp_path: Path) -> None:
        path, scene = tmp_path / "photo.kcgs", make_scene("hard")
        assert save(path, scene) == path.stat().st_size < scene.save(tmp_path / "scene.safetensors")
        assert load(path).num_gaussians <= 40 and load(path).regions is not None
        path.write_bytes(path.read_bytes()[:-3])
        with pytest.raises(ValueError, match=rf"cannot load {path}: .*ends early"):
            load(path)

    def test_errors_name_the_path_of_the_caller(self) -> None:
        with pytest.raises(OSError, match="/proc/foo.safetensors"):
            save("/proc/foo.safetensors", make_scene())
