"""Matrix products of a few dozen rows, for use inside compiled kernels.

numba leaves a tile of sums in memory, at a tenth of the speed; so the innermost loop is written
here with LLVM's vectors. Those are not tied to a processor: LLVM splits them where registers are
narrower, so the sizes chosen here matter for speed alone.
"""

from __future__ import annotations

from typing import Any

from llvmlite import binding, ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

PLAIN, RELU, MASKED = 0, 1, 2  # what becomes of the sums


def _registers() -> tuple[int, int]:
    """Floats in a vector register of this machine, and how many such registers it has."""
    if binding.get_process_triple().startswith(("aarch64", "arm64")):
        return 4, 32
    features = dict(binding.get_host_cpu_features())
    if features.get("avx512f"):
        return 16, 32
    return (8, 16) if features.get("avx") else (4, 16)


LANES, _COUNT = _registers()
# Tiles in rows and vectors: the sums, a row of the right side and a value of the left fit the
# registers, and there are enough sums to hide how long one addition takes.
_WIDE_ROWS, _WIDE = (6, 4) if _COUNT == 32 else (6, 2)
_PAIR_ROWS, _PAIR = (12, 2) if _COUNT == 32 else (6, 2)
_SINGLE_ROWS = 12
SHAPES = (_WIDE_ROWS, _WIDE), (_PAIR_ROWS, _PAIR), (_SINGLE_ROWS, 1)
ROWS = 12  # a multiple of every tile's rows
_POINTERS = ("out", "init", "a", "b", "mask")
_ARGUMENTS = (
    *("depth", "finish", "out", "out_at", "out_step", "init", "init_at", "init_step"),
    *("a", "a_at", "a_step", "a_stride", "b", "b_at", "b_step", "mask", "mask_at", "mask_step"),
)


class Tile:
    """Writes the instructions of one tile: out = finish(init + a @ b)."""

    def __init__(
        self,
        context: Any,
        builder: Any,
        signature: Any,
        values: Any,
        names: tuple[str, ...] = _ARGUMENTS,
    ) -> None:
        self.builder = builder
        self.given = dict(zip(names, values, strict=True))
        self.vector = ir.VectorType(ir.FloatType(), LANES)
        for name, kind in zip(names, signature.args, strict=True):
            if name in _POINTERS:
                array = cgutils.create_struct_proxy(kind)(context, builder, self.given[name])
                self.given[name] = array.data

    def address(self, name: str, row: int, column: int, along: Any = None) -> Any:
        """Of vector `column` in row `row` of a matrix, moved along by a number of elements."""
        builder, step = self.builder, self.given[name + "_step"]
        at = builder.add(self.given[name + "_at"], builder.mul(step, step.type(row)))
        at = builder.add(at, at.type(column * LANES))
        return builder.gep(self.given[name], [at if along is None else builder.add(at, along)])

    def load(self, name: str, row: int, column: int, along: Any = None) -> Any:
        pointer = self.address(name, row, column, along)
        # Rows begin anywhere: only the alignment of one float is certain.
        return self.builder.load(self.builder.bitcast(pointer, self.vector.as_pointer()), align=4)

    def store(self, value: Any, row: int, column: int) -> None:
        pointer = self.address("out", row, column)
        self.builder.store(value, self.builder.bitcast(pointer, self.vector.as_pointer()), align=4)

    def broadcast(self, value: Any) -> Any:
        lane = ir.IntType(32)
        undefined = ir.Constant(self.vector, ir.Undefined)
        one = self.builder.insert_element(undefined, value, lane(0))
        return self.builder.shuffle_vector(
            one, undefined, ir.Constant(ir.VectorType(lane, LANES), None)
        )

    def add_product(self, total: Any, left: Any, right: Any) -> Any:
        # "contract" lets LLVM fuse the two where the processor can.
        product = self.builder.fmul(left, right, flags=("contract",))
        return self.builder.fadd(total, product, flags=("contract",))

    def accumulate(self, rows: int, vectors: int) -> list[Any]:
        """The loop along the depth; returns the sums row by row."""
        builder, depth = self.builder, self.given["depth"]
        grid = [(row, column) for row in range(rows) for column in range(vectors)]
        start = [self.load("init", row, column) for row, column in grid]
        before = builder.block
        loop, after = (builder.append_basic_block(f"tile.{name}") for name in ("loop", "after"))
        builder.cbranch(builder.icmp_signed(">", depth, depth.type(0)), loop, after)

        builder.position_at_end(loop)
        k = builder.phi(depth.type)
        sums = [builder.phi(self.vector) for _ in grid]
        along_a = builder.mul(k, self.given["a_stride"])
        along_b = builder.mul(k, self.given["b_step"])
        right = [self.load("b", 0, column, along_b) for column in range(vectors)]
        totals = []
        for row in range(rows):
            left = self.broadcast(builder.load(self.address("a", row, 0, along_a), align=4))
            for column in range(vectors):
                totals.append(self.add_product(sums[row * vectors + column], left, right[column]))
        following = builder.add(k, k.type(1))
        k.add_incoming(k.type(0), before)
        k.add_incoming(following, loop)
        builder.cbranch(builder.icmp_signed("<", following, depth), loop, after)

        builder.position_at_end(after)
        results = [builder.phi(self.vector) for _ in grid]
        for phis, blocks in ((sums, (before, loop)), (results, (before, loop))):
            for phi, first, total in zip(phis, start, totals, strict=True):
                phi.add_incoming(first, blocks[0])
                phi.add_incoming(total, blocks[1])
        return results

    def finish(self, results: list[Any], vectors: int) -> None:
        """Store the sums; with RELU or MASKED, zero where they or the mask are not above zero."""
        builder, how = self.builder, self.given["finish"]
        grid = [divmod(i, vectors) for i in range(len(results))]
        zero = ir.Constant(self.vector, None)
        with builder.if_else(builder.icmp_signed("==", how, how.type(PLAIN))) as (plain, rest):
            with plain:
                for result, (row, column) in zip(results, grid, strict=True):
                    self.store(result, row, column)
            with rest, builder.if_else(builder.icmp_signed("==", how, how.type(RELU))) as branches:
                for branch, masked in zip(branches, (False, True), strict=True):
                    with branch:
                        for result, (row, column) in zip(results, grid, strict=True):
                            gate = self.load("mask", row, column) if masked else result
                            # Unordered: what is not a number stays so, as in torch.
                            keep = builder.fcmp_unordered(">", gate, zero)
                            self.store(builder.select(keep, result, zero), row, column)


def _tile(rows: int, vectors: int) -> Any:
    @intrinsic
    def tile(typing, depth, finish, out, out_at, out_step, init, init_at, init_step,
             a, a_at, a_step, a_stride, b, b_at, b_step, mask, mask_at, mask_step):  # fmt: skip
        kinds = (depth, finish, out, out_at, out_step, init, init_at, init_step,
                 a, a_at, a_step, a_stride, b, b_at, b_step, mask, mask_at, mask_step)  # fmt: skip

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            writer = Tile(context, builder, signature, values)
            writer.finish(writer.accumulate(rows, vectors), vectors)
            return context.get_dummy_value()

        return types.void(*kinds), generate

    return tile


_wide = _tile(_WIDE_ROWS, _WIDE)
_pair = _tile(_PAIR_ROWS, _PAIR)
_single = _tile(_SINGLE_ROWS, 1)


@njit(cache=True, nogil=True)
def multiply(rows, columns, depth, finish, out, out_at, out_step, init, init_at, init_step,
             a, a_at, a_step, a_stride, b, b_at, b_step, mask, mask_at, mask_step):  # fmt: skip
    """out = finish(init + a @ b) for flat float32 arrays, each with a first element and a step.

    out, init, b and mask are walked by row; a by row and, along the depth, by its stride, so that
    it may be transposed. A step of 0 repeats a row of init. rows and columns are rounded up, to
    ROWS and LANES: the arrays must have that much room, and the surplus of out is of no meaning.
    """
    width = columns
    column = 0
    while width > 0:
        if width > (_WIDE - 1) * LANES:
            for row in range(0, rows, _WIDE_ROWS):
                _wide(depth, finish, out, out_at + row * out_step + column, out_step,
                      init, init_at + row * init_step + column, init_step,
                      a, a_at + row * a_step, a_step, a_stride, b, b_at + column, b_step,
                      mask, mask_at + row * mask_step + column, mask_step)  # fmt: skip
            done = _WIDE * LANES
        elif width > LANES:
            for row in range(0, rows, _PAIR_ROWS):
                _pair(depth, finish, out, out_at + row * out_step + column, out_step,
                      init, init_at + row * init_step + column, init_step,
                      a, a_at + row * a_step, a_step, a_stride, b, b_at + column, b_step,
                      mask, mask_at + row * mask_step + column, mask_step)  # fmt: skip
            done = _PAIR * LANES
        else:
            for row in range(0, rows, _SINGLE_ROWS):
                _single(depth, finish, out, out_at + row * out_step + column, out_step,
                        init, init_at + row * init_step + column, init_step,
                        a, a_at + row * a_step, a_step, a_stride, b, b_at + column, b_step,
                        mask, mask_at + row * mask_step + column, mask_step)  # fmt: skip
            done = LANES
        column += done
        width -= done
