"""Damped normal equations of a large network, solved through a sketch of their few large eigenvalues.

A network's residuals depend strongly on few combinations of its weights: of the 4,483 shared columns of URP_GB2 the
normal matrix has about 160 eigenvalues above the damping, and three quarters are numerically zero. The equations
`(K + D) x = g` are solved by conjugate gradients, whose products with `K = A^T (I - P) A` cost no more than reading the
Jacobian, preconditioned by Nystroem's approximation of K from its products with random vectors (Frangella, Tropp and
Udell 2023, "Randomized Nystroem preconditioning", SIAM J. Matrix Anal. Appl. 44(2)); a few iterations make the
solution exact. A are the shared columns; I - P removes what the trajectories' own columns account for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gbspec.arrays import Array
from gbspec.training.problem import Integers

LEAST = 2000
"""With fewer residuals or shared columns, factorising the matrices is as fast."""
FIRST_RANK, SHARE = 256, 0.25
"""Random vectors of the first sketch; doubled, up to this share of the columns, until its spectrum reaches the
damping."""
BELOW = 10.0
"""The smallest eigenvalue of a sketch must lie below this multiple of the damping, which bounds the number of
iterations."""
TOLERANCE, ITERATIONS = 1e-10, 60
"""Relative size of the last residual, in the preconditioner's norm, and the most iterations."""
TRUE = 1e-6
"""Largest relative residual of a returned solution, in the Euclidean norm."""


class TooSlowError(Exception):
    """The sketch is too slow: the spectrum decays too slowly for this damping, or the equations are nearly singular."""


@dataclass(frozen=True)
class Blocks:
    """The trajectories' own columns: values [m, n_local], `owner` [m] of each row, number of trajectories."""

    values: Tensor
    owner: Tensor
    trajectories: int

    @classmethod
    def of(cls, values: Array, owner: Integers, trajectories: int) -> Blocks:
        """The blocks of given arrays."""
        return cls(torch.from_numpy(values), torch.from_numpy(owner), trajectories)

    def transposed(self, rows: Tensor) -> Tensor:
        """The product [N, n_local, k] of the blocks' transpose with `rows` [m, k]."""
        out = rows.new_zeros((self.trajectories, self.values.shape[1], rows.shape[1]))
        for i in range(self.values.shape[1]):  # one column at a time: all products together would be too large
            out[:, i].index_add_(0, self.owner, self.values[:, i : i + 1] * rows)
        return out

    def times(self, columns: Tensor) -> Tensor:
        """The product [m, k] of the blocks with `columns` [N, n_local, k]."""
        out = self.values.new_zeros((len(self.values), columns.shape[2]))
        for i in range(self.values.shape[1]):
            out += self.values[:, i : i + 1] * columns[:, i][self.owner]
        return out

    def inverses(self, damping: Tensor) -> Tensor:
        """Inverses [N, n_local, n_local] of the blocks' normal matrices with diagonals `damping` [N, n_local] added.

        Raises TooSlowError if one of them is numerically singular.
        """
        n = self.values.shape[1]
        grams = self.values.new_zeros((self.trajectories, n, n))
        grams.index_add_(0, self.owner, self.values[:, :, None] * self.values[:, None, :])
        inverses, info = torch.linalg.inv_ex(grams + torch.diag_embed(damping))
        if bool((info != 0).any()):
            raise TooSlowError
        return Tensor(inverses)


class Sketch:
    """The equations of one linearisation, for any damping.

    `shared` [m, n]: the weighted Jacobian's columns A; the trajectories' own columns are `blocks`.
    """

    def __init__(self, shared: Array, blocks: Blocks) -> None:
        self.shared, self.blocks = torch.from_numpy(shared), blocks
        self._vectors: Tensor | None = None
        self._values: Tensor | None = None
        self._prepared: tuple[Tensor, Tensor, _Preconditioner] | None = None

    def solve(self, gradient: Array, damping: Array) -> Array:
        """(J^T J + D)^-1 g [size], shared entries first, then trajectory by trajectory.

        Raises TooSlowError if another method should be used.
        """
        n, count = self.shared.shape[1], self.blocks.trajectories
        g = torch.from_numpy(gradient)
        shared, local = self._solve(g[:n, None], g[n:].reshape(count, -1, 1), torch.from_numpy(damping))
        return np.concatenate([shared.numpy().ravel(), local.numpy().ravel()])

    def quadratic(self, rows: Array, damping: Array) -> float:
        """Sum over the columns r of `rows` [m, k] of r^T J (J^T J + D)^-1 J^T r. Raises TooSlowError."""
        given = torch.from_numpy(rows)
        shared, local = self.shared.T @ given, self.blocks.transposed(given)
        x_shared, x_local = self._solve(shared, local, torch.from_numpy(damping))
        return float((shared * x_shared).sum() + (local * x_local).sum())

    def _solve(self, shared: Tensor, local: Tensor, damping: Tensor) -> tuple[Tensor, Tensor]:
        """The solutions [n, k] and [N, n_local, k] for k right-hand sides."""
        n, blocks = self.shared.shape[1], self.blocks
        inverse, precondition = self._prepare(damping)
        right = shared - self.shared.T @ blocks.times(torch.bmm(inverse, local))
        x = self._conjugate_gradients(right, damping[:n], inverse, precondition)
        return x, torch.bmm(inverse, local - blocks.transposed(self.shared @ x))

    # ---------------------------------------------------------------- the operator
    def _apply(self, columns: Tensor, inverse: Tensor) -> Tensor:
        """The product of K with `columns` [n, k]."""
        rows = self.shared @ columns
        rows -= self.blocks.times(torch.bmm(inverse, self.blocks.transposed(rows)))
        return self.shared.T @ rows

    def _conjugate_gradients(
        self, right: Tensor, damping: Tensor, inverse: Tensor, precondition: _Preconditioner
    ) -> Tensor:
        """Conjugate gradients for all columns simultaneously, with separate step lengths, until all have converged.

        Raises TooSlowError if they do not converge, or if only the recursively updated residual does, which deviates
        from the true one near rounding.
        """
        x, residual = torch.zeros_like(right), right.clone()
        z = precondition(residual)
        direction, energy = z.clone(), (residual * z).sum(0)
        goal = TOLERANCE**2 * energy
        for _ in range(ITERATIONS):
            if not bool((energy > goal).any()):
                break
            product = self._apply(direction, inverse) + damping[:, None] * direction
            length = _ratio(energy, (direction * product).sum(0))
            x += length * direction
            residual -= length * product
            z = precondition(residual)
            before, energy = energy, (residual * z).sum(0)
            direction = z + _ratio(energy, before) * direction
        else:
            raise TooSlowError
        left = right - self._apply(x, inverse) - damping[:, None] * x
        if not bool((torch.linalg.vector_norm(left, dim=0) <= TRUE * torch.linalg.vector_norm(right, dim=0)).all()):
            raise TooSlowError
        return x

    # ---------------------------------------------------------------- the preconditioner
    def _prepare(self, damping: Tensor) -> tuple[Tensor, _Preconditioner]:
        """The inverses of the trajectories' blocks and the preconditioner, kept for the next solution."""
        if self._prepared is None or not torch.equal(self._prepared[0], damping):
            n, blocks = self.shared.shape[1], self.blocks
            inverse = blocks.inverses(damping[n:].reshape(blocks.trajectories, -1))
            self._prepared = damping, inverse, self._preconditioner(damping[:n], inverse)
        return self._prepared[1:]

    def _preconditioner(self, damping: Tensor, inverse: Tensor) -> _Preconditioner:
        typical = float(damping.median())
        while self._values is None or float(self._values[-1]) > BELOW * typical:
            rank = FIRST_RANK if self._values is None else 2 * len(self._values)
            if rank > SHARE * min(self.shared.shape):
                raise TooSlowError
            self._vectors, self._values = self._nystroem(rank, inverse)
        if self._vectors is None:
            raise TooSlowError
        return _Preconditioner(self._vectors, self._values, damping)

    def _nystroem(self, rank: int, inverse: Tensor) -> tuple[Tensor, Tensor]:
        """Eigenvectors [n, rank] and eigenvalues, decreasing, of the approximation (the paper's algorithm 2.1)."""
        random = np.random.default_rng([59, rank])
        test = torch.from_numpy(random.standard_normal((self.shared.shape[1], rank)))
        test = torch.linalg.qr(test)[0]
        product = self._apply(test, inverse)
        shift = torch.finfo(product.dtype).eps * float(torch.linalg.matrix_norm(product))
        product += shift * test
        core = test.T @ product
        factor, info = torch.linalg.cholesky_ex(0.5 * (core + core.T))
        if int(info) != 0:
            raise TooSlowError
        root = torch.linalg.solve_triangular(factor, product.T, upper=False).T
        q, r = torch.linalg.qr(root)
        if not bool(torch.isfinite(r).all()):
            raise TooSlowError
        u, s, _ = torch.linalg.svd(r)
        return q @ u, (s**2 - shift).clamp(min=0.0)


class _Preconditioner:
    """The inverse of `U S U^T + D` (Woodbury), with any positive diagonal D."""

    def __init__(self, vectors: Tensor, values: Tensor, damping: Tensor) -> None:
        self.inverse_damping = 1.0 / damping
        weighted = vectors * values.sqrt()  # U S^1/2
        self.scaled = weighted * self.inverse_damping[:, None]
        core = torch.eye(len(values), dtype=vectors.dtype) + weighted.T @ self.scaled
        self.factor, info = torch.linalg.cholesky_ex(core)
        if int(info) != 0:
            raise TooSlowError

    def __call__(self, vector: Tensor) -> Tensor:
        """The inverse times `vector` [n, k]."""
        inner = torch.cholesky_solve(self.scaled.T @ vector, self.factor)
        return self.inverse_damping[:, None] * vector - self.scaled @ inner


def _ratio(above: Tensor, below: Tensor) -> Tensor:
    """Quotients; 0 for columns that are solved exactly."""
    return torch.where(below > 0, above / below, torch.zeros_like(above))
