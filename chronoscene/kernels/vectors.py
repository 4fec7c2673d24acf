"""Vectors of several numbers inside Numba kernels, written as LLVM vector instructions.

Numba has no vector type, and leaving loops to the auto-vectoriser costs a factor of four to ten in
the compositing kernels; in matrix products LLVM does not keep a block in registers. Here a vector
is a Numba type of its own, with any number of lanes; ``+ - * /``, comparisons and bit operations
emit one or a few instructions of LLVM's portable vector IR, which LLVM turns into AVX-512, AVX2,
SSE or NEON as the machine has it. Only products of pairs name a processor's instructions, where
LLVM would not find them; so the same kernels run everywhere, and only the width that they are
written for is chosen from the processor.

Functions that make a vector from nothing are made for a number of lanes (``make_...``); all others
take it from their arguments, of which some may be single numbers. Functions named ``emit_`` write
LLVM code and are for other intrinsics.
"""

from __future__ import annotations

import operator
import platform
from collections.abc import Callable, Sequence
from inspect import Parameter, Signature
from inspect import signature as pysignature
from typing import Any

import numba.extending
from llvmlite import binding, ir
from numba import config, types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable

from chronoscene.kernels.compilation import FAST_MATH

# The declared type of an intrinsic has the typing context as an argument that callers leave out.
intrinsic: Any = numba.extending.intrinsic


def emitted(signature: Callable[..., Any]) -> Callable[[Callable[..., Any]], Any]:
    """Make a function of kernels from one that writes LLVM code.

    Args:
        signature: Returns the Numba signature for the types of the arguments. What is decorated is
            called with Numba's context, the IR builder, that signature, and the values; it returns
            a value, or None where the signature says void.
    """

    def define(emit: Callable[..., Any]) -> Any:
        def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            value = emit(context, builder, sig, args)
            return context.get_dummy_value() if value is None else value

        def typed(typingctx: Any, *kinds: Any) -> Any:
            return signature(*kinds), lower

        first = Parameter("typingctx", Parameter.POSITIONAL_OR_KEYWORD)
        parameters = [first, *pysignature(signature).parameters.values()]
        typed.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        typed.__name__, typed.__doc__ = emit.__name__, emit.__doc__
        return intrinsic(typed)

    return define


def _features() -> list[str]:
    """List what the processor has. Honours NUMBA_CPU_FEATURES, as compiled code does."""
    features = config.CPU_FEATURES  # type: ignore[attr-defined]
    if features is None:
        features = binding.get_host_cpu_features().flatten()
    return str(features).split(",")


def _register_lanes() -> int:
    """16 with AVX-512, 8 with AVX2, else 4."""
    names = _features()
    return 16 if "+avx512f" in names else 8 if "+avx2" in names else 4


LANES = _register_lanes()  # Numbers of 32 bits in the widest register of the processor
BYTE_PRODUCTS = LANES == 16 and "+avx512vnni" in _features()
"""True if the processor has `emit_add_byte_products`."""
_IS_ARM = platform.machine() in ("aarch64", "arm64")
FUSED = _IS_ARM or "+fma" in _features()  # True if `multiply_add` rounds once
MANY_REGISTERS = LANES == 16 or _IS_ARM
"""32 vector registers, else 16."""

FLOAT = ir.FloatType()
I32 = ir.IntType(32)
_ELEMENTS = {"f32": FLOAT, "i32": I32, "i1": ir.IntType(1)}
_SCALARS = {"f32": types.float32, "i32": types.int32}


class Vector(types.Type):
    """A Numba value of several f32, i32 or i1 (a mask)."""

    def __init__(self, kind: str, lanes: int) -> None:
        self.kind, self.lanes = kind, lanes
        super().__init__(name=f"{kind}x{lanes}")

    @property
    def llvm(self) -> ir.VectorType:
        return ir.VectorType(_ELEMENTS[self.kind], self.lanes)

    def with_kind(self, kind: str) -> Vector:
        return Vector(kind, self.lanes)


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Vector) -> None:
        super().__init__(dmm, fe_type, fe_type.llvm)


# What other intrinsics are written with.


def emit_lanes(values: Sequence[float], element: ir.Type) -> ir.Constant:
    """A constant vector with these lanes."""
    return ir.Constant(
        ir.VectorType(element, len(values)), [ir.Constant(element, v) for v in values]
    )


def emit_splat(builder: Any, value: Any, lanes: int) -> Any:
    """A vector with one number in every lane."""
    undefined = ir.Constant(ir.VectorType(value.type, lanes), ir.Undefined)
    first = builder.insert_element(undefined, value, I32(0))
    return builder.shuffle_vector(first, undefined, emit_lanes([0] * lanes, I32))


def emit_shuffle(builder: Any, a: Any, b: Any, lanes: Sequence[int | None]) -> Any:
    """Lanes of a, then of b, by number; None is any value."""
    last = a.type.count - 1
    order = [min(k, last) if i is None else i for k, i in enumerate(lanes)]
    return builder.shuffle_vector(a, b, emit_lanes(order, I32))


def emit_call(builder: Any, name: str, *args: Any, flags: Sequence[str] = ()) -> Any:
    """Call ``llvm.<name>`` on float vectors of one type."""
    vector = args[0].type
    kind = ir.FunctionType(vector, [vector] * len(args))
    full = f"llvm.{name}.v{vector.count}f32"
    return builder.call(
        cgutils.get_or_insert_function(builder.module, kind, full), args, fastmath=flags
    )


def emit_multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c: fmuladd fuses where the processor can; fma would call a slow library function
    where not."""
    return emit_call(builder, "fmuladd", a, b, c)


_PAIR_PRODUCTS = {16: "avx512.pmaddw.d.512", 8: "avx2.pmadd.wd", 4: "sse2.pmadd.wd"}


def emit_add_pair_products(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """c plus the products of two numbers of 16 bits that each lane of a and b holds."""
    if platform.machine() in ("x86_64", "AMD64"):
        pairs = ir.VectorType(ir.IntType(16), 2 * LANES)
        kind = ir.FunctionType(c.type, [pairs, pairs])
        name = f"llvm.x86.{_PAIR_PRODUCTS[LANES]}"
        multiply = cgutils.get_or_insert_function(builder.module, kind, name)
        products = builder.call(multiply, [builder.bitcast(x, pairs) for x in (a, b)])
        return builder.add(c, products)
    half = emit_lanes([16] * LANES, I32)
    high = builder.mul(*(builder.ashr(x, half) for x in (a, b)))
    low = builder.mul(*(builder.ashr(builder.shl(x, half), half) for x in (a, b)))
    return builder.add(c, builder.add(low, high))


def emit_add_byte_products(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """c plus the products of four bytes of each lane, of a without and of b with a sign."""
    kind = ir.FunctionType(c.type, [c.type] * 3)
    name = "llvm.x86.avx512.vpdpbusd.512"
    multiply = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(multiply, [c, a, b])


def _like(*kinds: Any) -> Any:
    """Return the type of the vectors; None unless they have one type and the rest are numbers."""
    vectors = [kind for kind in kinds if isinstance(kind, Vector)]
    numbers = [kind for kind in kinds if isinstance(kind, types.Number)]
    if len({v.name for v in vectors}) != 1 or len(vectors) + len(numbers) < len(kinds):
        return None
    return vectors[0]


def _promote(context: Any, builder: Any, kinds: Any, args: Any) -> tuple[Vector, list[Any]]:
    """Turn numbers among the arguments into vectors like the others."""
    like = _like(*kinds)

    def promoted(kind: Any, value: Any) -> Any:
        if isinstance(kind, Vector):
            return value
        scalar = context.cast(builder, value, kind, _SCALARS[like.kind])
        return emit_splat(builder, scalar, like.lanes)

    return like, [promoted(*pair) for pair in zip(kinds, args, strict=True)]


# Operators.

_COMPARISONS = {"lt": "<", "le": "<=", "gt": ">", "ge": ">="}
_ARITHMETIC = {"add": "add", "sub": "sub", "mul": "mul", "truediv": "div"}
_BITWISE = {"and_": "and_", "or_": "or_", "xor": "xor", "lshift": "shl", "rshift": "ashr"}


def _emit_operator(builder: Any, kind: str, name: str, a: Any, b: Any) -> Any:
    """Comparisons are false where either is nan."""
    if name in _COMPARISONS:
        compare = builder.fcmp_ordered if kind == "f32" else builder.icmp_signed
        return compare(_COMPARISONS[name], a, b)
    if name in _ARITHMETIC and kind == "f32":
        return getattr(builder, "f" + _ARITHMETIC[name])(a, b, flags=FAST_MATH)
    return getattr(builder, (_ARITHMETIC | _BITWISE)[name])(a, b)


def _define_operator(name: str) -> None:
    """Let an operator take two vectors, or a vector and a number."""
    function = getattr(operator, name)

    @type_callable(function)
    def _type(context: Any) -> Callable:
        def typer(a: Any, b: Any) -> Any:
            like = _like(a, b)
            return like.with_kind("i1") if like and name in _COMPARISONS else like

        return typer

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        like, (a, b) = _promote(context, builder, sig.args, args)
        return _emit_operator(builder, like.kind, name, a, b)

    for pair in ((Vector, Vector), (Vector, types.Number), (types.Number, Vector)):
        lower_builtin(function, *pair)(lower)


for _name in (*_COMPARISONS, *_ARITHMETIC, *_BITWISE):
    _define_operator(_name)


# Functions for kernels.


def make_splat(kind: str, lanes: int) -> Callable:
    """Make a function that puts one number into every lane of a vector."""

    @emitted(lambda value: Vector(kind, lanes)(_SCALARS[kind]))
    def splat(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit_splat(builder, args[0], lanes)

    return splat


splat = make_splat("f32", LANES)


def make_constant(values: Sequence[float]) -> Callable:
    """Make a function of no arguments that gives these lanes."""
    kind = "i32" if all(isinstance(v, int) for v in values) else "f32"

    @emitted(lambda: Vector(kind, len(values))())
    def constant(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit_lanes(values, _ELEMENTS[kind])

    return constant


def _make_function(name: str) -> Callable:
    @emitted(lambda a: a(a))
    def function(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return emit_call(builder, name, args[0], flags=FAST_MATH)

    return function


sqrt = _make_function("sqrt")
"""Square root of each lane; nan for negative ones."""
floor = _make_function("floor")
"""Largest whole number not above each lane."""
absolute = _make_function("fabs")


def _make_conversion(instruction: str, kind: str) -> Callable:
    @emitted(lambda a: a.with_kind(kind)(a))
    def convert(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return getattr(builder, instruction)(args[0], sig.return_type.llvm)

    return convert


to_int = _make_conversion("fptosi", "i32")
"""Lanes truncated towards zero; they must fit."""
to_float = _make_conversion("sitofp", "f32")
"""Integer lanes as floats."""
as_int = _make_conversion("bitcast", "i32")
"""The bits of float lanes."""
as_float = _make_conversion("bitcast", "f32")
"""Float lanes of these bits."""


@emitted(lambda a, b, c: _like(a, b, c)(a, b, c))
def multiply_add(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """a * b + c, rounded once where the processor can."""
    _, args = _promote(context, builder, sig.args, args)
    return emit_multiply_add(builder, *args)


@emitted(lambda mask, a, b: _like(a, b)(mask, a, b))
def select(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Lanes of ``a`` where the mask is set, of ``b`` elsewhere."""
    _, chosen = _promote(context, builder, sig.args[1:], args[1:])
    return builder.select(args[0], *chosen)


def _make_extremum(comparison: str) -> Callable:
    @emitted(lambda a, b: _like(a, b)(a, b))
    def extremum(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """The smaller (larger) of two per lane; the second if one is nan."""
        like, (x, y) = _promote(context, builder, sig.args, args)
        return builder.select(_emit_operator(builder, like.kind, comparison, x, y), x, y)

    return extremum


minimum = _make_extremum("lt")
maximum = _make_extremum("gt")


@emitted(lambda mask: types.boolean(mask))
def any_lane(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Return True if any lane of the mask is set."""
    bits = builder.bitcast(args[0], ir.IntType(sig.args[0].lanes))
    return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))


@emitted(lambda a: types.uint64(a))
def pack_bytes(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """The low bytes of eight integer lanes as one 64-bit number, lane 0 lowest."""
    low = builder.trunc(args[0], ir.VectorType(ir.IntType(8), 8))
    return builder.bitcast(low, ir.IntType(64))


@emitted(lambda bits: types.intp(types.uint64))
def trailing_zeros(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Number of the lowest set bit of a nonzero 64-bit number."""
    return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))
