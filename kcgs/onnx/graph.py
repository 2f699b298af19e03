"""Graphs put together operator by operator, checked and written whole."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
import onnx_ir as ir
from numpy.typing import NDArray
from onnx_ir.tape import Tape

from kcgs._atomic import atomic_path

OPSET = 18  # what torch exports by default, so that graphs of both chain
INT32, INT64, FLOAT = 6, 7, 1  # ONNX's numbers of its types
_IR_VERSION = 10
_SUFFIX = ".onnx"
_NODES = 500  # bytes that the operators of packed numbers take

Value = ir.Value
Array = NDArray[np.generic]
Operand = Value | Array | np.generic | int


class Graph:
    """A graph in the making: call it with an operator's name and operands, and get the result.

    Arrays become constants, stored once if equal; integers are int64, other numbers need a numpy type.

    Example:
        >>> graph = Graph()
        >>> size = graph.input("size", np.int64, [2])
        >>> model = graph.finish("area", graph("ReduceProd", size, keepdims=0), np.int64, [], {})
        >>> [node.op_type for node in model.graph.node]
        ['ReduceProd']
    """

    def __init__(self, outer: Graph | None = None) -> None:
        self._tape = Tape()
        self._inputs: list[Value] = []
        self._constants: dict[tuple[str, tuple[int, ...], bytes], Value] = {}
        self._outer = outer
        self._names: list[int] = [0] if outer is None else outer._names

    def input(self, name: str, dtype: type[np.generic], shape: Sequence[int | str], doc: str | None = None) -> Value:
        """Declare an input; names stand for sizes that vary, `doc` says order, range and units."""
        value = ir.val(name, dtype=ir.DataType.from_numpy(np.dtype(dtype)), shape=ir.Shape(list(shape)))
        value.doc_string = doc
        self._inputs.append(value)
        return value

    def constant(self, array: Array | np.generic | int | Sequence[int]) -> Value:
        """Store an array."""
        data = np.asarray(array).copy(order="C")
        key = (data.dtype.str, data.shape, data.tobytes())
        if key not in self._constants:
            name = self._fresh("c")
            self._constants[key] = self._tape.initializer(ir.tensor(data, name=name), name=name)
        return self._constants[key]

    def whole(self, numbers: NDArray[np.int64]) -> Value:
        """Store whole numbers from 0 on in one, two or four bytes each, and make them int32.

        Two bytes are stored as such, low and high: not all runtimes have 16-bit types.
        """
        most = int(numbers.max(initial=0))
        if most >= 1 << 16:
            return self.constant(numbers.astype(np.int32))
        low = self("Cast", self.constant((numbers % 256).astype(np.uint8)), to=INT32)
        if most < 256:
            return low
        high = self("Cast", self.constant((numbers // 256).astype(np.uint8)), to=INT32)
        return self("Add", low, self("Mul", high, np.int32(256)))

    def sparse(self, numbers: NDArray[np.int64]) -> Value:
        """Store whole numbers (n,) of which most are 0: flags of the others, and those; int32."""
        used = numbers > 0
        size = 1 if numbers.max(initial=0) < 256 else 2
        if size * used.sum() + len(numbers) // 8 + _NODES > size * len(numbers):
            return self.whole(numbers)
        flags = self.flags(used)
        values = self("Concat", np.zeros(1, np.int32), self.whole(numbers[used]), axis=0)
        return self("Gather", values, self("Mul", flags, self("CumSum", flags, np.int64(0))))

    def flags(self, flags: NDArray[np.bool_]) -> Value:
        """Store flags (n,), as bits and where few are set sparser; int32."""
        octets = self.sparse(np.packbits(flags, bitorder="little").astype(np.int64))
        bits = self("Div", self("Unsqueeze", octets, self.constant([1])), (1 << np.arange(8)).astype(np.int32))
        bits = self("Reshape", self("Mod", bits, np.int32(2)), self.constant([-1]))
        return self("Slice", bits, self.constant([0]), self.constant([len(flags)]), self.constant([0]))

    def piecewise(self, numbers: NDArray[np.int64]) -> Value:
        """Store whole numbers (n,) that are often the same as the one before: where they change, and to what; int32."""
        changes = np.diff(numbers, prepend=-1) != 0
        place = self("Sub", self("CumSum", self.flags(changes), np.int64(0)), np.int32(1))
        return self("Gather", self.whole(numbers[changes]), place)

    def __call__(self, op: str, *operands: Operand, **attributes: object) -> Value:
        """Apply an operator that has one result."""
        return self.apply(op, operands, 1, **attributes)[0]

    def apply(self, op: str, operands: Sequence[Operand | None], results: int, **attributes: object) -> Sequence[Value]:
        """Apply an operator that has several results, or leaves operands out."""
        values = [None if x is None else x if isinstance(x, Value) else self.constant(x) for x in operands]
        made = self._tape.op_multi_out(op, values, attributes, num_outputs=results)  # type: ignore[arg-type]
        for value in made:
            value.name = self._fresh("v")
        node = made[0].producer()
        assert node is not None
        node.name = ""  # names of nodes are optional, and weigh as much as the nodes
        return made

    def split(self, values: Operand, lengths: Sequence[int]) -> Sequence[Value]:
        """Cut a value along its first axis."""
        return self.apply("Split", [values, self.constant(lengths)], len(lengths), axis=0)

    def body(self, build: Callable[[Graph], Sequence[Value]], name: str) -> ir.Graph:
        """Make the graph inside a Loop or an If; it may use values from outside."""
        inner = Graph(self)
        outputs = build(inner)
        return inner._close(outputs, name)

    def finish(
        self,
        name: str,
        value: Value,
        dtype: type[np.generic],
        shape: Sequence[int | str],
        metadata: Mapping[str, str],
        docs: tuple[str, str] | None = None,
    ) -> onnx.ModelProto:
        """Close the graph, with its output, and check it; `docs` are those of the graph and of the output."""
        value.name, value.dtype, value.shape = name, ir.DataType.from_numpy(np.dtype(dtype)), ir.Shape(list(shape))
        graph = self._close([value], "decoder")
        graph.doc_string, value.doc_string = docs or (None, None)
        model = ir.Model(graph, ir_version=_IR_VERSION, producer_name="kcgs")
        model.metadata_props.update(metadata)
        proto = ir.to_proto(model)
        onnx.checker.check_model(proto, full_check=True)
        return proto

    def _close(self, outputs: Sequence[Value], name: str) -> ir.Graph:
        return ir.Graph(
            self._inputs,
            outputs,
            nodes=self._tape.nodes,
            initializers=self._tape.initializers,
            opset_imports={"": OPSET} if self._outer is None else {},
            name=name,
        )

    def _fresh(self, prefix: str) -> str:
        self._names[0] += 1
        return f"{prefix}{self._names[0]}"


def write_model(model: onnx.ModelProto, path: str | os.PathLike[str]) -> int:
    """Write a model; the file appears whole or not at all.

    Args:
        model: checked.
        path: ends in .onnx.

    Returns:
        Size of the file in bytes.

    Raises:
        ValueError: another suffix.
        FileNotFoundError: the folder does not exist.
    """
    path = Path(path)
    if path.suffix.lower() != _SUFFIX:
        raise ValueError(f"path must end in {_SUFFIX}; got {str(path)!r}")
    content = model.SerializeToString(deterministic=True)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return len(content)
