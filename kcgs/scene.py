"""Scene: Gaussians and the label map to render them with."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import kcgs
from kcgs._atomic import atomic_path
from kcgs._check import check_size
from kcgs._memory import check_memory
from kcgs._repr import png, shorten
from kcgs.errors import InvalidArgument, InvalidArgumentType
from kcgs.maps import RegionMap, as_region_map
from kcgs.nn import GaussianField, RegionSplatRenderer, rendered_size, used_rows

if TYPE_CHECKING:
    import onnx

# peak memory of a render that is saved: bytes per number of the image, measured
_IMAGE_BYTES = 12
# peak memory of resizing a label map: bytes per pixel, measured
_MAP_BYTES = 42
# pixels of the longer side of a scene's image in a notebook
_NOTEBOOK_SIDE = 1024

_RENDERER = RegionSplatRenderer()


class Scene(nn.Module):
    r"""Gaussians, the label map that confines them, and metadata.

    Convention: `to`, `state_dict`, `copy.deepcopy` and `pickle` keep the map and the metadata too.
    `load_state_dict` replaces the map and the metadata by those of the state.

    Args:
        field: N Gaussians, or a batch of them.
        regions: a RegionMap, or a label map, integer or bool, Tensor or numpy array, :math:`(H, W)` or
            :math:`(B, H, W)`, with hard contours, of the field's size; None: nothing is confined.
        metadata: notes of the user, str to str, which .safetensors files keep.

    Raises:
        TypeError, ValueError: an argument of the wrong type; no label map; a map of another size; a batch with another
            number of maps than images.

    Example:
        >>> labels = (torch.arange(48) >= 24).long().expand(32, 48)
        >>> scene = Scene(GaussianField.random(10, (32, 48), regions=labels, seed=0), labels)
        >>> scene.render().shape, scene.render(size=(64, 96)).shape
        (torch.Size([3, 32, 48]), torch.Size([3, 64, 96]))
    """

    def __init__(
        self,
        field: GaussianField,
        regions: RegionMap | Tensor | NDArray[Any] | None = None,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__()
        if not isinstance(field, GaussianField):
            raise InvalidArgumentType("field", "a GaussianField", type(field).__name__)
        self.field = field
        self.regions = _check_regions(field, as_region_map(regions))
        self.metadata = _check_metadata(metadata)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels of the image that the Gaussians refer to."""
        return self.field.size

    @property
    def num_images(self) -> int | None:
        """B of a batch; None: one image, without B."""
        return self.field.num_images

    @property
    def num_gaussians(self) -> int:
        """Number of Gaussians per image."""
        return self.field.num_gaussians

    def forward(self, size: tuple[int, int] | None = None) -> Tensor:
        """Render, differentiably and not clipped. :class:`kcgs.RegionSplatRenderer` has more settings.

        Args:
            size: (height, width); None: the scene's own.

        Returns:
            Image, :math:`(C, H, W)`, or :math:`(B, C, H, W)` for a batch.

        Raises:
            TypeError, ValueError: as :func:`kcgs.functional.region_splat`; a map without region ids.
        """
        image: Tensor = _RENDERER(self.field, self.regions, size)
        return image

    def render(self, size: tuple[int, int] | None = None) -> Tensor:
        """Render an image to show or save: as :meth:`forward`, but clipped to [0, 1] and without a graph.

        On the CPU, a size that needs more memory than is free is a ValueError, which says how much.
        """
        check_render_memory(self, size)
        with torch.no_grad():
            image: Tensor = self(size)
            return image.clamp(0.0, 1.0)

    def __len__(self) -> int:
        """Return the number of images of a batch; TypeError for a scene of one image."""
        if self.num_images is None:
            raise TypeError("a scene of one image has no len; num_gaussians is the number of its Gaussians")
        return self.num_images

    def __bool__(self) -> bool:
        return True

    def __getitem__(self, index: int | slice) -> Scene:
        """Copy one image of a batch, or a slice of the batch, without the graph.

        Raises:
            TypeError: a scene of one image, or an index that is neither an integer nor a slice.
            IndexError: there is no such image.

        Example:
            >>> means, cholesky, colors = torch.rand(4, 9, 2), torch.ones(4, 9, 3), torch.rand(4, 9, 3)
            >>> batch = Scene(GaussianField(means, cholesky, colors, size=(8, 8)))
            >>> len(batch), batch[2]().shape, [scene.num_gaussians for scene in batch[:2]]
            (4, torch.Size([3, 8, 8]), [9, 9])
        """
        rows = range(len(self))[index]
        regions = self.regions
        if regions is not None and regions.num_maps is not None:
            shared = regions.num_maps == 1
            regions = regions[0 if shared else index] if isinstance(rows, int) or not shared else regions
        return Scene(self.field[index], regions, self.metadata)

    def __iter__(self) -> Iterator[Scene]:
        return (self[k] for k in range(len(self)))

    def save(self, path: str | os.PathLike[str], **options: Any) -> int:
        """Write the scene, with the keywords of :func:`kcgs.save`; return the bytes of the file."""
        return kcgs.save(path, self, **options)

    def to_onnx(self, path: str | os.PathLike[str], **options: Any) -> onnx.ModelProto:
        """Write the ONNX graph that renders the scene at any size, as Kornia's modules do, and return it.

        Args:
            path: ends in .onnx; its folder must exist.
            options: those of :func:`kcgs.onnx.scene_decoder`.

        Raises:
            TypeError, ValueError: another suffix; as :func:`kcgs.onnx.scene_decoder`.
            FileNotFoundError: the folder does not exist.

        Example:
            >>> import tempfile
            >>> scene = Scene(GaussianField.random(10, (32, 48), seed=0))
            >>> with tempfile.TemporaryDirectory() as folder:
            ...     model = scene.to_onnx(f"{folder}/decoder.onnx", clamp=False)
            >>> [node.name for node in model.graph.output]
            ['image']
        """
        path = Path(path)
        if path.suffix != ".onnx":
            raise ValueError(f"path must end in .onnx; got {str(path)!r}")
        model: onnx.ModelProto = kcgs.onnx.scene_decoder(self, **options)
        with atomic_path(path) as temporary:
            temporary.write_bytes(model.SerializeToString())
        return model

    def __repr__(self) -> str:
        regions = "no regions" if self.regions is None else f"{self.regions.num_regions} regions"
        if count := len(empty_regions(self)):
            regions += f", {count} of them without a Gaussian"
        metadata = f", metadata={self.metadata}" if self.metadata else ""
        return shorten(f"Scene({self.field.extra_repr()}, {regions}{metadata})")

    def _repr_png_(self) -> bytes | None:
        if self.num_images is not None:
            return None
        factor = min(1.0, _NOTEBOOK_SIDE / max(self.size))
        return png(self.render((max(1, round(self.size[0] * factor)), max(1, round(self.size[1] * factor)))))

    def get_extra_state(self) -> dict[str, Any]:
        """Return map and metadata, for `state_dict`."""
        return {"regions": None if self.regions is None else self.regions.state(), "metadata": self.metadata}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Set map and metadata, from `load_state_dict`."""
        regions = state["regions"]
        self.regions = None if regions is None else RegionMap.from_state(regions)
        # a field on the device "meta" gets its tensors, and their device, later
        if self.regions is not None and not self.field.means.is_meta:
            self.regions = self.regions.to(self.field.means.device)
        self.metadata = _check_metadata(state["metadata"])

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Scene:
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        if self.regions is not None:
            self.regions = self.regions.to(self.field.means.device)
        return self


def empty_regions(scene: Scene) -> Tensor:
    """Return the ids of regions without a Gaussian, which are black."""
    regions, ids = scene.regions, scene.field.region_ids
    if regions is None or ids is None or ids.is_meta:
        return torch.empty(0, dtype=torch.int64)
    return regions.ids[~torch.isin(regions.ids, ids[used_rows(scene.field.merged_colors())])]


def check_type(scene: object, name: str = "scene") -> Scene:
    """Return `scene` if it is a Scene, of one image or a batch."""
    if not isinstance(scene, Scene):
        raise InvalidArgumentType(name, "a Scene", type(scene).__name__)
    return scene


def check_unbatched(scene: object, name: str = "scene") -> Scene:
    """Return `scene` if it is a Scene of one image."""
    scene = check_type(scene, name)
    if scene.num_images is not None:
        raise InvalidArgument(name, "of one image", f"a batch of {scene.num_images}: scene[t] is one of them")
    return scene


def check_batch(scenes: object) -> Scene:
    """Return `scenes` if it is a batch of scenes."""
    if not isinstance(scenes, Scene) or scenes.num_images is None:
        received = "a scene of one image" if isinstance(scenes, Scene) else type(scenes).__name__
        raise InvalidArgumentType("scenes", "a batch of scenes", received)
    return scenes


def check_scene(scene: object, name: str = "scene") -> Scene:
    """Return `scene` if it is a Scene of one image, with one map and region ids, or without a map."""
    scene = check_unbatched(scene, name)
    field, regions = scene.field, scene.regions
    _check_regions(field, regions)  # checked again, since either attribute may have been assigned
    if regions is not None and regions.num_maps is not None:
        raise InvalidArgument(name, "one map", f"a batch of {regions.num_maps}", verb="have")
    if regions is not None and field.region_ids is None:
        raise ValueError(f"{name} must have region ids for its map; call {name}.field.assign_regions({name}.regions)")
    return scene


def check_render_memory(scene: Scene, size: tuple[int, int] | None) -> None:
    """Raise ValueError if a render at a size (height, width) does not fit into the memory of the CPU."""
    field = scene.field
    if field.means.device.type == "cpu":
        numbers = field.colors.shape[-1] * field.means.shape[:-2].numel()
        per_pixel = max(_IMAGE_BYTES * numbers, 4 * numbers + (0 if scene.regions is None else _MAP_BYTES))
        target = scene.size if size is None else check_size("size", size)
        check_memory("size", rendered_size(scene.size, target), per_pixel)


def _check_regions(field: GaussianField, regions: RegionMap | None) -> RegionMap | None:
    if regions is None:
        return None
    if regions.size != field.size:
        raise InvalidArgument("regions", f"the size {field.size} of the field", regions.size, verb="have")
    images = field.num_images or 1
    if regions.num_maps not in (None, 1, images):
        raise InvalidArgument(
            "regions", f"1 map or one for each of {images} images", f"{regions.num_maps} maps", verb="hold"
        )
    return regions


def _check_metadata(metadata: object) -> dict[str, str]:
    if metadata is not None and not isinstance(metadata, Mapping):
        raise TypeError(f"metadata must map str to str; got {type(metadata).__name__}")
    for key, value in (metadata or {}).items():
        if not isinstance(key, str) or not isinstance(value, str):
            raise TypeError(f"metadata must map str to str; got {key!r}: {value!r}")
    return dict(metadata or {})
