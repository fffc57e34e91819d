"""Linear algebra of small matrices, unrolled into operations of their entries.

A vector is a list, a matrix a list of rows. An entry is whatever has arithmetic: a number, an
array with one value for each chain, a row of a right-hand side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

Entry = Any
Vector = Sequence[Entry]
Matrix = Sequence[Vector]
Operation = Callable[[Entry, Entry], Entry]


def dot(a: Vector, b: Vector) -> Entry:
    """a'b."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def minus_dot(total: Entry, a: Vector, b: Vector) -> Entry:
    """total - a'b, product by product."""
    for x, y in zip(a, b, strict=True):
        total = total - x * y
    return total


def transpose(A: Matrix) -> list[Vector]:
    """A'."""
    return [list(column) for column in zip(*A, strict=True)]


def matvec(A: Matrix, x: Vector) -> list[Entry]:
    """A x."""
    return [dot(row, x) for row in A]


def matmul(A: Matrix, B: Matrix) -> list[Vector]:
    """A B."""
    columns = transpose(B)
    return [[dot(row, column) for column in columns] for row in A]


def add(a: Vector, b: Vector) -> list[Entry]:
    """a + b of vectors."""
    return [x + y for x, y in zip(a, b, strict=True)]


def symmetric(A: Matrix) -> list[Vector]:
    """1/2 (A + A')."""
    n = range(len(A))
    return [[A[i][i] if i == j else 0.5 * (A[i][j] + A[j][i]) for j in n] for i in n]


def cholesky(
    A: Matrix,
    root: Callable[[Entry], Entry],
    divide: Operation,
    minus_dot: Callable[[Entry, Vector, Vector], Entry] = minus_dot,
) -> list[Vector]:
    """The rows of L with L L' = A, each up to its diagonal; only A's lower triangle is read.

    Args:
        A: (n, n), positive definite.
        root: the diagonal entry to keep, of its square.
        divide: a number by a diagonal entry as `root` keeps it.
    """
    L: list[Vector] = []
    for i in range(len(A)):
        row: list[Entry] = []
        for j in range(i + 1):
            rest = minus_dot(A[i][j], row, row if i == j else L[j][:j])
            row.append(root(rest) if i == j else divide(rest, L[j][j]))
        L.append(row)
    return L


def solve_lower(
    L: Matrix,
    b: Vector,
    divide: Operation,
    minus_dot: Callable[[Entry, Vector, Vector], Entry] = minus_dot,
) -> list[Entry]:
    """L^{-1} b for lower triangular L, of which nothing above the diagonal is read."""
    x: list[Entry] = []
    for i, row in enumerate(L):
        x.append(divide(minus_dot(b[i], row[:i], x), row[i]))
    return x


def solve_upper(L: Matrix, b: Vector, divide: Operation) -> list[Entry]:
    """L'^{-1} b for lower triangular L, of which nothing above the diagonal is read."""
    n = len(L)
    x = list(b)
    for i in reversed(range(n)):
        column = [L[k][i] for k in range(i + 1, n)]
        x[i] = divide(minus_dot(b[i], column, x[i + 1 :]), L[i][i])
    return x
