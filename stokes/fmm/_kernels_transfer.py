"""Compiled loops of the transfer in Fourier space.

Everything is done on vectors of one register's length, `lanes` numbers (64 bytes: 8 in double and
16 in single precision). In the transforms the lanes are rows, a row being one component of one
box; in the products they are frequencies. Arrays are flat, their parts found by offsets.

Symbols: l nodes per direction, f frequency, v transfer vector, w product of the fast algorithm,
c, s sums with cos and sin along an axis, K spectra of the kernel, M of multipoles, L of locals.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from dem_mpi._jit import jit, jit_threads, prange

VECTOR_BYTES = 64
# Target parents that share tables in registers: with one output at a time, and with three.
GROUP, GROUP_THREE = 8, 3


class _Vectors:
    """Code for loads, stores and arithmetic on vectors of the lanes of a number type."""

    def __init__(self, context: Any, builder: Any, array: Any) -> None:
        self.builder = builder
        self.lanes = VECTOR_BYTES * 8 // array.dtype.bitwidth
        self.element = context.get_value_type(array.dtype)
        self.type = ir.VectorType(self.element, self.lanes)
        self.zero = ir.Constant(self.type, [0.0] * self.lanes)
        self._align = array.dtype.bitwidth // 8

    def _pointer(self, data: Any, offset: Any) -> Any:
        return self.builder.bitcast(self.builder.gep(data, [offset]), self.type.as_pointer())

    def load(self, data: Any, offset: Any) -> Any:
        return self.builder.load(self._pointer(data, offset), align=self._align)

    def load_complex(self, data: Any, offset: Any) -> tuple[Any, Any]:
        behind = self.builder.add(offset, ir.Constant(offset.type, self.lanes))
        return self.load(data, offset), self.load(data, behind)

    def store(self, value: Any, data: Any, offset: Any) -> None:
        self.builder.store(value, self._pointer(data, offset), align=self._align)

    def broadcast(self, data: Any, offset: Any) -> Any:
        return self.spread(self.builder.load(self.builder.gep(data, [offset])))

    def spread(self, scalar: Any) -> Any:
        undefined = ir.Constant(self.type, ir.Undefined)
        first = ir.Constant(ir.IntType(32), 0)
        single = self.builder.insert_element(undefined, scalar, first)
        mask = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), [0] * self.lanes)
        return self.builder.shuffle_vector(single, undefined, mask)

    def shuffle(self, a: Any, b: Any, order: list[int]) -> Any:
        mask = ir.Constant(ir.VectorType(ir.IntType(32), self.lanes), order)
        return self.builder.shuffle_vector(a, b, mask)

    def add(self, a: Any, b: Any) -> Any:
        return self.builder.fadd(a, b)

    def subtract(self, a: Any, b: Any) -> Any:
        return self.builder.fsub(a, b)

    def add_product(self, a: Any, b: Any, total: Any) -> Any:
        product = self.builder.fmul(a, b, flags=("contract",))
        return self.builder.fadd(total, product, flags=("contract",))

    def subtract_product(self, a: Any, b: Any, total: Any) -> Any:
        product = self.builder.fmul(a, b, flags=("contract",))
        return self.builder.fsub(total, product, flags=("contract",))

    def transpose(self, rows: list[Any]) -> list[Any]:
        """Exchange rows and lanes of as many vectors as there are lanes, in log2(lanes) passes."""
        n, step = self.lanes, 1
        while step < n:
            low = [i if not i & step else i - step + n for i in range(n)]
            high = [i + step if not i & step else i + n for i in range(n)]
            turned = list(rows)
            for i in range(n):
                if not i & step:
                    a, b = rows[i], rows[i + step]
                    turned[i] = self.shuffle(a, b, low)
                    turned[i + step] = self.shuffle(a, b, high)
            rows, step = turned, 2 * step
        return rows


def _data(context: Any, builder: Any, array_type: Any, value: Any) -> Any:
    return context.make_array(array_type)(context, builder, value).data


def _complex_sum(vectors: _Vectors, split: bool) -> list[Any]:
    """Variables, at zero, of real and imaginary part; `split`: two of each, to be added."""
    count = 4 if split else 2
    return [cgutils.alloca_once_value(vectors.builder, vectors.zero) for _ in range(count)]


def _add_complex_product(vectors: _Vectors, a: Any, b: Any, total: list[Any]) -> None:
    """total += a b; products with the imaginary part of a go to the second half of a split one."""
    builder, second = vectors.builder, len(total) - 2
    terms = (
        (vectors.add_product, a[0], b[0], 0),
        (vectors.add_product, a[0], b[1], 1),
        (vectors.subtract_product, a[1], b[1], second),
        (vectors.add_product, a[1], b[0], second + 1),
    )
    for add, x, y, part in terms:
        builder.store(add(x, y, builder.load(total[part])), total[part])


def _store_complex_sum(
    vectors: _Vectors, total: list[Any], data: Any, offset: Any, onto: bool
) -> None:
    """Put the sum at the offset, or, with `onto`, add it to what is there."""
    builder = vectors.builder
    for part in range(2):
        here = builder.add(offset, ir.Constant(offset.type, part * vectors.lanes))
        value = builder.load(total[part])
        for other in total[part + 2 :: 2]:
            value = vectors.add(value, builder.load(other))
        if onto:
            value = vectors.add(value, vectors.load(data, here))
        vectors.store(value, data, here)


def _products(targets: int, outputs: int, onto: bool = False) -> Any:
    """Make the inner loop of the transfer for this many targets and outputs at a time.

    onto: the sums are added to what is there. A single sum is split in two, as its additions would
    wait for each other.
    """
    split = targets * outputs == 1

    @intrinsic
    def sums(
        typingctx: Any, K: Any, k0: Any, M: Any, m0: Any, steps: Any, first: Any, last: Any,
        entry: Any, e0: Any, n_in: Any, L: Any, l0: Any, stride: Any,
    ) -> Any:  # fmt: skip
        """L_g,i = sum over steps and j of K_ij M_g,j for targets g and outputs i.

        A row of steps holds the offset of the tables and, for each target, of the source in M;
        entry the offset of each entry (output, input) in a table; L_g,i lies at
        l0 + g stride + 2 lanes i. Complex numbers are a vector of real parts, then of imaginary.
        """
        ints = (types.intp,)
        arguments = (K, *ints, M, *ints, steps, *ints * 2, entry, *ints * 2, L, *ints * 2)

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            vectors = _Vectors(context, builder, K)
            k_data, m_data, step_data, entry_data, l_data = (
                _data(context, builder, signature.args[i], args[i]) for i in (0, 2, 4, 7, 10)
            )
            k_base, m_base, begin, end = args[1], args[3], args[5], args[6]
            e_base, inputs, l_base, l_stride = args[8], args[9], args[11], args[12]
            integer = begin.type

            def number(value: int) -> Any:
                return ir.Constant(integer, value)

            total = [[_complex_sum(vectors, split) for _ in range(outputs)] for _ in range(targets)]
            with cgutils.for_range(builder, end, start=begin, intp=integer) as row:
                at = builder.mul(row.index, number(targets + 1))
                place = [_integer(builder, step_data, at, i) for i in range(targets + 1)]
                table = builder.add(k_base, place[0])
                source = [builder.add(m_base, p) for p in place[1:]]
                with cgutils.for_range(builder, inputs, intp=integer) as column:
                    shift = builder.mul(column.index, number(2 * vectors.lanes))
                    M_j = [vectors.load_complex(m_data, builder.add(s, shift)) for s in source]
                    for i in range(outputs):
                        of = builder.add(builder.mul(number(i), inputs), column.index)
                        offset = builder.load(builder.gep(entry_data, [builder.add(e_base, of)]))
                        K_ij = vectors.load_complex(k_data, builder.add(table, offset))
                        for g in range(targets):
                            _add_complex_product(vectors, K_ij, M_j[g], total[g][i])
            for g in range(targets):
                row_start = builder.add(l_base, builder.mul(l_stride, number(g)))
                for i in range(outputs):
                    here = builder.add(row_start, number(2 * i * vectors.lanes))
                    _store_complex_sum(vectors, total[g][i], l_data, here, onto)
            return context.get_dummy_value()

        return types.void(*arguments), generate

    return sums


_sums_group, _sums_group_three = _products(GROUP, 1), _products(GROUP_THREE, 3)
_add_sums_one, _add_sums_three = _products(1, 1, onto=True), _products(1, 3, onto=True)


def _tile(rows: int, columns: int) -> Any:
    """Make the product of `rows` rows of a real matrix with `columns` columns of vectors."""

    @intrinsic
    def tile(
        typingctx: Any, matrix: Any, m0: Any, m_row: Any, length: Any, x: Any, x0: Any,
        x_row: Any, x_column: Any, y: Any, y0: Any, y_row: Any, y_column: Any,
    ) -> Any:  # fmt: skip
        """y[r, c] = sum over j < length of matrix[r, j] x[j, c]; offsets in numbers."""
        n = types.intp
        arguments = (matrix, n, n, n, x, n, n, n, y, n, n, n)

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            vectors = _Vectors(context, builder, x)
            m_data, x_data, y_data = (
                _data(context, builder, signature.args[i], args[i]) for i in (0, 4, 8)
            )
            m_base, m_step, count = args[1:4]
            x_base, x_step, x_side = args[5:8]
            y_base, y_step, y_side = args[9:12]

            def at(base: Any, k: int, step: Any) -> Any:
                return builder.add(base, builder.mul(step, ir.Constant(step.type, k)))

            total = [
                [cgutils.alloca_once_value(builder, vectors.zero) for _ in range(columns)]
                for _ in range(rows)
            ]
            with cgutils.for_range(builder, count, intp=count.type) as j:
                start = builder.add(x_base, builder.mul(j.index, x_step))
                values = [vectors.load(x_data, at(start, c, x_side)) for c in range(columns)]
                for r in range(rows):
                    factor = vectors.broadcast(m_data, builder.add(at(m_base, r, m_step), j.index))
                    for c in range(columns):
                        old = builder.load(total[r][c])
                        builder.store(vectors.add_product(factor, values[c], old), total[r][c])
            for r in range(rows):
                for c in range(columns):
                    here = at(at(y_base, r, y_step), c, y_side)
                    vectors.store(builder.load(total[r][c]), y_data, here)
            return context.get_dummy_value()

        return types.void(*arguments), generate

    return tile


_tile_2x4, _tile_1x4 = _tile(2, 4), _tile(1, 4)
_tile_4x1, _tile_1x1 = _tile(4, 1), _tile(1, 1)


@jit
def _multiply(matrix, m0, rows, length, x, x0, x_row, x_column, y, y0, y_row, y_column, columns):
    """y[r, c] = sum_j matrix[r, j] x[j, c] of vectors; offsets in numbers."""
    c = 0
    while c + 4 <= columns:
        xc, yc = x0 + c * x_column, y0 + c * y_column
        r = 0
        while r + 2 <= rows:
            _tile_2x4(
                matrix, m0 + r * length, length, length, x, xc, x_row, x_column,
                y, yc + r * y_row, y_row, y_column,
            )  # fmt: skip
            r += 2
        if r < rows:
            _tile_1x4(
                matrix, m0 + r * length, length, length, x, xc, x_row, x_column,
                y, yc + r * y_row, y_row, y_column,
            )  # fmt: skip
        c += 4
    while c < columns:
        xc, yc = x0 + c * x_column, y0 + c * y_column
        r = 0
        while r + 4 <= rows:
            _tile_4x1(
                matrix, m0 + r * length, length, length, x, xc, x_row, x_column,
                y, yc + r * y_row, y_row, y_column,
            )  # fmt: skip
            r += 4
        while r < rows:
            _tile_1x1(
                matrix, m0 + r * length, length, length, x, xc, x_row, x_column,
                y, yc + r * y_row, y_row, y_column,
            )  # fmt: skip
            r += 1
        c += 1


@intrinsic
def _combine(typingctx: Any, x: Any, real: Any, r0: Any, y: Any, complex_: Any, c0: Any) -> Any:
    """Four complex frequencies (+-kx, +-ky, kz) from the eight sums with cos and sin.

    real[r0 : r0 + 8] are offsets of the sums in x, numbered 4 X + 2 Y + Z (0 cos, 1 sin);
    complex_[c0 : c0 + 4] offsets in y of (+, +), (+, -), (-, +), (-, -).
    """
    arguments = (x, real, types.intp, y, complex_, types.intp)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vectors = _Vectors(context, builder, x)
        x_data, r_data, y_data, c_data = (
            _data(context, builder, signature.args[i], args[i]) for i in (0, 1, 3, 4)
        )
        r = [vectors.load(x_data, _integer(builder, r_data, args[2], i)) for i in range(8)]
        add, sub = vectors.add, vectors.subtract

        def plus_minus(a: Any, b: Any) -> tuple[Any, Any]:
            """a - i b and a + i b."""
            return (
                (add(a[0], b[1]), sub(a[1], b[0])),
                (sub(a[0], b[1]), add(a[1], b[0])),
            )

        parts = [(r[2 * i], sub(vectors.zero, r[2 * i + 1])) for i in range(4)]
        c_plus, c_minus = plus_minus(parts[0], parts[1])
        s_plus, s_minus = plus_minus(parts[2], parts[3])
        pp, mp = plus_minus(c_plus, s_plus)
        pm, mm = plus_minus(c_minus, s_minus)
        for i, value in enumerate((pp, pm, mp, mm)):
            here = _integer(builder, c_data, args[5], i)
            vectors.store(value[0], y_data, here)
            width = ir.Constant(here.type, vectors.lanes)
            vectors.store(value[1], y_data, builder.add(here, width))
        return context.get_dummy_value()

    return types.void(*arguments), generate


@intrinsic
def _separate(typingctx: Any, y: Any, complex_: Any, c0: Any, x: Any, real: Any, r0: Any) -> Any:
    """The transpose of `_combine`: eight sums from four complex frequencies."""
    arguments = (y, complex_, types.intp, x, real, types.intp)

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vectors = _Vectors(context, builder, y)
        y_data, c_data, x_data, r_data = (
            _data(context, builder, signature.args[i], args[i]) for i in (0, 1, 3, 4)
        )
        values = []
        for i in range(4):
            here = _integer(builder, c_data, args[2], i)
            width = ir.Constant(here.type, vectors.lanes)
            values.append(
                (vectors.load(y_data, here), vectors.load(y_data, builder.add(here, width)))
            )
        add, sub = vectors.add, vectors.subtract
        pp, pm, mp, mm = values

        def transposed(plus: Any, minus: Any) -> tuple[Any, Any]:
            """plus + minus and i (plus - minus)."""
            total = (add(plus[0], minus[0]), add(plus[1], minus[1]))
            turned = (sub(minus[1], plus[1]), sub(plus[0], minus[0]))
            return total, turned

        c_plus, s_plus = transposed(pp, mp)
        c_minus, s_minus = transposed(pm, mm)
        parts = [*transposed(c_plus, c_minus), *transposed(s_plus, s_minus)]
        for i, (re, im) in enumerate(parts):
            vectors.store(re, x_data, _integer(builder, r_data, args[5], 2 * i))
            opposite = vectors.subtract(vectors.zero, im)
            vectors.store(opposite, x_data, _integer(builder, r_data, args[5], 2 * i + 1))
        return context.get_dummy_value()

    return types.void(*arguments), generate


def _integer(builder: Any, data: Any, base: Any, i: int) -> Any:
    """data[base + i]."""
    return builder.load(builder.gep(data, [builder.add(base, ir.Constant(base.type, i))]))


@intrinsic
def _transpose(typingctx: Any, x: Any, x0: Any, x_row: Any, y: Any, y0: Any, y_row: Any) -> Any:
    """y[i, j] = x[j, i] of squares of lanes x lanes numbers with these distances of rows."""
    n = types.intp

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vectors = _Vectors(context, builder, x)
        x_data = _data(context, builder, x, args[0])
        y_data = _data(context, builder, y, args[3])

        def at(base: Any, step: Any, k: int) -> Any:
            return builder.add(base, builder.mul(step, ir.Constant(step.type, k)))

        rows = [vectors.load(x_data, at(args[1], args[2], k)) for k in range(vectors.lanes)]
        for k, row in enumerate(vectors.transpose(rows)):
            vectors.store(row, y_data, at(args[4], args[5], k))
        return context.get_dummy_value()

    return types.void(x, n, n, y, n, n), generate


@intrinsic
def _copy_transposed(
    typingctx: Any, x: Any, x0: Any, rows: Any, first: Any, y: Any, y0: Any
) -> Any:
    """y[i, j] = x[rows[first + j] + x0 + i] for a square of lanes x lanes numbers."""
    n = types.intp

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vectors = _Vectors(context, builder, x)
        x_data, row_data, y_data = (
            _data(context, builder, signature.args[i], args[i]) for i in (0, 2, 4)
        )
        columns = []
        for k in range(vectors.lanes):
            row = _integer(builder, row_data, args[3], k)
            columns.append(vectors.load(x_data, builder.add(row, args[1])))
        for k, row in enumerate(vectors.transpose(columns)):
            place = builder.add(args[5], ir.Constant(args[5].type, k * vectors.lanes))
            vectors.store(row, y_data, place)
        return context.get_dummy_value()

    return types.void(x, n, rows, n, y, n), generate


@intrinsic
def _add_transposed(
    typingctx: Any, x: Any, x0: Any, scale: Any, y: Any, y0: Any, rows: Any, first: Any
) -> Any:
    """y[rows[first + j] + y0 + i] += scale x[x0 + i lanes + j] for a square of numbers."""
    n = types.intp

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vectors = _Vectors(context, builder, x)
        x_data, y_data, row_data = (
            _data(context, builder, signature.args[i], args[i]) for i in (0, 3, 5)
        )
        factor = vectors.spread(args[2])
        columns = []
        for k in range(vectors.lanes):
            place = builder.add(args[1], ir.Constant(args[1].type, k * vectors.lanes))
            columns.append(vectors.load(x_data, place))
        for k, column in enumerate(vectors.transpose(columns)):
            here = builder.add(_integer(builder, row_data, args[6], k), args[4])
            old = vectors.load(y_data, here)
            vectors.store(vectors.add_product(factor, column, old), y_data, here)
        return context.get_dummy_value()

    return types.void(x, n, x.dtype, y, n, rows, n), generate


@jit_threads
def forward(
    values, rows, matrix_z, matrix, size, real, complex_, places, scratch, lanes, n_blocks,
    spectra, n_rows,
):  # fmt: skip
    """Spectra of rows of values on a grid, for the frequencies of some kz.

    values : flat, row r is values[rows[r] : rows[r] + size^3] in order x, y, z
    rows : (k lanes,) offsets in values, one for each lane of each sweep
    matrix_z : (2 m, size) cos and then sin for the kz wanted; matrix : (2 l - 1, size) likewise
        for all k = 0..l - 1 (sin from k = 1)
    real, complex_ : offsets of each (kx, ky, kz) >= 0 for `_combine`
    places : offsets in the work space of its parts b, c, d and of zeros (two vectors)
    scratch : (threads, numbers) work space
    spectra : flat, [block][row][re, im][lanes], n_rows rows in a block
    """
    workers = scratch.shape[0]
    sweeps = len(rows) // lanes
    for worker in prange(workers):
        work = scratch[worker]
        for sweep in range(sweeps * worker // workers, sweeps * (worker + 1) // workers):
            _transform_rows(
                values, rows, sweep * lanes, matrix_z, matrix, size, real, complex_, work, places,
                lanes, n_blocks, spectra, n_rows,
            )  # fmt: skip


@jit
def _transform_rows(
    values, rows, first, matrix_z, matrix, size, real, complex_, work, places, lanes,
    n_blocks, spectra, n_rows,
):  # fmt: skip
    n_z, n = matrix_z.shape[0], matrix.shape[0]
    flat_z, flat = matrix_z.reshape(-1), matrix.reshape(-1)
    b, c, d, zero = places
    _gather(values, rows, first, size * size * size, work, lanes)
    _multiply(
        flat_z, 0, n_z, size, work, 0, lanes, size * lanes,
        work, d, lanes, n_z * lanes, size * size,
    )  # fmt: skip
    for x in range(size):
        _multiply(
            flat, 0, n, size, work, d + x * size * n_z * lanes, n_z * lanes, lanes,
            work, b + x * n * n_z * lanes, n_z * lanes, lanes, n_z,
        )  # fmt: skip
    _multiply(
        flat, 0, n, size, work, b, n * n_z * lanes, lanes, work, c, n * n_z * lanes, lanes, n * n_z,
    )  # fmt: skip
    work[zero : zero + 2 * lanes] = 0.0
    for k in range(len(real) // 8):
        _combine(work, real, k * 8, work, complex_, k * 4)
    for block in range(n_blocks):
        for part in range(2):
            _transpose(
                work, d + (2 * block * lanes + part) * lanes, 2 * lanes,
                spectra, ((block * n_rows + first) * 2 + part) * lanes, 2 * lanes,
            )  # fmt: skip


@jit
def _gather(values, rows, first, count, work, lanes):
    """work[node, lane] = value of the row of the lane at the node."""
    whole = count - count % lanes
    for node in range(0, whole, lanes):
        _copy_transposed(values, node, rows, first, work, node * lanes)
    for lane in range(lanes):
        start = rows[first + lane]
        for node in range(whole, count):
            work[node * lanes + lane] = values[start + node]


@jit_threads
def backward(
    spectra, n_rows, matrix_z, matrix, size, real, complex_, places, scratch, lanes,
    n_blocks, scale, rows, used, values,
):  # fmt: skip
    """Add to rows of values the inverse transform of the frequencies of some kz.

    The arguments are those of `forward`, with matrices transposed; lanes from `used` on in the
    last sweep belong to no row. The weights of the frequencies are in the tables.
    """
    workers = scratch.shape[0]
    sweeps = len(rows) // lanes
    for worker in prange(workers):
        work = scratch[worker]
        for sweep in range(sweeps * worker // workers, sweeps * (worker + 1) // workers):
            _restore_rows(
                spectra, n_rows, sweep * lanes, matrix_z, matrix, size, real, complex_, work,
                places, lanes, n_blocks, scale, rows, used, values,
            )  # fmt: skip


@jit
def _restore_rows(
    spectra, n_rows, first, matrix_z, matrix, size, real, complex_, work, places, lanes,
    n_blocks, scale, rows, used, values,
):  # fmt: skip
    n_z, n = matrix_z.shape[1], matrix.shape[1]
    flat_z, flat = matrix_z.reshape(-1), matrix.reshape(-1)
    b, c, d, zero = places
    for block in range(n_blocks):
        for part in range(2):
            _transpose(
                spectra, ((block * n_rows + first) * 2 + part) * lanes, 2 * lanes,
                work, d + (2 * block * lanes + part) * lanes, 2 * lanes,
            )  # fmt: skip
    work[zero : zero + 2 * lanes] = 0.0
    for k in range(len(real) // 8):
        _separate(work, complex_, k * 4, work, real, k * 8)
    _multiply(
        flat, 0, size, n, work, c, n * n_z * lanes, lanes, work, b, n * n_z * lanes, lanes, n * n_z,
    )  # fmt: skip
    for x in range(size):
        _multiply(
            flat, 0, size, n, work, b + x * n * n_z * lanes, n_z * lanes, lanes,
            work, d + x * size * n_z * lanes, n_z * lanes, lanes, n_z,
        )  # fmt: skip
    _multiply(
        flat_z, 0, size, n_z, work, d, lanes, n_z * lanes,
        work, 0, lanes, size * lanes, size * size,
    )  # fmt: skip
    _scatter(work, size * size * size, lanes, scale, rows, first, used, values)


@jit
def _scatter(work, count, lanes, scale, rows, first, used, values):
    """Add scale work[node, lane] to the row of the lane at the node."""
    whole = count - count % lanes if first + lanes <= used else 0
    for node in range(0, whole, lanes):
        _add_transposed(work, node * lanes, scale, values, node, rows, first)
    for lane in range(min(lanes, used - first)):
        start = rows[first + lane]
        for node in range(whole, count):
            values[start + node] += scale * work[node * lanes + lane]


def _parents_to_children(count: int, gather: bool) -> Any:
    """Make the sums of `count` pairs of children along z, or their transpose."""

    @intrinsic
    def move(
        typingctx: Any, x: Any, x0: Any, children: Any, c0: Any, order: Any, o0: Any, y: Any,
        y0: Any, stride: Any, vectors_each: Any,
    ) -> Any:  # fmt: skip
        """Children are at x0 + children[c0 + order[o0 + 2 k + upper]], k < count.

        Gather: y[y0 + (0, 1, 2) stride] = lower + upper, lower, upper, summed over k.
        Else lower += y_0 + y_2, upper += y_0 + y_1 with the same y, for each k.
        """
        n = types.intp

        def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            v = _Vectors(context, builder, x)
            x_data, c_data, o_data, y_data = (
                _data(context, builder, signature.args[i], args[i]) for i in (0, 2, 4, 6)
            )
            boxes = []
            for k in range(2 * count):
                octant = builder.add(args[3], _integer(builder, o_data, args[5], k))
                boxes.append(builder.add(args[1], builder.load(builder.gep(c_data, [octant]))))
            products = [
                builder.add(args[7], builder.mul(args[8], ir.Constant(args[8].type, k)))
                for k in range(3)
            ]
            with cgutils.for_range(builder, args[9], intp=args[9].type) as loop:
                shift = builder.mul(loop.index, ir.Constant(args[9].type, v.lanes))
                at = [builder.add(box, shift) for box in boxes]
                to = [builder.add(product, shift) for product in products]
                if gather:
                    lower, upper = (v.load(x_data, at[k]) for k in range(2))
                    for k in range(1, count):
                        lower = v.add(lower, v.load(x_data, at[2 * k]))
                        upper = v.add(upper, v.load(x_data, at[2 * k + 1]))
                    for place, value in zip(to, (v.add(lower, upper), lower, upper), strict=True):
                        v.store(value, y_data, place)
                else:
                    both, first, second = (v.load(y_data, place) for place in to)
                    terms = (v.add(both, second), v.add(both, first))
                    for k in range(2 * count):
                        v.store(v.add(v.load(x_data, at[k]), terms[k % 2]), x_data, at[k])
            return context.get_dummy_value()

        return types.void(x, n, children, n, order, n, y, n, n, n), generate

    return move


_gather_1, _gather_2, _gather_4 = (_parents_to_children(k, True) for k in (1, 2, 4))
_spread_1, _spread_2, _spread_4 = (_parents_to_children(k, False) for k in (1, 2, 4))


@jit
def _expand(tables, t0, size, lanes, stored, parity, full):
    """Tables of all 343 vectors of a block, those of mirrored ones by K_-v = parity conj(K_v).

    stored : (343,) number in tables, -1 - number of the mirrored vector, or -1000 for none
    """
    for v in range(len(stored)):
        at = v * size
        if stored[v] == -1000:
            full[at : at + size] = 0.0
        elif stored[v] >= 0:
            start = t0 + stored[v] * size
            for i in range(size):
                full[at + i] = tables[start + i]
        else:
            start = t0 + (-1 - stored[v]) * size
            for k in range(size // (2 * lanes)):
                j = 2 * lanes * k
                for i in range(lanes):
                    full[at + j + i] = parity * tables[start + j + i]
                    full[at + j + lanes + i] = -parity * tables[start + j + lanes + i]


@jit_threads
def translate_pairs(
    tables, table_stride, table_size, lanes, stored, parity, scratch, n_blocks, spectra,
    spectra_stride, steps, start, target, entry, n_in, n_out, local, local_stride,
):  # fmt: skip
    """Spectra of locals, target by target: L_t = sum over the sources s of t of K_v M_s.

    tables : flat [block][stored vector][component][re, im][lanes], table_size numbers a vector
    steps : flat, (offset of the vector in the expanded tables, offset of the source) of each pair
    start, target : pairs start[k] : start[k + 1] belong to the target at the offset target[k];
        ordered so that one after another use tables of few vectors
    entry : (n_out n_in,) offset of each entry in a table
    """
    workers = scratch.shape[0]
    for worker in prange(workers):
        full = scratch[worker]
        for block in range(n_blocks * worker // workers, n_blocks * (worker + 1) // workers):
            m0, l_first = block * spectra_stride, block * local_stride
            _expand(tables, block * table_stride, table_size, lanes, stored, parity, full)
            local[l_first : l_first + local_stride] = 0.0
            for k in range(len(target)):
                l0 = l_first + target[k]
                i = 0
                while i + 3 <= n_out:
                    _add_sums_three(
                        full, 0, spectra, m0, steps, start[k], start[k + 1],
                        entry, i * n_in, n_in, local, l0 + 2 * lanes * i, 0,
                    )  # fmt: skip
                    i += 3
                while i < n_out:
                    _add_sums_one(
                        full, 0, spectra, m0, steps, start[k], start[k + 1],
                        entry, i * n_in, n_in, local, l0 + 2 * lanes * i, 0,
                    )  # fmt: skip
                    i += 1


@intrinsic
def _difference(
    typingctx: Any, x: Any, rows: Any, first: Any, y: Any, y0: Any, stride: Any, count: Any
) -> Any:
    """Tables of the 27 products of one direction from those of 27 vectors.

    x[rows[first + e]] is the table of vector e = (ex, ey, ez), ex slowest; that of product w goes
    to y[y0 + w stride]. Along one axis (b, a, c) becomes (a, c - a, b - a).
    """
    n = types.intp

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        v = _Vectors(context, builder, x)
        x_data, row_data, y_data = (
            _data(context, builder, signature.args[i], args[i]) for i in (0, 1, 3)
        )
        sources = [_integer(builder, row_data, args[2], e) for e in range(27)]
        with cgutils.for_range(builder, args[6], intp=args[6].type) as loop:
            shift = builder.mul(loop.index, ir.Constant(args[6].type, v.lanes))
            t = [v.load(x_data, builder.add(source, shift)) for source in sources]
            for axis in (9, 3, 1):
                for e in (e for e in range(27) if e // axis % 3 == 0):
                    b, a, c = t[e], t[e + axis], t[e + 2 * axis]
                    t[e], t[e + axis], t[e + 2 * axis] = a, v.subtract(c, a), v.subtract(b, a)
            place = builder.add(args[4], shift)
            for table in t:
                v.store(table, y_data, place)
                place = builder.add(place, args[5])
        return context.get_dummy_value()

    return types.void(x, rows, n, y, n, n, n), generate


@jit
def _differences(full, size, lanes, rows, products):
    """Tables of the 27 products for each direction of parents, from those of the 343 vectors.

    Along one axis, with a, b, c for boxes at the distances 2 D, 2 D - 1 and 2 D + 1:
    y_0 = a x_0 + b x_1 and y_1 = c x_0 + a x_1 are P_0 + P_2 and P_0 + P_1 of
    P_0 = a (x_0 + x_1), P_1 = (c - a) x_0, P_2 = (b - a) x_1.

    rows : (27 directions,) offset in `full` of the vectors of each direction
    """
    directions = len(rows) // 27
    for k in range(directions):
        _difference(full, rows, 27 * k, products, k * size, directions * size, size // lanes)


@jit_threads
def translate_families(
    tables, table_stride, table_size, lanes, stored, parity, rows, scratch, n_blocks,
    spectra, spectra_stride, source_children, steps, start, group, entry, n_in, n_out, local,
    local_stride, target_children, order, places,
):  # fmt: skip
    """Spectra of locals, the eight children of a box together: 27 products for 64 pairs.

    Between the children of two boxes the transfer is a Toeplitz matrix in each direction, which
    takes three products of sums of children instead of four (Karatsuba's trick, transposed).
    Pairs too close to interact have zero tables, which keeps the structure.

    rows : (27 k,) offsets of the vectors in the expanded tables for k directions of parents
    steps : flat rows of (offset of the direction in the tables of a product, offsets of `group`
        source parents); start : (groups + 1,)
    source_children : (8 parents,) offset in a block of the spectra, of zeros where there is none
    target_children : likewise in local, parents of a group one after another
    order : (2, 9, 8) octants of sources, of targets, for the products (wx, wy), lower z first
    """
    workers = scratch.shape[0]
    groups, parents = len(start) - 1, len(source_children) // 8
    out_size, in_size = n_out * 2 * lanes, n_in * 2 * lanes
    in_stride, out_stride = (parents + 1) * in_size, group * out_size
    product_size = len(rows) // 27 * table_size
    octants = order.reshape(-1)
    for worker in prange(workers):
        work = scratch[worker]
        full = work[places[0] : places[1]]
        products = work[places[1] : places[2]]
        sources = work[places[2] : places[3]]
        sums = work[places[3] : places[4]]
        for k in range(3):
            sources[(k + 1) * in_stride - in_size : (k + 1) * in_stride] = 0.0
        for block in range(n_blocks * worker // workers, n_blocks * (worker + 1) // workers):
            m0, l_first = block * spectra_stride, block * local_stride
            _expand(tables, block * table_stride, table_size, lanes, stored, parity, full)
            _differences(full, table_size, lanes, rows, products)
            local[l_first : l_first + local_stride] = 0.0
            for w in range(9):
                _gather_children(
                    w, spectra, m0, source_children, octants, sources, in_size, in_stride,
                    lanes,
                )  # fmt: skip
                for g in range(groups):
                    for z in range(3):
                        _sum_group(
                            products, (3 * w + z) * product_size, sources, z * in_stride,
                            steps, start[g], start[g + 1], group, entry, n_in, n_out,
                            sums, z * out_stride, out_size, lanes,
                        )  # fmt: skip
                    _spread_children(
                        w, local, l_first, target_children, g * group, group, octants, sums,
                        out_size, out_stride, lanes,
                    )  # fmt: skip


@jit
def _pairs_of_children(w):
    """Pairs of children along z in the products (wx, wy) = (w // 3, w % 3)."""
    return (2 - min(w // 3, 1)) * (2 - min(w % 3, 1))


@jit
def _gather_children(w, spectra, m0, children, octants, sources, size, stride, lanes):
    """Sums of children of every source parent that the products with w need, for z = 0, 1, 2."""
    pairs, order, vectors = _pairs_of_children(w), w * 8, size // lanes
    for p in range(len(children) // 8):
        c, at = 8 * p, p * size
        if pairs == 4:
            _gather_4(spectra, m0, children, c, octants, order, sources, at, stride, vectors)
        elif pairs == 2:
            _gather_2(spectra, m0, children, c, octants, order, sources, at, stride, vectors)
        else:
            _gather_1(spectra, m0, children, c, octants, order, sources, at, stride, vectors)


@jit
def _spread_children(w, local, l0, children, first, group, octants, sums, size, stride, lanes):
    """Add the products with w to the children of the target parents from `first` on."""
    pairs, order, vectors = _pairs_of_children(w), 72 + w * 8, size // lanes
    for k in range(group):
        c, at = 8 * (first + k), k * size
        if pairs == 4:
            _spread_4(local, l0, children, c, octants, order, sums, at, stride, vectors)
        elif pairs == 2:
            _spread_2(local, l0, children, c, octants, order, sums, at, stride, vectors)
        else:
            _spread_1(local, l0, children, c, octants, order, sums, at, stride, vectors)


@jit
def _sum_group(
    products, table, sources, m0, steps, first, last, group, entry, n_in, n_out, sums, l0, size,
    lanes,
):  # fmt: skip
    """One of the 27 products of a group of target parents, all outputs."""
    if group == GROUP_THREE:
        for i in range(0, n_out, 3):
            _sums_group_three(
                products, table, sources, m0, steps, first, last,
                entry, i * n_in, n_in, sums, l0 + 2 * lanes * i, size,
            )  # fmt: skip
    else:
        for i in range(n_out):
            _sums_group(
                products, table, sources, m0, steps, first, last,
                entry, i * n_in, n_in, sums, l0 + 2 * lanes * i, size,
            )  # fmt: skip
