"""Scene as a module: it renders, moves, copies and keeps its map."""

from __future__ import annotations

import copy
import io
import pickle
from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader

from kcgs import GaussianField, RegionMap, RegionSplatRenderer, Scene, evaluate, load, save
from tests.tester import BaseTester

SIZE = (20, 30)
MAPS = {
    "none": None,
    "hard": RegionMap.from_labels((torch.arange(30) // 11).expand(SIZE)),
    "soft": RegionMap.from_labels((torch.arange(30) // 11).expand(SIZE), 0.8),
    "pairs": RegionMap.from_labels((torch.arange(30) // 11).expand(SIZE), {(0, 1): 0.5, (1, 2): 1.5}),
    "resized": RegionMap.from_labels((torch.arange(60) // 23).expand(40, 60), 1.0).resize(SIZE),
}


def batch_of(one: RegionMap) -> RegionMap:
    """Make a batch of three maps, the last of one region."""
    if one._source is not None:
        return batch_of(one._source).resize(one.size)
    labels = torch.stack([one.labels, one.labels.flip(-1), torch.ones_like(one.labels)])
    return RegionMap.from_labels(labels, one.softness)


def make_scene(name: str = "soft") -> Scene:
    regions = MAPS[name]
    field = GaussianField.random(40, SIZE, regions=regions, seed=0)
    return Scene(field, regions, {"title": name})


@pytest.mark.parametrize("name", MAPS)
class TestKeepsItsMap:
    @pytest.mark.parametrize("rendered", [False, True])
    def test_deepcopy_and_pickle(self, name: str, rendered: bool, monkeypatch: pytest.MonkeyPatch) -> None:
        """The copies render alike, with gradients of their own, and make nothing of the map anew."""
        scene = make_scene(name)
        if rendered:
            scene().sum().backward()
        others = copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))
        image = scene()
        monkeypatch.setattr(RegionMap, "from_labels", None)
        for other in others:
            assert torch.equal(other(), image) and other.metadata == {"title": name}
            other().square().sum().backward()
            assert other.field.colors.grad.any() and (scene.field.colors.grad is None) == (not rendered)

    def test_state_dict(self, name: str) -> None:
        scene = make_scene(name)
        file = io.BytesIO()
        torch.save(scene.state_dict(), file)
        file.seek(0)
        other = Scene(GaussianField.random(40, SIZE, seed=1))
        other.load_state_dict(torch.load(file, weights_only=True))
        assert torch.equal(other(), scene()) and other.metadata == {"title": name}
        assert (other.regions is None) == (name == "none")

    def test_state_dict_within_a_module(self, name: str) -> None:
        """As a part of another module, through a copy of every tensor, over a scene with a map of its own."""
        whole, other = (
            torch.nn.ModuleDict({"scene": make_scene(n)}) for n in (name, "none" if name == "none" else "hard")
        )
        state = {k: v.clone() if isinstance(v, torch.Tensor) else v for k, v in whole.state_dict().items()}
        other.load_state_dict(state)
        assert torch.equal(other["scene"](), whole["scene"]())
        assert (other["scene"].regions is None) == (name == "none")

    @pytest.mark.parametrize("other", ["none", "hard"])
    def test_state_dict_of_a_scene_of_another_size_and_map(self, name: str, other: str) -> None:
        """Ids, map, size and notes are the state's, or none, where it has none; strictly, and by weights only."""
        scene, file = make_scene(name), io.BytesIO()
        torch.save(scene.state_dict(), file)
        file.seek(0)
        small = torch.eye(9).long()
        field = GaussianField.random(40, (9, 9), regions=None if other == "none" else small, seed=1)
        loaded = Scene(field, None if other == "none" else small, {"title": "small", "by": "test"})
        assert loaded().shape == (3, 9, 9)
        loaded.load_state_dict(torch.load(file, weights_only=True))
        assert torch.equal(loaded(), scene()) and loaded.size == SIZE and loaded.metadata == {"title": name}
        assert (loaded.regions is None) == (loaded.field.region_ids is None) == (name == "none")

    def test_state_dict_assigned_to_a_scene_without_memory(self, name: str) -> None:
        scene = make_scene(name)
        with torch.device("meta"):
            empty = Scene(GaussianField.random(40, SIZE))
        empty.load_state_dict(scene.state_dict(), assign=True)
        assert torch.equal(empty(), scene())

    def test_safetensors(self, name: str, tmp_path: Path) -> None:
        if name == "resized":
            pytest.skip("a file keeps the labels of the new size, which are another map")
        scene = make_scene(name)
        assert scene.save(tmp_path / "scene.safetensors") == (tmp_path / "scene.safetensors").stat().st_size
        assert torch.equal(load(tmp_path / "scene.safetensors")(), scene())


def as_they_are(scenes: list[Scene]) -> list[Scene]:
    return scenes


class TestProcesses:
    """What torch sends between processes."""

    @pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")
    @pytest.mark.parametrize("start", ["fork", "spawn"])
    def test_items_of_a_data_loader(self, start: str) -> None:
        """Scenes with their maps, from two workers; they are rendered before, and render alike on both sides."""
        scenes = [make_scene(name) for name in MAPS]
        images = [scene().detach() for scene in scenes]
        loader = DataLoader(scenes, 2, num_workers=2, collate_fn=as_they_are, multiprocessing_context=start)  # type: ignore[arg-type]
        got = [scene for batch in loader for scene in batch]
        for scene, sent, image in zip(got, scenes, images, strict=True):
            assert torch.equal(scene(), image) and torch.equal(sent(), image) and scene.metadata == sent.metadata
            scene().sum().backward()
            assert scene.field.means.grad is not None and scene.field.means.grad.any()


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
        assert scene.num_gaussians == 5 and scene.size == SIZE and (not lead or len(scene) == lead[0])

    def test_feature(self, device: torch.device, dtype: torch.dtype) -> None:
        """Within a hard contour is what the Gaussians of the region render without a map."""
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

        def draw(*tensors: torch.Tensor) -> torch.Tensor:
            image: torch.Tensor = torch.func.functional_call(scene, dict(zip(names, tensors, strict=True)), ())
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

    def test_label_tensor_means_hard_contours(self) -> None:
        labels = (torch.arange(30) // 11).expand(SIZE)
        regions = Scene(make_scene("hard").field, labels).regions
        assert regions is not None and regions.softness == 0.0

    def test_masks_and_arrays_mean_them_too(self) -> None:
        mask = (torch.arange(30) >= 11).expand(SIZE)
        want = Scene(GaussianField.random(40, SIZE, regions=mask, seed=0), mask)()
        for labels in (mask.long(), mask.numpy(), mask.numpy().astype("uint8")):
            assert torch.equal(Scene(GaussianField.random(40, SIZE, regions=labels, seed=0), labels)(), want)

    @pytest.mark.parametrize("name", MAPS)
    def test_a_batch_says_so_and_comes_apart(self, name: str) -> None:
        """Each image has its own map, with regions that others lack, but for "none" and one map for all."""
        one = MAPS[name]
        maps = one if one is None or name == "hard" else batch_of(one)
        parts = [GaussianField.random(40, SIZE, regions=one, seed=seed) for seed in range(3)]
        tensors = (torch.stack([getattr(f, t).detach() for f in parts]) for t in ("means", "cholesky", "colors"))
        field = GaussianField(*tensors, size=SIZE)
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

    def test_repr_is_a_few_lines(self) -> None:
        assert "3 regions" in repr(make_scene()) and len(repr(make_scene()).splitlines()) <= 4
        assert make_scene().num_gaussians == 40 and make_scene().size == SIZE

    def test_exception(self) -> None:
        field = GaussianField.random(3, SIZE, seed=0)
        with pytest.raises(TypeError, match="field must be a GaussianField; got Scene"):
            Scene(Scene(field))  # type: ignore[arg-type]
        with pytest.raises(TypeError, match="regions must be a RegionMap, a label map or None; got str"):
            Scene(field, "map.png")  # type: ignore[arg-type]
        with pytest.raises(TypeError, match="metadata must map str to str; got 'n': 3"):
            Scene(field, metadata={"n": 3})  # type: ignore[dict-item]


class TestFiles:
    def test_kcgs(self, tmp_path: Path) -> None:
        path = tmp_path / "photo.kcgs"
        size = save(path, make_scene("hard"))
        assert size == path.stat().st_size < make_scene("hard").save(tmp_path / "scene.safetensors")
        assert load(path).num_gaussians <= 40 and load(path).regions is not None

    def test_errors_name_the_path_given(self) -> None:
        for name in ("nofile", "nofile.kcgs"):
            with pytest.raises(FileNotFoundError, match=f"^no such file: {name}$"):
                load(name)
        with pytest.raises(OSError, match="/proc/foo.safetensors"):
            save("/proc/foo.safetensors", make_scene())

    def test_cut_file_is_refused_with_its_name(self, tmp_path: Path) -> None:
        path = tmp_path / "photo.kcgs"
        save(path, make_scene("hard"))
        path.write_bytes(path.read_bytes()[:-3])
        with pytest.raises(ValueError, match=rf"cannot load {path}: .*ends early"):
            load(path)


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ((16, 8), r"regions must have the size \(8, 8\) of the field; got \(16, 8\)"),
        ((2, 8, 8), "regions must hold 1 map or one for each of 3 images; got 2 maps"),
    ],
)
def test_a_map_that_does_not_fit_is_refused(shape: tuple[int, ...], words: str) -> None:
    field = GaussianField(torch.rand(3, 4, 2), torch.ones(3, 4, 3), torch.rand(3, 4, 3), size=(8, 8))
    with pytest.raises(ValueError, match=words):
        Scene(field, torch.zeros(shape).long())
