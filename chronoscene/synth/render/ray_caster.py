"""First hits, shadows and distances of triangles, with the same bits on every processor.

Generated scenes are fixed by hashes, and libraries for ray casting round reciprocals as the
processor does. Here boxes around triangles only exclude what cannot be hit, with a margin above all
rounding; what is hit, and where, is decided by IEEE arithmetic on the triangle alone. So results
depend neither on the tree nor on the processor, and of equal distances the triangle with the
smaller number counts.

The tree has nodes of eight boxes, which are tested at once (Wald, Benthin and Boulos, "Getting rid
of packets", 2008); it is built from the top by the surface area heuristic with bins (Wald, "On fast
construction of SAH-based bounding volume hierarchies", 2007).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.kernels.compilation import inlined, inner, kernel
from chronoscene.kernels.memory import make_load, store
from chronoscene.kernels.vectors import (
    make_constant,
    maximum,
    minimum,
    pack_bytes,
    select,
    trailing_zeros,
)
from chronoscene.synth.render.mesh import MISS
from chronoscene.synth.render.noise import dot, plus, scaled

_WIDTH = 8  # Boxes of a node
_LEAF = 2  # Triangles of a box that is not divided
_BINS = 16
_STACK = 512  # Open nodes: seven of each level, and no tree has more than 70 levels
_AT_A_TIME = 1024  # Rays or points of a task
_MARGIN = np.float32(2e-6)  # Relative error of distances to boxes in single precision, and more
_ON_BOX = 1e-7  # The same in double precision, less than _MARGIN
_FAR = np.float32(1e30)

_load = make_load(_WIDTH)
_ones = make_constant([1] * _WIDTH)


class Hits(NamedTuple):
    """First hits of rays."""

    t: NDArray[np.float32]
    """Parameter along the ray; infinite for a miss. [n]"""
    tri: NDArray[np.uint32]
    """Triangle, or `MISS`. [n]"""
    uv: NDArray[np.float32]
    """Barycentric coordinates of the second and third corner. [n, 2]"""


class _Tree(NamedTuple):
    boxes: NDArray[np.float32]
    """Lowest x, y, z of the boxes of each node, then the highest. [nodes * 6 * _WIDTH]"""
    first: NDArray[np.int32]
    """Node in a box, or the first of its triangles. [nodes * _WIDTH]"""
    triangles: NDArray[np.int32]
    """Number of triangles in a box; 0 if it has a node. [nodes * _WIDTH]"""
    corners: NDArray[np.float32]
    """Triangles in the order of the boxes. [T, 3, 3]"""
    number: NDArray[np.uint32]
    """Their numbers. [T]"""


class RayCaster:
    """Triangles in a tree of boxes.

    Args:
        triangles: World coordinates of the corners. [T, 3, 3] float32
    """

    def __init__(self, triangles: NDArray[np.float32]) -> None:
        low, high = triangles.min(axis=1), triangles.max(axis=1)
        boxes, first, count, order = _build(low, high)
        self._tree = _Tree(boxes, first, count, triangles[order], order.astype(np.uint32))

    def cast(self, rays: NDArray[np.float32]) -> Hits:
        """First hits of rays (origin, direction), at parameters from 0 on. [n, 6]"""
        return Hits(*_cast(self._tree, np.ascontiguousarray(rays)))

    def occluded(self, rays: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Mask of the rays that hit anything. [n]"""
        return np.asarray(_occluded(self._tree, np.ascontiguousarray(rays)))

    def nearest(self, points: Array) -> tuple[Array, NDArray[np.uint32]]:
        """Distance from points [n, 3] to the nearest triangle, and which it is. [n], [n]"""
        distance, number = _nearest(self._tree, np.ascontiguousarray(points, np.float64))
        return distance, number


# Building.


@inner
def _half_area(box):
    x, y, z = box[3] - box[0], box[4] - box[1], box[5] - box[2]
    return x * y + y * z + z * x


@inner
def _enclose(box, low, high):
    for axis in range(3):
        box[axis] = min(box[axis], low[axis])
        box[3 + axis] = max(box[3 + axis], high[axis])


@inner
def _clear(boxes):
    boxes[..., :3] = np.inf
    boxes[..., 3:] = -np.inf


@inner
def _partition(order, start, end, bins, last):
    """Move the triangles of the bins up to ``last`` to the front; return where the rest begins."""
    i, j = start, end
    while i < j:
        if bins[i] <= last:
            i += 1
        else:
            j -= 1
            order[i], order[j] = order[j], order[i]
            bins[i], bins[j] = bins[j], bins[i]
    return i


@inner
def _divide(low, high, order, start, end, bins, bin_boxes, bin_counts, right):
    """Divide triangles start..end of the order in two; return where the second part begins."""
    centres = np.empty(6)
    _clear(centres)
    for i in range(start, end):
        for axis in range(3):
            c = low[order[i], axis] + high[order[i], axis]
            centres[axis] = min(centres[axis], c)
            centres[3 + axis] = max(centres[3 + axis], c)
    axis = int(np.argmax(centres[3:] - centres[:3]))
    origin, extent = centres[axis], centres[3 + axis] - centres[axis]
    if extent <= 0.0:
        return (start + end) // 2
    _clear(bin_boxes)
    bin_counts[:] = 0
    for i in range(start, end):
        tri = order[i]
        b = min(_BINS - 1, int((low[tri, axis] + high[tri, axis] - origin) / extent * _BINS))
        bins[i] = b
        bin_counts[b] += 1
        _enclose(bin_boxes[b], low[tri], high[tri])
    # Costs of the bins from b on.
    box = np.empty(6)
    _clear(box)
    behind = 0
    for b in range(_BINS - 1, 0, -1):
        _enclose(box, bin_boxes[b, :3], bin_boxes[b, 3:])
        behind += bin_counts[b]
        right[b] = _half_area(box) * behind if behind else 0.0
    _clear(box)
    before, best, least = 0, 0, np.inf
    for b in range(_BINS - 1):
        _enclose(box, bin_boxes[b, :3], bin_boxes[b, 3:])
        before += bin_counts[b]
        if 0 < before < end - start:
            cost = _half_area(box) * before + right[b + 1]
            if cost < least:
                least, best = cost, b
    return _partition(order, start, end, bins, best)


@inner
def _bounds(low, high, order, start, end, box):
    _clear(box)
    for i in range(start, end):
        _enclose(box, low[order[i]], high[order[i]])


@kernel
def _build(low, high):
    """The tree over the boxes of triangles: boxes, first and triangles of `_Tree`; the order."""
    order = np.arange(len(low)).astype(np.int32)
    bins = np.empty(len(low), np.int8)
    bin_boxes, bin_counts, right = np.empty((_BINS, 6)), np.empty(_BINS, np.int64), np.empty(_BINS)
    room = max(1, len(low) // 8)
    boxes = np.empty((room, 6, _WIDTH), np.float32)
    first, count = np.zeros((room, _WIDTH), np.int32), np.zeros((room, _WIDTH), np.int32)
    starts, ends, parts = (
        np.empty(_WIDTH, np.int64),
        np.empty(_WIDTH, np.int64),
        np.empty((_WIDTH, 6)),
    )
    ranges = [(0, len(low))]  # Triangles of each node
    node = 0
    while node < len(ranges):
        if node == len(boxes):
            boxes = np.concatenate((boxes, np.empty_like(boxes)))
            first = np.concatenate((first, np.zeros_like(first)))
            count = np.concatenate((count, np.zeros_like(count)))
        starts[0], ends[0] = ranges[node]
        _bounds(low, high, order, starts[0], ends[0], parts[0])
        used = 1
        while used < _WIDTH:
            widest, area = -1, -1.0
            for k in range(used):
                if ends[k] - starts[k] > _LEAF and _half_area(parts[k]) > area:
                    widest, area = k, _half_area(parts[k])
            if widest < 0:
                break
            middle = _divide(
                low, high, order, starts[widest], ends[widest], bins, bin_boxes, bin_counts, right
            )
            starts[used], ends[used], ends[widest] = middle, ends[widest], middle
            for k in (widest, used):
                _bounds(low, high, order, starts[k], ends[k], parts[k])
            used += 1
        boxes[node, :3], boxes[node, 3:] = _FAR, -_FAR
        for k in range(used):
            boxes[node, :, k] = parts[k]
            if ends[k] - starts[k] <= _LEAF:
                first[node, k], count[node, k] = starts[k], ends[k] - starts[k]
            else:
                first[node, k] = len(ranges)
                ranges.append((starts[k], ends[k]))
        node += 1
    return (
        boxes[:node].copy().reshape(-1),
        first[:node].copy().reshape(-1),
        count[:node].copy().reshape(-1),
        order,
    )


# Searching.


@inner
def _inverse(d):
    """1 / d in single precision, finite where d is 0."""
    if abs(d) < 1e-18:
        return np.float32(1e18 if d >= 0.0 else -1e18)
    return np.float32(1.0 / d)


@inlined
def _hit_boxes(boxes, node, origin, inverse, near_planes, limit, distances):
    """Mark the boxes that a ray enters before a limit, a byte for each; write where it enters."""
    at, far_planes = node * (6 * _WIDTH), 3 * _WIDTH
    near = maximum(
        maximum(
            (_load(boxes, at + near_planes[0]) - origin[0]) * inverse[0],
            (_load(boxes, at + _WIDTH + near_planes[1]) - origin[1]) * inverse[1],
        ),
        maximum(
            (_load(boxes, at + 2 * _WIDTH + near_planes[2]) - origin[2]) * inverse[2], np.float32(0)
        ),
    )
    far = minimum(
        minimum(
            (_load(boxes, at + far_planes - near_planes[0]) - origin[0]) * inverse[0],
            (_load(boxes, at + _WIDTH + far_planes - near_planes[1]) - origin[1]) * inverse[1],
        ),
        minimum(
            (_load(boxes, at + 2 * _WIDTH + far_planes - near_planes[2]) - origin[2]) * inverse[2],
            limit,
        ),
    )
    store(distances, 0, near)
    mask = near * (np.float32(1) - _MARGIN) <= far * (np.float32(1) + _MARGIN)
    return pack_bytes(select(mask, _ones(), 0))


@inlined
def _near_boxes(boxes, node, point, limit, distances):
    """Mark the boxes nearer to a point than a limit, a byte for each; write squared distances."""
    at = node * (6 * _WIDTH)
    square = _squared_gap(boxes, at, point[0])
    square = square + _squared_gap(boxes, at + _WIDTH, point[1])
    square = square + _squared_gap(boxes, at + 2 * _WIDTH, point[2])
    store(distances, 0, square)
    mask = square * (np.float32(1) - _MARGIN) <= limit
    return pack_bytes(select(mask, _ones(), 0))


@inlined
def _squared_gap(boxes, at, x):
    low, high = _load(boxes, at) - x, x - _load(boxes, at + 3 * _WIDTH)
    gap = maximum(maximum(low, high), np.float32(0))
    return gap * gap


@inner
def _push(marked, node, distances, stack, open_at, top):
    """Put marked boxes of a node on the stack, the nearest last; return the new height."""
    base = top
    while marked != 0:
        k = trailing_zeros(marked) >> 3
        marked &= marked - np.uint64(1)
        box, distance = node * _WIDTH + k, distances[k]
        place = top
        while place > base and open_at[place - 1] < distance:
            stack[place], open_at[place] = stack[place - 1], open_at[place - 1]
            place -= 1
        stack[place], open_at[place] = box, distance
        top += 1
    return top


@inner
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inner
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inner
def _corner(corners, tri, k):
    # Numba's float() would leave it in single precision.
    return (
        np.float64(corners[tri, k, 0]),
        np.float64(corners[tri, k, 1]),
        np.float64(corners[tri, k, 2]),
    )


@inner
def _hit(corners, tri, origin, d):
    """Parameter at which a ray hits a triangle, infinity for none, and barycentric coordinates.

    The volumes that the direction spans with two triangles' common edge differ only in their signs,
    so that no ray slips through between them.
    """
    a = _minus(_corner(corners, tri, 0), origin)
    b = _minus(_corner(corners, tri, 1), origin)
    c = _minus(_corner(corners, tri, 2), origin)
    u, v, w = dot(_cross(c, b), d), dot(_cross(a, c), d), dot(_cross(b, a), d)
    if min(u, v, w) < 0.0 < max(u, v, w):
        return np.inf, 0.0, 0.0
    total = u + v + w
    normal = _cross(_minus(b, a), _minus(c, a))
    slope = dot(normal, d)
    if total == 0.0 or slope == 0.0:
        return np.inf, 0.0, 0.0
    t = dot(normal, a) / slope
    # Of a triangle seen from the edge little more than rounding is left. What is not in its box is
    # no hit, or hits would depend on the boxes that are looked into.
    if t < 0.0 or not (
        _between(a[0], b[0], c[0], t * d[0])
        and _between(a[1], b[1], c[1], t * d[1])
        and _between(a[2], b[2], c[2], t * d[2])
    ):
        return np.inf, 0.0, 0.0
    return t, v / total, w / total


@inner
def _between(a, b, c, x):
    low, high = min(a, b, c), max(a, b, c)
    return low - _ON_BOX * abs(low) <= x <= high + _ON_BOX * abs(high)


@inner
def _room():
    """Memory of a search: boxes to look into and distances to them; distances within a node."""
    return np.empty(_STACK, np.int64), np.empty(_STACK, np.float32), np.empty(_WIDTH, np.float32)


@inner
def _first_hit(tree, rays, i, guess, stack, open_at, distances, anything):
    """First hit of a ray, or ``anything`` that it hits: t, place in the tree or -1, u, v.

    The triangle that the ray before has hit is a good ``guess``: it is tried first.
    """
    start = (rays[i, 0], rays[i, 1], rays[i, 2])
    origin = (np.float64(start[0]), np.float64(start[1]), np.float64(start[2]))
    d = (np.float64(rays[i, 3]), np.float64(rays[i, 4]), np.float64(rays[i, 5]))
    inverse = (_inverse(d[0]), _inverse(d[1]), _inverse(d[2]))
    side = 3 * _WIDTH
    near_planes = (
        side if inverse[0] < 0 else 0,
        side if inverse[1] < 0 else 0,
        side if inverse[2] < 0 else 0,
    )
    best, place, best_u, best_v = np.inf, -1, 0.0, 0.0
    limit = np.float32(np.inf)
    if guess >= 0:
        best, best_u, best_v = _hit(tree.corners, guess, origin, d)
        if best < np.inf:
            place, limit = guess, np.float32(best) * (np.float32(1) + _MARGIN)
            if anything:
                return best, place, best_u, best_v
    marked = _hit_boxes(tree.boxes, 0, start, inverse, near_planes, limit, distances)
    top = _push(marked, 0, distances, stack, open_at, 0)
    while top > 0:
        top -= 1
        box = stack[top]
        if open_at[top] * (np.float32(1) - _MARGIN) > limit:
            continue
        inside = tree.first[box]
        if tree.triangles[box] == 0:
            marked = _hit_boxes(tree.boxes, inside, start, inverse, near_planes, limit, distances)
            top = _push(marked, inside, distances, stack, open_at, top)
            continue
        for k in range(inside, inside + tree.triangles[box]):
            t, u, v = _hit(tree.corners, k, origin, d)
            if t < best or (t == best and place >= 0 and tree.number[k] < tree.number[place]):
                best, place, best_u, best_v = t, k, u, v
                limit = np.float32(t) * (np.float32(1) + _MARGIN)
        if anything and best < np.inf:
            break
    return best, place, best_u, best_v


@kernel(parallel=True)
def _cast(tree, rays):
    n = len(rays)
    t, number = np.empty(n, np.float32), np.empty(n, np.uint32)
    uv = np.empty((n, 2), np.float32)
    for task in prange((n + _AT_A_TIME - 1) // _AT_A_TIME):
        stack, open_at, distances = _room()
        place = -1
        for i in range(task * _AT_A_TIME, min(n, (task + 1) * _AT_A_TIME)):
            t[i], place, uv[i, 0], uv[i, 1] = _first_hit(
                tree, rays, i, place, stack, open_at, distances, False
            )
            number[i] = tree.number[place] if place >= 0 else MISS
    return t, number, uv


@kernel(parallel=True)
def _occluded(tree, rays):
    n = len(rays)
    out = np.empty(n, np.bool_)
    for task in prange((n + _AT_A_TIME - 1) // _AT_A_TIME):
        stack, open_at, distances = _room()
        guess = -1
        for i in range(task * _AT_A_TIME, min(n, (task + 1) * _AT_A_TIME)):
            place = _first_hit(tree, rays, i, guess, stack, open_at, distances, True)[1]
            out[i] = place >= 0
            guess = place if place >= 0 else guess
    return out


@inner
def _squared_distance(corners, tri, p):
    """Squared distance from a point to a triangle, by the part of it that is nearest.

    Source: Ericson, "Real-time collision detection", 2005, section 5.1.5.
    """
    a, b, c = _corner(corners, tri, 0), _corner(corners, tri, 1), _corner(corners, tri, 2)
    ab, ac, bc = _minus(b, a), _minus(c, a), _minus(c, b)
    ap, bp, cp = _minus(p, a), _minus(p, b), _minus(p, c)
    d1, d2, d3 = dot(ab, ap), dot(ac, ap), dot(ab, bp)
    d4, d5, d6 = dot(ac, bp), dot(ab, cp), dot(ac, cp)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        nearest = a
    elif d3 >= 0.0 and d4 <= d3:
        nearest = b
    elif d6 >= 0.0 and d5 <= d6:
        nearest = c
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        nearest = plus(a, scaled(ab, d1 / (d1 - d3)))
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        nearest = plus(a, scaled(ac, d2 / (d2 - d6)))
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        nearest = plus(b, scaled(bc, (d4 - d3) / ((d4 - d3) + (d5 - d6))))
    else:
        total = va + vb + vc
        nearest = plus(plus(a, scaled(ab, vb / total)), scaled(ac, vc / total))
    gap = _minus(p, nearest)
    return dot(gap, gap)


@inner
def _nearest_triangle(tree, p, stack, open_at, distances):
    """Squared distance from a point to the nearest triangle, and its number."""
    rounded = (np.float32(p[0]), np.float32(p[1]), np.float32(p[2]))
    # What rounding the point may add to a distance.
    slack = 1e-6 * (abs(p[0]) + abs(p[1]) + abs(p[2]))
    best, number, limit = np.inf, np.uint32(MISS), np.float32(np.inf)
    marked = _near_boxes(tree.boxes, 0, rounded, limit, distances)
    top = _push(marked, 0, distances, stack, open_at, 0)
    while top > 0:
        top -= 1
        box = stack[top]
        if open_at[top] * (np.float32(1) - _MARGIN) > limit:
            continue
        inside = tree.first[box]
        if tree.triangles[box] == 0:
            marked = _near_boxes(tree.boxes, inside, rounded, limit, distances)
            top = _push(marked, inside, distances, stack, open_at, top)
            continue
        for k in range(inside, inside + tree.triangles[box]):
            square = _squared_distance(tree.corners, k, p)
            if square < best or (square == best and tree.number[k] < number):
                best, number = square, tree.number[k]
                limit = np.float32((math.sqrt(square) + slack) ** 2) * (np.float32(1) + _MARGIN)
    return best, number


@kernel(parallel=True)
def _nearest(tree, points):
    n = len(points)
    out, numbers = np.empty(n), np.empty(n, np.uint32)
    for task in prange((n + _AT_A_TIME - 1) // _AT_A_TIME):
        stack, open_at, distances = _room()
        for i in range(task * _AT_A_TIME, min(n, (task + 1) * _AT_A_TIME)):
            p = (points[i, 0], points[i, 1], points[i, 2])
            square, numbers[i] = _nearest_triangle(tree, p, stack, open_at, distances)
            out[i] = math.sqrt(square)
    return out, numbers
