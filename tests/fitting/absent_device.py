"""A device that is not there: its tensors say that they are on `meta`, and the CPU computes them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = torch.device("meta")
# operations that the host waits for, since the shape of a result depends on values
WAITING = {
    "_local_scalar_dense", "_unique2", "equal", "nonzero", "repeat_interleave", "unique_consecutive", "unique_dim",
}  # fmt: skip
# operations that CUDA sums in an order left to chance, where they are given floating numbers
UNORDERED = {
    "bincount", "cumprod", "cumsum", "embedding_dense_backward", "grid_sampler_2d_backward", "histc", "index_add",
    "index_add_", "index_reduce", "index_reduce_", "kthvalue", "logcumsumexp", "max_pool2d_with_indices_backward",
    "median", "put", "put_", "reflection_pad2d_backward", "replication_pad2d_backward", "scatter_add", "scatter_add_",
    "scatter_reduce", "scatter_reduce_", "upsample_bicubic2d_backward", "upsample_bilinear2d_backward",
}  # fmt: skip


class DeviceTensor(Tensor):
    """A tensor of the device."""

    content: Tensor

    @staticmethod
    def __new__(cls, content: Tensor) -> DeviceTensor:
        tensor: DeviceTensor = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            cls, content.shape, strides=content.stride(), dtype=content.dtype, device=DEVICE
        )
        tensor.content = content
        return tensor

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError("a tensor of the device is used outside of AbsentDevice.use")


class AbsentDevice:
    """The device, which counts its operations, and times that the host waits for one."""

    def __init__(self) -> None:
        self.num_operations = 0
        self.num_waits = 0
        self.unordered: set[str] = set()

    @contextmanager
    def use(self) -> Iterator[None]:
        """Use the device in place of torch's."""
        with _Functions(self), _Operations(self):
            yield

    def run(self, function: Any, args: Any, kwargs: Any) -> Any:
        """Do an operation of the device, or of the host."""
        name, values = function.overloadpacket.__name__, tree_leaves((args, kwargs))
        operands = [value for value in values if isinstance(value, DeviceTensor)]
        target = None if kwargs.get("device") is None else torch.device(kwargs["device"])
        is_result_here = bool(operands) if target is None else target == DEVICE
        if operands or is_result_here:
            self._count(name, args, operands, is_read=not is_result_here)
            others = [v for v in values if isinstance(v, Tensor) and not isinstance(v, DeviceTensor) and v.ndim]
            # copies go from one device to another, and places to read or write may be anywhere
            assert not others or name in ("copy_", "_to_copy", "index", "index_put_"), f"{name} of two devices"
        if target == DEVICE:
            kwargs = {**kwargs, "device": "cpu"}
        result = function(*_on_host(args), **_on_host(kwargs))
        if name.endswith("_") and not name.endswith("__"):  # in place
            return args[0]
        return _on_device(result) if is_result_here and name != "_local_scalar_dense" else result

    def _count(self, name: str, args: Any, operands: list[DeviceTensor], is_read: bool) -> None:
        self.num_operations += 1
        places = tree_leaves(args[1]) if name in ("index", "index_put_") else []
        has_mask = any(isinstance(place, DeviceTensor) and place.dtype == torch.bool for place in places)
        self.num_waits += is_read or has_mask or name in WAITING
        adds = name in UNORDERED or (name == "index_put_" and len(args) > 3 and args[3])
        if adds and any(operand.is_floating_point() for operand in operands):
            self.unordered.add(name)


class _Operations(TorchDispatchMode):
    def __init__(self, device: AbsentDevice) -> None:
        super().__init__()
        self._device = device

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return self._device.run(function, args, kwargs or {})


class _Functions(TorchFunctionMode):
    """Functions that make tensors of Python's numbers, or numbers of a tensor, without an operation."""

    def __init__(self, device: AbsentDevice) -> None:
        super().__init__()
        self._device = device

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        is_here = bool(args) and isinstance(args[0], DeviceTensor)
        if function is Tensor.tolist and is_here:
            self._device.num_waits += 1
            return args[0].content.tolist()
        if function is Tensor.new_tensor and is_here:
            return DeviceTensor(args[0].content.new_tensor(*args[1:], **kwargs))
        if function in (torch.tensor, torch.as_tensor) and kwargs.get("device") == DEVICE:
            return DeviceTensor(function(*args, **{**kwargs, "device": "cpu"}))
        return function(*args, **kwargs)


def _on_host(values: Any) -> Any:
    return tree_map(lambda value: value.content if isinstance(value, DeviceTensor) else value, values)


def _on_device(values: Any) -> Any:
    return tree_map(lambda value: DeviceTensor(value) if isinstance(value, Tensor) else value, values)
