"""A graph of ONNX operators, written as Python expressions.

`Graph` has every operator of ONNX as a method, and `Value` is a tensor that flows through it: arithmetic on values adds
operators, and arrays and numbers become constants. `close` names the output and returns the checked model:

    >>> graph = Graph()
    >>> size = graph.input("size", INT64, [2])
    >>> area = graph.ReduceProd(size * 2, keepdims=0)
    >>> model = graph.close(area, "area", [])
    >>> [node.op_type for node in model.graph.node]
    ['Mul', 'ReduceProd']

`choose` and `loop` add the operators that hold graphs of their own: what their functions build goes into these.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from itertools import count
from typing import NamedTuple

import numpy as np
import onnx
import onnx_ir as ir
import onnx_ir.passes.common as passes
from numpy.typing import NDArray
from onnx_ir.tape import Tape

OPSET = 18  # as in exports of Kornia
_IR_VERSION = 10

BOOL = ir.DataType.BOOL
FLOAT = ir.DataType.FLOAT
INT32 = ir.DataType.INT32
INT64 = ir.DataType.INT64

Array = NDArray[np.generic]


@cache
def _result_dtype(operator: str) -> int | ir.DataType:
    """Return the dtype of an operator's result, or the index of the operand that has this dtype."""
    schema = onnx.defs.get_schema(operator, OPSET)
    kind = schema.outputs[0].type_str
    for index, operand in enumerate(schema.inputs):
        if operand.type_str == kind:
            return index
    constraints = {constraint.type_param_str: constraint.allowed_type_strs for constraint in schema.type_constraints}
    (name,) = constraints.get(kind, [kind])  # such as "tensor(bool)"
    return ir.DataType[name.removeprefix("tensor(").removesuffix(")").upper()]


def _arithmetic(operator: str, reflected: bool = False) -> Callable[[Value, Operand], Value]:
    """Return a method of `Value` that applies an operator to the value and an operand; reflected: in reverse order."""

    def apply(self: Value, other: Operand) -> Value:
        if isinstance(other, int | float):
            assert isinstance(other, int) or self.dtype == FLOAT, "a float is rounded if the value holds integers"
            other = np.asarray(other, self.dtype.numpy())
        return self.graph.apply(operator, *((other, self) if reflected else (self, other)))

    return apply


def _function(operator: str) -> Callable[[Value], Value]:
    """Return a method of `Value` that applies an operator to the value."""
    return lambda self: self.graph.apply(operator, self)


class Value:
    """A tensor of a graph; `x[i]` gathers along the first axis.

    Python numbers take the dtype of the value. Division of integers rounds towards zero. Methods with torch's names
    allow formulas of `kcgs.maps` and `kcgs.kernels` to take values.
    """

    __array_ufunc__ = None  # numpy leaves arithmetic between its arrays and values to this class

    def __init__(self, graph: Graph, value: ir.Value, dtype: ir.DataType) -> None:
        self.graph = graph
        self.value = value
        self.dtype = dtype

    __add__ = _arithmetic("Add")
    __sub__ = _arithmetic("Sub")
    __rsub__ = _arithmetic("Sub", reflected=True)
    __mul__ = _arithmetic("Mul")
    __truediv__ = _arithmetic("Div")
    __rtruediv__ = _arithmetic("Div", reflected=True)
    __floordiv__ = _arithmetic("Div")
    __mod__ = _arithmetic("Mod")
    __matmul__ = _arithmetic("MatMul")
    clamp_min = _arithmetic("Max")
    __neg__ = _function("Neg")
    abs = _function("Abs")
    reciprocal = _function("Reciprocal")
    sqrt = _function("Sqrt")

    def __getitem__(self, indices: Value) -> Value:
        return self.graph.Gather(self, indices)

    def astype(self, dtype: ir.DataType) -> Value:
        """Cast to a dtype."""
        if dtype == self.dtype:
            return self
        return self.graph.add_node("Cast", [self], [dtype], to=dtype)[0]


# operands of an operator: lists and Python integers become int64, Python floats become float32
Operand = Value | Array | np.generic | int | float | Sequence[int]


class Scope(NamedTuple):
    """The contents of a single graph, without graphs inside it or around it."""

    tape: Tape
    inputs: list[ir.Value]
    constants: dict[tuple[str, tuple[int, ...], bytes], Value]  # onnx.compose renames only a body's own constants in it


class Graph:
    """A graph under construction: `graph.Gather(x, indices, axis=1)` adds an operator and returns its result.

    Arrays become constants; equal arrays are stored once.
    """

    def __init__(self) -> None:
        self._scopes = [Scope(Tape(), [], {})]  # the graph, and the bodies that are being built in it
        self._numbers = count(1)

    def __getattr__(self, operator: str) -> Callable[..., Value]:
        """Return the ONNX operator of this name, with one result, as a method."""
        if not onnx.defs.has(operator):
            raise AttributeError(operator)
        return partial(self.apply, operator)

    def apply(self, operator: str, *operands: Operand, **attributes: object) -> Value:
        """Apply an operator with one result."""
        values = [self.constant(operand) for operand in operands]
        dtype = _result_dtype(operator)
        dtype = dtype if isinstance(dtype, ir.DataType) else values[dtype].dtype
        return self.add_node(operator, values, [dtype], **attributes)[0]

    def input(self, name: str, dtype: ir.DataType, shape: Sequence[int | str], doc: str | None = None) -> Value:
        """Declare an input; names in `shape` are sizes that vary, `doc` describes order, range and units."""
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
            name = f"c{next(self._numbers)}"
            tensor = ir.tensor(data, name=name)
            constants[key] = Value(self, tape.initializer(tensor, name=name), tensor.dtype)
        return constants[key]

    def add_node(
        self, operator: str, operands: Sequence[Value], dtypes: Sequence[ir.DataType], **attributes: object
    ) -> list[Value]:
        """Apply an operator whose results have these dtypes."""
        results = self._scopes[-1].tape.op_multi_out(
            operator,
            [operand.value for operand in operands],
            attributes,  # type: ignore[arg-type]
            num_outputs=len(dtypes),
        )
        for value in results:
            value.name = f"v{next(self._numbers)}"
        node = results[0].producer()
        assert node is not None
        node.name = ""  # names of nodes are optional, and take as many bytes as the nodes
        return [Value(self, value, dtype) for value, dtype in zip(results, dtypes, strict=True)]

    def split(self, value: Operand, parts: int | Sequence[int], axis: int = 0) -> list[Value]:
        """Cut a value into a number of equal parts, or into parts of given lengths."""
        value = self.constant(value)
        if isinstance(parts, int):
            return self.add_node("Split", [value], [value.dtype] * parts, axis=axis, num_outputs=parts)
        return self.add_node("Split", [value, self.constant(parts)], [value.dtype] * len(parts), axis=axis)

    def argsort(self, numbers: Value, count: Operand, largest: int = 0) -> Value:
        """Return the int64 indices of the `count` smallest or largest numbers, sorted; equal numbers keep their order.

        It also finds flags that are set: onnxruntime would compute Compress in every run, not on loading.
        """
        operands = [numbers.astype(INT64), self.constant(count)]
        return self.add_node("TopK", operands, [INT64, INT64], largest=largest, axis=0)[1]

    def choose(self, condition: Value, first: Callable[[], Value], second: Callable[[], Value]) -> Value:
        """Compute the first value if a condition, (1,), holds, else the second, which has the same dtype."""
        then, dtype = self._body("then", lambda: [first()])
        other, other_dtype = self._body("else", lambda: [second()])
        assert dtype == other_dtype
        return self.add_node("If", [condition], [dtype], then_branch=then, else_branch=other)[0]

    def loop(self, count: Value, turn: Callable[[Value], Value]) -> Value:
        """Call `turn` with the number of each turn, int64 (), and stack the results of all turns, (count, ...)."""

        def build() -> list[Value]:
            number, condition = self.input("turn", INT64, []), self.input("more", BOOL, [])
            return [self.Identity(condition), turn(number)]

        body, dtype = self._body("turns", build)
        return self.add_node("Loop", [count, self.constant(np.bool_(True))], [dtype], body=body)[0]

    def _body(self, name: str, build: Callable[[], Sequence[Value]]) -> tuple[ir.Graph, ir.DataType]:
        """Return the graph that `build` adds and returns, and the dtype of its last result.

        The graph may use values from outside.
        """
        self._scopes.append(Scope(Tape(), [], {}))
        results = build()
        return self._pop(name, results, {}), results[-1].dtype

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
        """Close the graph with its output, and check the model; `doc` describes the output."""
        value = output.value
        value.name, value.dtype, value.shape, value.doc_string = name, output.dtype, ir.Shape(list(shape)), doc
        graph = self._pop("decoder", [output], {"": OPSET})
        graph.doc_string = graph_doc
        model = ir.Model(graph, ir_version=_IR_VERSION, producer_name="kcgs")
        model.metadata_props.update(metadata or {})
        passes.RemoveUnusedNodesPass()(model)  # modules also make values that only some scenes need
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
