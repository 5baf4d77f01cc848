# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
# Rotations, small systems of equations, sorting and memory in time, for the other modules here; matrices are rows after rows.

from libc.math cimport NAN, cos, fabs, log, sin, sqrt


# Asks for memory that is needed soon.
cdef extern from *:
    """
    #define STARPOS_FETCH(address) __builtin_prefetch(address)
    """
    void fetch "STARPOS_FETCH"(const void *address) noexcept nogil


cdef enum:
    STRIPS = 128


cdef struct Point:
    double x
    double y
    int row


cdef struct Strips:
    # Strips of equal width, in which points are sorted by x: the first point of each, and the end.
    double least
    double per_px
    int[STRIPS + 1] first


cdef inline double length(double x, double y) noexcept nogil:
    """The length of a vector of neither tiny nor huge numbers; the library's `hypot` takes care of those, and longer."""
    return sqrt(x * x + y * y)


cdef inline void turned(const double *rotation, const double *v, double *out) noexcept nogil:
    """Set `out` (3,) to rotation (3, 3) times v (3,)."""
    cdef int i
    for i in range(3):
        out[i] = rotation[3 * i] * v[0] + rotation[3 * i + 1] * v[1] + rotation[3 * i + 2] * v[2]


cdef inline void turn_by(const double *v, double *rotation) noexcept nogil:
    """Multiply a rotation (3, 3) from the left by one of |v| rad about v (3,) (Rodrigues)."""
    cdef double x = v[0], y = v[1], z = v[2], angle2 = x * x + y * y + z * z, angle = sqrt(angle2)
    cdef double s = sin(angle) / angle if angle > 1e-8 else 1.0
    cdef double c = (1 - cos(angle)) / angle2 if angle > 1e-4 else 0.5 - angle2 / 24
    cdef double[9] by
    cdef double[3] before
    cdef double[3] after
    cdef int i, j
    by[0], by[1], by[2] = 1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y
    by[3], by[4], by[5] = c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x
    by[6], by[7], by[8] = c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)
    for j in range(3):
        for i in range(3):
            before[i] = rotation[3 * i + j]
        turned(by, before, after)
        for i in range(3):
            rotation[3 * i + j] = after[i]


cdef inline void diagonalised(double *a, double *vector, int n, bint graded) noexcept nogil:
    """Make a symmetric matrix a (n, n) diagonal, and set the columns of vector (n, n) to its eigenvectors.

    By Jacobi's rotations (Golub and Van Loan, Matrix Computations (2013), section 8.5).
    graded: small eigenvalues beside large ones keep their digits, as of covariances.
    """
    cdef double off, angle, t, c, s, one, other, size
    cdef int i, j, k, sweep
    for i in range(n * n):
        vector[i] = 1.0 if i % (n + 1) == 0 else 0.0
    for sweep in range(30):
        off = 0.0
        for i in range(n - 1):
            for j in range(i + 1, n):
                size = sqrt(fabs(a[n * i + i] * a[n * j + j])) if graded else fabs(a[n * i + i]) + fabs(a[n * j + j])
                if fabs(a[n * i + j]) <= 1e-17 * size or a[n * i + j] == 0.0:
                    continue
                off += fabs(a[n * i + j])
                angle = (a[n * j + j] - a[n * i + i]) / (2 * a[n * i + j])
                t = (1.0 if angle >= 0 else -1.0) / (fabs(angle) + sqrt(angle * angle + 1))
                c = 1 / sqrt(t * t + 1)
                s = t * c
                for k in range(n):
                    one, other = a[n * k + i], a[n * k + j]
                    a[n * k + i], a[n * k + j] = c * one - s * other, s * one + c * other
                for k in range(n):
                    one, other = a[n * i + k], a[n * j + k]
                    a[n * i + k], a[n * j + k] = c * one - s * other, s * one + c * other
                for k in range(n):
                    one, other = vector[n * k + i], vector[n * k + j]
                    vector[n * k + i], vector[n * k + j] = c * one - s * other, s * one + c * other
        if off == 0.0:
            break


cdef inline void best_rotation(const double *b, double *rotation) noexcept nogil:
    """Set rotation (3, 3) to the one nearest to b (3, 3), the sum of target times source transposed over pairs of vectors.

    Horn's quaternion (1987, J. Opt. Soc. Am. A 4, 629): an eigenvector of a 4 x 4 matrix.
    """
    cdef double[4][4] n
    cdef double[4][4] vector
    cdef double w, x, y, z
    cdef int i, best = 0
    n[0][0] = b[0] + b[4] + b[8]
    n[1][1] = b[0] - b[4] - b[8]
    n[2][2] = -b[0] + b[4] - b[8]
    n[3][3] = -b[0] - b[4] + b[8]
    n[0][1] = n[1][0] = b[7] - b[5]
    n[0][2] = n[2][0] = b[2] - b[6]
    n[0][3] = n[3][0] = b[3] - b[1]
    n[1][2] = n[2][1] = b[3] + b[1]
    n[1][3] = n[3][1] = b[2] + b[6]
    n[2][3] = n[3][2] = b[7] + b[5]
    diagonalised(&n[0][0], &vector[0][0], 4, False)
    for i in range(1, 4):
        if n[i][i] > n[best][best]:
            best = i
    w, x, y, z = vector[0][best], vector[1][best], vector[2][best], vector[3][best]
    rotation[0], rotation[1], rotation[2] = w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)
    rotation[3], rotation[4], rotation[5] = 2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)
    rotation[6], rotation[7], rotation[8] = 2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z


cdef inline double factored(double *a, int n) noexcept nogil:
    """Replace the lower half of a (n, n) by its Cholesky factor; the logarithm of the determinant, NaN if there is none."""
    cdef double total = 0.0, value
    cdef int i, j, k
    for i in range(n):
        for j in range(i + 1):
            value = a[i * n + j]
            for k in range(j):
                value -= a[i * n + k] * a[j * n + k]
            if i > j:
                a[i * n + j] = value / a[j * n + j]
            elif value > 0:
                a[i * n + i] = sqrt(value)
                total += log(value)
            else:
                return NAN
    return total


cdef inline void solved(const double *factor, double *b, int n) noexcept nogil:
    """Replace b (n,) by the solution of the equations of a Cholesky factor (n, n)."""
    cdef int i, k
    for i in range(n):
        for k in range(i):
            b[i] -= factor[i * n + k] * b[k]
        b[i] /= factor[i * n + i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= factor[k * n + i] * b[k]
        b[i] /= factor[i * n + i]


cdef inline double median(double *values, int n) noexcept nogil:
    """The value (n,) that would stand at n // 2 if they were sorted; it disturbs their order.

    Selection by parting them at one of them, again and again; without branches, whose outcome no processor could guess.
    """
    cdef int low = 0, high = n - 1, k = n // 2, i, j
    cdef double pivot, value
    while low < high:
        pivot, i = values[k], low
        for j in range(low, high + 1):
            value, values[j] = values[j], values[i]
            values[i] = value
            i += value < pivot
        if k < i:
            high = i - 1
        elif i > low:
            low = i
        else:
            # none is lower: then those that are equal go first
            for j in range(low, high + 1):
                value, values[j] = values[j], values[i]
                values[i] = value
                i += value <= pivot
            # as many are found, or it is not a number
            if k < i or i == low:
                return pivot
            low = i
    return values[k]


cdef inline double middle(double *values, int n) noexcept nogil:
    """The median of values (n,), between the middle two if n is even; it disturbs their order."""
    cdef double upper = median(values, n), lower = values[0]
    cdef int k
    if n % 2:
        return upper
    for k in range(1, n // 2):
        lower = max(lower, values[k])
    return (lower + upper) / 2


cdef inline (double, double) level_and_scatter(double *values, int n, double per_mad, double uneven) noexcept nogil:
    """The median of values (n,), and their scatter where that is more than `uneven`, else 1; it disturbs them.

    per_mad: sigma over the median of the absolute differences
    """
    cdef double level = middle(values, n), nearest = uneven / per_mad
    cdef int k, near = 0
    for k in range(n):
        values[k] = fabs(values[k] - level)
        near += values[k] <= nearest
    # where most are that near, so is their median
    if near > n // 2:
        return level, 1.0
    cdef double spread = per_mad * middle(values, n)
    return level, spread if spread > uneven else 1.0


cdef inline int strip_of(double x, const Strips *s) noexcept nogil:
    """The strip in which a point lies, or the nearest one."""
    cdef double strip = (x - s.least) * s.per_px
    return <int>max(0.0, min(strip, STRIPS - 1.0))


cdef inline void sort_by_x(Point *points, int n, Point *room, Strips *s) noexcept nogil:
    """Sort points (n,) by x: into strips first, because guesses of a processor about a comparison cost more than these.

    room (n,): to work in.
    """
    cdef double most = -1e300
    cdef int i, j
    cdef Point moved
    s.least = 1e300
    for i in range(n):
        s.least, most = min(s.least, points[i].x), max(most, points[i].x)
    s.per_px = STRIPS / (most - s.least) if most > s.least else 0.0
    for i in range(STRIPS + 1):
        s.first[i] = 0
    for i in range(n):
        s.first[strip_of(points[i].x, s)] += 1
    j = 0
    for i in range(STRIPS):
        j += s.first[i]
        s.first[i] = j
    s.first[STRIPS] = n
    for i in range(n - 1, -1, -1):
        j = strip_of(points[i].x, s)
        s.first[j] -= 1
        room[s.first[j]] = points[i]
    # in its strip a point is nearly in place
    for i in range(n):
        moved, j = room[i], i
        while j > 0 and points[j - 1].x > moved.x:
            points[j] = points[j - 1]
            j -= 1
        points[j] = moved
