"""An ONNX graph that is put together by arithmetic on its values, and closed to a checked model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import onnx
import onnx_ir as ir
import onnx_ir.passes.common as passes
from numpy.typing import NDArray
from onnx_ir.tape import Tape

OPSET = 18  # what torch exports by default, so that graphs of both chain
_IR_VERSION = 10

BOOL = ir.DataType.BOOL
FLOAT = ir.DataType.FLOAT
INT32 = ir.DataType.INT32
INT64 = ir.DataType.INT64

Array = NDArray[np.generic]


class Value:
    """A tensor of a graph. Arithmetic adds operators to the graph; `x[i]` gathers along the first axis.

    Numbers of Python take the type of the value. Division of integers rounds towards zero.
    """

    __array_ufunc__ = None  # numpy leaves arithmetic of its arrays and values to this class

    def __init__(self, graph: Graph, value: ir.Value, dtype: ir.DataType) -> None:
        self.graph = graph
        self.value = value
        self.dtype = dtype

    def __add__(self, other: Operand) -> Value:
        return self.graph.Add(self, self._operand(other))

    def __sub__(self, other: Operand) -> Value:
        return self.graph.Sub(self, self._operand(other))

    def __rsub__(self, other: Operand) -> Value:
        return self.graph.Sub(self._operand(other), self)

    def __mul__(self, other: Operand) -> Value:
        return self.graph.Mul(self, self._operand(other))

    def __truediv__(self, other: Operand) -> Value:
        return self.graph.Div(self, self._operand(other))

    def __rtruediv__(self, other: Operand) -> Value:
        return self.graph.Div(self._operand(other), self)

    def __floordiv__(self, other: Operand) -> Value:
        return self.graph.Div(self, self._operand(other))

    def __mod__(self, other: Operand) -> Value:
        return self.graph.Mod(self, self._operand(other))

    def __matmul__(self, other: Operand) -> Value:
        return self.graph.MatMul(self, self._operand(other))

    def __neg__(self) -> Value:
        return self.graph.Neg(self)

    def __getitem__(self, indices: Value) -> Value:
        return self.graph.Gather(self, indices)

    def astype(self, dtype: ir.DataType) -> Value:
        """Cast to a type."""
        if dtype == self.dtype:
            return self
        return Value(self.graph, self.graph.Cast(self, to=dtype).value, dtype)

    def _operand(self, other: Operand) -> Operand:
        """Give numbers of Python the type of this value."""
        return np.asarray(other, self.dtype.numpy()) if isinstance(other, int | float) else other


# what an operator takes: lists are int64, and so are Python's integers; its floats are float32
Operand = Value | Array | np.generic | int | float | Sequence[int]


class Operator:
    """An operator of ONNX with one result, as a method of graphs that takes operands and attributes."""

    def __init__(self, dtype: ir.DataType | None = None, *, typed_by: int = 0) -> None:
        """Say the type of the result; None: that of the operand at position `typed_by`."""
        self.dtype = dtype
        self.typed_by = typed_by

    def __set_name__(self, owner: type[Graph], name: str) -> None:
        self.name = name

    def __get__(self, graph: Graph, owner: type[Graph] | None = None) -> Callable[..., Value]:
        return partial(self._apply, graph)

    def _apply(self, graph: Graph, *operands: Operand, **attributes: object) -> Value:
        values = [graph.constant(operand) for operand in operands]
        dtype = self.dtype or values[self.typed_by].dtype
        return graph.add_node(self.name, values, [dtype], **attributes)[0]


class Scope(NamedTuple):
    """What belongs to a graph alone, and not to those inside it or around it."""

    tape: Tape
    inputs: list[ir.Value]
    constants: dict[tuple[str, tuple[int, ...], bytes], Value]  # onnx.compose renames no others inside a body


class Graph:
    """A graph in the making: `graph.Gather(x, indices, axis=1)` adds an operator and returns its result.

    Arrays become constants, stored once if equal.

    Example:
        >>> graph = Graph()
        >>> size = graph.input("size", INT64, [2])
        >>> model = graph.close(graph.ReduceProd(size * 2, keepdims=0), "area", [])
        >>> [node.op_type for node in model.graph.node]
        ['Mul', 'ReduceProd']
    """

    # the operators that decoders use, by their names in ONNX
    Abs = Operator()
    Add = Operator()
    And = Operator()
    Cast = Operator()
    Clip = Operator()
    Compress = Operator()
    Concat = Operator()
    CumSum = Operator()
    Div = Operator()
    Equal = Operator(BOOL)
    Exp = Operator()
    Expand = Operator()
    Flatten = Operator()
    Gather = Operator()
    Greater = Operator(BOOL)
    Identity = Operator()
    If = Operator(FLOAT)  # branches return images
    Less = Operator(BOOL)
    LessOrEqual = Operator(BOOL)
    Log = Operator()
    Loop = Operator(FLOAT)  # its turns return parts of an image
    MatMul = Operator()
    Max = Operator()
    Min = Operator()
    Mod = Operator()
    Mul = Operator()
    Neg = Operator()
    Not = Operator()
    Or = Operator()
    Pad = Operator()
    Pow = Operator()
    Range = Operator()
    Reciprocal = Operator()
    ReduceMax = Operator()
    ReduceMin = Operator()
    ReduceProd = Operator()
    ReduceSum = Operator()
    Relu = Operator()
    Reshape = Operator()
    Shape = Operator(INT64)
    Slice = Operator()
    Sqrt = Operator()
    Squeeze = Operator()
    Sub = Operator()
    ThresholdedRelu = Operator()
    Transpose = Operator()
    Unsqueeze = Operator()
    Where = Operator(typed_by=1)

    def __init__(self) -> None:
        self._scopes = [Scope(Tape(), [], {})]  # the graph, and the bodies that are being built in it
        self._names = 0

    def input(self, name: str, dtype: ir.DataType, shape: Sequence[int | str], doc: str | None = None) -> Value:
        """Declare an input; names stand for sizes that vary, `doc` says order, range and units."""
        value = ir.val(name, dtype=dtype, shape=ir.Shape(list(shape)))
        value.doc_string = doc
        self._scopes[-1].inputs.append(value)
        return Value(self, value, dtype)

    def constant(self, array: Operand) -> Value:
        """Store an array."""
        if isinstance(array, Value):
            return array
        data = np.asarray(array, np.float32 if isinstance(array, float) else None).copy(order="C")
        tape, _, constants = self._scopes[-1]
        key = (data.dtype.str, data.shape, data.tobytes())
        if key not in constants:
            name = self._name("c")
            tensor = ir.tensor(data, name=name)
            constants[key] = Value(self, tape.initializer(tensor, name=name), tensor.dtype)
        return constants[key]

    def add_node(
        self, operator: str, operands: Sequence[Value], dtypes: Sequence[ir.DataType], **attributes: object
    ) -> list[Value]:
        """Apply an operator whose results have these types."""
        results = self._scopes[-1].tape.op_multi_out(
            operator,
            [operand.value for operand in operands],
            attributes,  # type: ignore[arg-type]
            num_outputs=len(dtypes),
        )
        for value in results:
            value.name = self._name("v")
        node = results[0].producer()
        assert node is not None
        node.name = ""  # names of nodes are optional, and weigh as much as the nodes
        return [Value(self, value, dtype) for value, dtype in zip(results, dtypes, strict=True)]

    def split(self, value: Operand, parts: int | Sequence[int], axis: int = 0) -> list[Value]:
        """Cut a value into so many equal parts, or into parts of these lengths."""
        value = self.constant(value)
        if isinstance(parts, int):
            return self.add_node("Split", [value], [value.dtype] * parts, axis=axis, num_outputs=parts)
        return self.add_node("Split", [value, self.constant(parts)], [value.dtype] * len(parts), axis=axis)

    def argsort(self, numbers: Value, count: Operand, largest: int = 0) -> Value:
        """Find the `count` smallest or largest numbers, int64 indices, in order; of equal ones, the first comes first.

        So it finds flags, too: onnxruntime would leave Compress for every run.
        """
        operands = [numbers.astype(INT64), self.constant(count)]
        return self.add_node("TopK", operands, [INT64, INT64], largest=largest, axis=0)[1]

    def body(self, name: str, build: Callable[[], Sequence[Value]]) -> ir.Graph:
        """Make the graph inside a Loop or an If: what `build` adds and returns; it may use values from outside."""
        self._scopes.append(Scope(Tape(), [], {}))
        return self._pop(name, build(), {})

    def choose(self, condition: Value, first: Callable[[], Value], second: Callable[[], Value]) -> Value:
        """Compute the first value where a condition, (1,), holds, and else the second."""
        then, other = self.body("then", lambda: [first()]), self.body("else", lambda: [second()])
        return self.If(condition, then_branch=then, else_branch=other)

    def close(
        self,
        output: Value,
        name: str,
        shape: Sequence[int | str],
        doc: str = "",
        *,
        graph_doc: str = "",
        metadata: Mapping[str, str] | None = None,
    ) -> onnx.ModelProto:
        """Close the graph with its output, and check it; `doc` says what the output is."""
        value = output.value
        value.name, value.dtype, value.shape, value.doc_string = name, output.dtype, ir.Shape(list(shape)), doc
        graph = self._pop("decoder", [output], {"": OPSET})
        graph.doc_string = graph_doc
        model = ir.Model(graph, ir_version=_IR_VERSION, producer_name="kcgs")
        model.metadata_props.update(metadata or {})
        passes.RemoveUnusedNodesPass()(model)  # modules make what only some scenes need, such as sums of squares
        proto = ir.to_proto(model)
        onnx.checker.check_model(proto, full_check=True)
        return proto

    def _pop(self, name: str, outputs: Sequence[Value], opsets: dict[str, int]) -> ir.Graph:
        tape, inputs, _ = self._scopes.pop()
        return ir.Graph(
            inputs,
            [output.value for output in outputs],
            nodes=tape.nodes,
            initializers=tape.initializers,
            opset_imports=opsets,
            name=name,
        )

    def _name(self, prefix: str) -> str:
        self._names += 1
        return f"{prefix}{self._names}"
