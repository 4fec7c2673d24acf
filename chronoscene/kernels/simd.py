"""Vectors of several numbers inside Numba kernels, written as LLVM vector instructions.

Numba has no vector type, and leaving loops to the auto-vectoriser costs a factor of four to ten in
the compositing kernels; in matrix products LLVM does not keep a block in registers. Here a vector
is a Numba type of its own; ``+ - * /``, comparisons and bit operations emit one or a few
instructions of LLVM's portable vector IR, which LLVM turns into AVX-512, AVX2, SSE or NEON as the
machine has it. Nothing names a processor's instruction, so the same kernels run everywhere; only
the width that they are written for is chosen from the processor.

What else the kernels do with vectors is beside them: `chronoscene.rasterizer.cpu.simd` and
`chronoscene.kernels.registers`. Functions named ``emit_`` write LLVM code and are for intrinsics.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numba.extending
from llvmlite import binding, ir
from numba import config, types
from numba.extending import lower_builtin, models, register_model, type_callable

# The declared type of an intrinsic has the typing context as an argument that callers leave out.
intrinsic: Any = numba.extending.intrinsic

FLAGS = ("contract", "nsz", "arcp", "afn")
"""Rounding may differ from IEEE in the last place (fused multiply-add, reciprocals); infinities
and nan are kept, since comparisons with them decide what is culled."""


def _register_lanes() -> int:
    """16 with AVX-512, 8 with AVX2, else 4. Honours NUMBA_CPU_FEATURES, as compiled code does."""
    features = config.CPU_FEATURES  # type: ignore[attr-defined]
    if features is None:
        features = binding.get_host_cpu_features().flatten()
    names = str(features).split(",")
    return 16 if "+avx512f" in names else 8 if "+avx2" in names else 4


REGISTER_LANES = _register_lanes()
"""Numbers of 32 bits in the widest register of the processor."""

ELEMENTS = {"f32": ir.FloatType(), "i32": ir.IntType(32), "i1": ir.IntType(1)}
I32 = ir.IntType(32)


class Vector(types.Type):
    """A Numba value of several f32, i32 or i1 (a mask)."""

    def __init__(self, kind: str, lanes: int) -> None:
        self.kind, self.lanes = kind, lanes
        super().__init__(name=f"{kind}x{lanes}")

    @property
    def llvm(self) -> ir.VectorType:
        return ir.VectorType(ELEMENTS[self.kind], self.lanes)

    def with_kind(self, kind: str) -> Vector:
        return Vector(kind, self.lanes)


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Vector) -> None:
        super().__init__(dmm, fe_type, fe_type.llvm)


SCALARS = {"f32": types.float32, "i32": types.int32}


def emit_lanes(values: list[int] | list[float], element: ir.Type) -> ir.Constant:
    """A constant vector with these lanes."""
    return ir.Constant(
        ir.VectorType(element, len(values)), [ir.Constant(element, v) for v in values]
    )


def emit_splat(builder: Any, value: Any, lanes: int) -> Any:
    """A vector with one number in every lane."""
    vector = ir.VectorType(value.type, lanes)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(I32, 0))
    return builder.shuffle_vector(
        first, ir.Constant(vector, ir.Undefined), emit_lanes([0] * lanes, I32)
    )


def emit_promoted(context: Any, builder: Any, value: Any, kind: Any, like: Vector) -> Any:
    """A vector as it is; a number in every lane of one like ``like``."""
    if isinstance(kind, Vector):
        return value
    scalar = context.cast(builder, value, kind, SCALARS[like.kind])
    return emit_splat(builder, scalar, like.lanes)


def _define_operator(op: Callable, emit: Callable[[Any, str, Any, Any], Any], mask: bool) -> None:
    """Let ``op`` take two vectors, or a vector and a number."""

    def result(a: Any, b: Any) -> Vector | None:
        vectors = [x for x in (a, b) if isinstance(x, Vector)]
        others = [x for x in (a, b) if not isinstance(x, Vector)]
        if not vectors or len({v.name for v in vectors}) > 1:
            return None
        if any(not isinstance(x, types.Number) for x in others):
            return None
        return vectors[0].with_kind("i1") if mask else vectors[0]

    @type_callable(op)
    def _type(context: Any) -> Callable:
        def typer(a: Any, b: Any) -> Vector | None:
            return result(a, b)

        return typer

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        like = next(x for x in sig.args if isinstance(x, Vector))
        a, b = (
            emit_promoted(context, builder, x, t, like) for x, t in zip(args, sig.args, strict=True)
        )
        return emit(builder, like.kind, a, b)

    for pair in ((Vector, Vector), (Vector, types.Number), (types.Number, Vector)):
        lower_builtin(op, *pair)(lower)


def _arithmetic(name: str) -> Callable[[Any, str, Any, Any], Any]:
    def emit(builder: Any, kind: str, a: Any, b: Any) -> Any:
        if kind == "f32":
            return getattr(builder, "f" + name)(a, b, flags=FLAGS)
        return getattr(builder, name)(a, b)

    return emit


def _bitwise(name: str) -> Callable[[Any, str, Any, Any], Any]:
    def emit(builder: Any, kind: str, a: Any, b: Any) -> Any:
        return getattr(builder, name)(a, b)

    return emit


def comparison(symbol: str) -> Callable[[Any, str, Any, Any], Any]:
    """What writes a comparison of two vectors of one kind; false where either is nan."""

    def emit(builder: Any, kind: str, a: Any, b: Any) -> Any:
        if kind == "f32":
            return builder.fcmp_ordered(symbol, a, b)
        return builder.icmp_signed(symbol, a, b)

    return emit


for _op, _name in (
    (operator.add, "add"),
    (operator.sub, "sub"),
    (operator.mul, "mul"),
    (operator.truediv, "div"),
):
    _define_operator(_op, _arithmetic(_name), mask=False)
for _op, _symbol in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
):
    _define_operator(_op, comparison(_symbol), mask=True)
for _op, _name in (
    (operator.and_, "and_"),
    (operator.or_, "or_"),
    (operator.lshift, "shl"),
    (operator.rshift, "ashr"),
):
    _define_operator(_op, _bitwise(_name), mask=False)


def make_splat(kind: str, lanes: int) -> Callable:
    """Function for kernels that makes a vector of a number."""

    @intrinsic
    def splat(typingctx: Any, value: Any) -> Any:
        """Vector with one number in every lane."""

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return emit_splat(builder, args[0], lanes)

        return Vector(kind, lanes)(SCALARS[kind]), codegen

    return splat
