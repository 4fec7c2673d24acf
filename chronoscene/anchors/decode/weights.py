"""Join the weights of the heads before decoding, and take their gradients apart; see `Layout`."""

from __future__ import annotations

from chronoscene.kernels.compilation import inner, kernel
from chronoscene.kernels.memory import read, write


@inner
def _output_column(layout, head, output):  # type: ignore[no-untyped-def]
    """Column among the joined outputs of an output of head 0, 1, 2."""
    if head == 0:
        return output
    if head == 2:
        return layout.colors_at + output
    offset, part = output // 7, output % 7
    if part < 3:
        return layout.scales_at + 3 * offset + part
    return layout.quats_at + 4 * offset + part - 3


@inner
def _num_outputs(layout, head):  # type: ignore[no-untyped-def]
    return layout.offsets * (1 if head == 0 else 7 if head == 1 else 3)


@kernel
def pack(layout, heads, shared, out):  # type: ignore[no-untyped-def]
    """Join three heads.

    Args:
        layout: `Layout`.
        heads: Three `Head`.
        shared: Address of the mixed global feature. [G]
        out: `Weights`, zeros at first.
    """
    width = layout.inputs + layout.shared
    for head in range(3):
        source = heads[head]
        for h in range(layout.hidden):
            at = head * layout.hidden_pad + h
            bias = read(source.b1, h)
            for g in range(layout.shared):
                bias += read(source.w1, h * width + layout.inputs + g) * read(shared, g)
            write(out.b1, at, bias)
            for i in range(layout.inputs):
                value = read(source.w1, h * width + i)
                write(out.w1_t, i * layout.hiddens + at, value)
                if i < layout.features:
                    write(out.w1, at * layout.features_pad + i, value)
        for o in range(_num_outputs(layout, head)):
            column = _output_column(layout, head, o)
            write(out.b2, column, read(source.b2, o))
            for h in range(layout.hidden):
                value = read(source.w2, o * layout.hidden + h)
                write(out.w2, column * layout.hidden_pad + h, value)
                write(out.w2_t, h * layout.outputs_pad + column, value)


@kernel
def unpack_gradients(layout, grads, heads, shared, out, shared_out):  # type: ignore[no-untyped-def]
    """Spread the gradients of the joined weights over the heads and what they share.

    Args:
        layout: `Layout`.
        grads: `Gradients`.
        heads: Three `Head`.
        shared: Address of the mixed global feature. [G]
        out: Three `Head`, written.
        shared_out: Address of zeros, to which the gradient of ``shared`` is added. [G]
    """
    width = layout.inputs + layout.shared
    for head in range(3):
        source, target = heads[head], out[head]
        for h in range(layout.hidden):
            at = head * layout.hidden_pad + h
            bias = read(grads.b1, at)
            write(target.b1, h, bias)
            for i in range(layout.inputs):
                grad = read(grads.w1_t, i * layout.hiddens + at)
                write(target.w1, h * width + i, grad)
            # The bias stood for b1 + w1[:, inputs:] @ shared.
            for g in range(layout.shared):
                column = h * width + layout.inputs + g
                write(target.w1, column, bias * read(shared, g))
                total = read(shared_out, g) + bias * read(source.w1, column)
                write(shared_out, g, total)
        for o in range(_num_outputs(layout, head)):
            column = _output_column(layout, head, o)
            write(target.b2, o, read(grads.b2, column))
            for h in range(layout.hidden):
                grad = read(grads.w2, column * layout.hidden_pad + h)
                write(target.w2, o * layout.hidden + h, grad)
