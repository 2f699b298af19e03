"""What `to_onnx` of a scene and of the renderer export, by Kornia's mixin; imported on use, as Kornia is."""

from __future__ import annotations

from typing import Any, ClassVar

import onnx
import torch
from kornia.core.mixin.onnx import ONNXExportMixin
from torch import Tensor, nn

from kcgs.functional import region_splat


class SceneExport(nn.Module, ONNXExportMixin):
    """The render of a scene at its own size, (B, C, H, W): a graph without inputs."""

    ONNX_DEFAULT_INPUTSHAPE: ClassVar[list[int]] = []
    ONNX_EXPORT_PSEUDO_SHAPE: ClassVar[list[int]] = []
    INPUTS: ClassVar[list[str]] = []

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self) -> Tensor:
        """Render."""
        image: Tensor = self.module()
        return image if image.ndim == 4 else image[None]

    def to_onnx(  # type: ignore[override]
        self, onnx_name: str, *, save: bool = True, **settings: Any
    ) -> onnx.ModelProto:
        """Export, by the mixin's arguments."""
        try:
            import onnxscript  # noqa: F401
        except ImportError as error:
            raise ImportError('to_onnx needs the package onnxscript: pip install "kcgs[onnx]"') from error
        settings = {"input_names": self.INPUTS, "verbose": False, **settings}
        model: onnx.ModelProto = super().to_onnx(onnx_name, save=False, **settings)
        # ONNXSequential gives constants new names, but not where loops read them; it does so with results of nodes
        nodes = [onnx.helper.make_node("Constant", [], [v.name], value=v) for v in model.graph.initializer]
        nodes.extend(model.graph.node)
        for field, values in (("initializer", []), ("node", nodes)):
            model.graph.ClearField(field)
            getattr(model.graph, field).extend(values)
        if save:
            onnx.save(model, onnx_name)
        return model

    def _create_dummy_input(self, input_shape: list[int], pseudo_shape: Any = None) -> tuple[Tensor, ...]:
        return ()

    def _create_dynamic_shapes(self, input_shape: list[int], dummy_input: Any) -> tuple[dict[int, str], ...]:
        return ()


class RendererExport(SceneExport):
    """Any batch of Gaussians in any label maps; the shapes that `to_onnx` takes are those of the image."""

    ONNX_DEFAULT_INPUTSHAPE: ClassVar[list[int]] = [-1, 3, -1, -1]
    ONNX_EXPORT_PSEUDO_SHAPE: ClassVar[list[int]] = [2, 3, 24, 40]
    INPUTS: ClassVar[list[str]] = ["means", "cholesky", "colors", "region_ids", "labels"]

    def forward(  # type: ignore[override]
        self, means: Tensor, cholesky: Tensor, colors: Tensor, region_ids: Tensor, labels: Tensor
    ) -> Tensor:
        """Render."""
        image = region_splat(means, cholesky, colors, region_ids, labels, cutoff=self.module.cutoff)  # type: ignore[arg-type]
        return image.clamp(0.0, 1.0) if self.module.clamp else image

    def _create_dummy_input(self, input_shape: list[int], pseudo_shape: Any = None) -> tuple[Tensor, ...]:
        shapes = zip(input_shape, pseudo_shape or self.ONNX_EXPORT_PSEUDO_SHAPE, strict=True)
        batch, channels, height, width = (guess if side == -1 else side for side, guess in shapes)
        factors = torch.tensor([1.0, 0.0, 1.0]).repeat(batch, 2, 1)
        ids, labels = torch.zeros(batch, 2, dtype=torch.int64), torch.zeros(batch, height, width, dtype=torch.int64)
        return torch.rand(batch, 2, 2), factors, torch.rand(batch, 2, channels), ids, labels

    def _create_dynamic_shapes(self, input_shape: list[int], dummy_input: Any) -> tuple[dict[int, str], ...]:
        batch, channels, height, width = ({} if n != -1 else {k: f"dim_{k}"} for k, n in enumerate(input_shape))
        rows = {**batch, 1: "N"}
        labels = {**batch, **{k - 1: name for k, name in {**height, **width}.items()}}
        return rows, rows, {**rows, **({2: "dim_1"} if channels else {})}, rows, labels
