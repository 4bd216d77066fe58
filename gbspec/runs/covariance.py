"""The covariance of a member's weights and constants, and where its unknowns were trained: `covariance.safetensors`.

With n weights w, whose prior is normal around zero, and the shared constants k, the posterior of the linearised fit is

    w ~ N(fit, C),      C = spread^2 (I - V^T (I - S) V),      k given w ~ N(fit - B (w - fit), D)

V are the leading eigenvectors of the curvature [m, n] and S the shares of the prior's variance that the data leave
along them; along all other directions the data leave the prior as it is. So a network of thousands of weights takes a
few hundred vectors. The derivative g of any result with respect to (w, k) gives its standard deviation, sqrt(g^T C g).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from gbspec.arrays import Array
from gbspec.json_values import JsonObject
from gbspec.runs import files

COVARIANCE = "covariance.safetensors"


@dataclass(frozen=True)
class Support:
    """The arguments `points` [P, A] with which the fitted trajectories call a network; `owner` [P] counts the
    trajectories."""

    points: Array
    owner: Array

    def __post_init__(self) -> None:
        """Raises ValueError if the arrays do not fit each other, as those of a damaged file."""
        if self.points.ndim != 2 or self.owner.shape != self.points.shape[:1]:
            raise ValueError(f"the arrays of a support have the shapes {self.points.shape}, {self.owner.shape}")


@dataclass(frozen=True)
class Covariance:
    """See the module's documentation; constants in their units.

    `names` are the weights' arrays in the order of w (each flattened row by row), `constants` those in k. `spread` is
    the prior's standard deviation, `vectors` [m, n] and `shares` [m] are V and the diagonal of S, `coupling` [k, n] is
    B, `conditional` [k, k] is D.
    """

    names: tuple[str, ...]
    constants: tuple[str, ...]
    spread: float
    vectors: Array
    shares: Array
    coupling: Array
    conditional: Array

    def __post_init__(self) -> None:
        """Raises ValueError if the arrays do not fit each other, as those of a damaged file."""
        known, (rank, count) = len(self.constants), self.vectors.shape
        shapes = (self.shares.shape, self.coupling.shape, self.conditional.shape)
        if shapes != ((rank,), (known, count), (known, known)):
            raise ValueError(f"the arrays of a covariance have the shapes {(rank, count)}, {shapes}")

    def deviations(self, weights: Array, constants: Array) -> Array:
        """Standard deviations [P] of results with the derivatives `weights` [P, n] and `constants` [P, k]."""
        along = weights - constants @ self.coupling
        inside = along @ self.vectors.T
        # Formed from the part outside V, not as a difference of squares, which would cancel.
        outside = along - inside @ self.vectors
        of_weights = self.spread**2 * (np.sum(outside**2, axis=1) + np.sum(self.shares * inside**2, axis=1))
        of_constants = np.einsum("pi,ij,pj->p", constants, self.conditional, constants)
        return np.asarray(np.sqrt(of_weights + np.maximum(of_constants, 0.0)), dtype=np.float64)

    def towards(self, name: str) -> tuple[Array, Array]:
        """What the weights [n] and constants [k] are displaced by, on average, where this constant is displaced by its
        standard deviation; zero where it has none."""
        place = self.constants.index(name)
        along = self.coupling[place]
        inside = self.vectors @ along
        of_weights = self.spread**2 * (along - ((1.0 - self.shares) * inside) @ self.vectors)
        constants = self.coupling @ of_weights + self.conditional[:, place]
        deviation = np.sqrt(constants[place]) if constants[place] > 0 else np.inf
        return -of_weights / deviation, constants / deviation

    def without(self, given: Collection[str]) -> Covariance:
        """The covariance where the values of some constants are given, which have none."""
        kept = np.array([name not in given for name in self.constants], dtype=np.float64)
        return replace(
            self, conditional=kept[:, None] * self.conditional * kept, coupling=kept[:, None] * self.coupling
        )

    def at_most(self, spreads: Mapping[str, float]) -> Covariance:
        """The covariance where constants were measured besides, with these standard deviations, in their units; 0: they
        are known. Others that the data tie to them are known as much better; weights, if there are any, are not."""
        conditional, coupling = self.conditional.copy(), self.coupling.copy()
        for name, spread in spreads.items():
            place = self.constants.index(name)
            along = conditional[:, place].copy()
            if (total := along[place] + spread**2) > 0:
                conditional -= np.outer(along, along) / total
            if not spread:
                conditional[place] = conditional[:, place] = coupling[place] = 0.0
        return replace(self, conditional=0.5 * (conditional + conditional.T), coupling=coupling)

    def widened(self, factor: float) -> Covariance:
        """The covariance if the data have noise with a standard deviation `factor` times as large."""
        shares = np.maximum(self.shares, 1e-300)
        weaker = 1.0 / (1.0 + (1.0 / shares - 1.0) / factor**2)
        return replace(self, shares=weaker, conditional=self.conditional * factor**2)

    def displacements(self, rng: np.random.Generator, most: int) -> list[tuple[Array, Array]]:
        """At most this many displacements of the weights [n] and of the constants [k], whose mean outer product is the
        covariance: exactly so for no more parameters than that, by columns of a square root, and otherwise expected of
        random draws."""
        count = self.vectors.shape[1] + len(self.constants)
        if count > most:
            return [self._displaced(rng.standard_normal(count)) for _ in range(most)]
        columns = [self._displaced(column) for column in np.eye(count)]
        moving = [(w, k) for w, k in columns if w.any() or k.any()]
        return [(np.sqrt(len(moving)) * w, np.sqrt(len(moving)) * k) for w, k in moving]

    def _displaced(self, normal: Array) -> tuple[Array, Array]:
        """A square root of the covariance times `normal` [n + k], of the weights [n] and of the constants [k]."""
        normal, of_constants = np.split(normal, [self.vectors.shape[1]])
        inside = self.vectors @ normal
        weights = self.spread * (normal + (inside * (np.sqrt(self.shares) - 1.0)) @ self.vectors)
        values, vectors = np.linalg.eigh(self.conditional) if len(self.constants) else (np.zeros(0), np.zeros((0, 0)))
        own = vectors @ (np.sqrt(np.maximum(values, 0.0)) * of_constants)
        return weights, np.asarray(own - self.coupling @ weights, dtype=np.float64)


@dataclass(frozen=True)
class Certainties:
    """The content of the file; `covariance` is None where the curvature is not known."""

    covariance: Covariance | None = None
    support: Mapping[str, Support] = field(default_factory=dict)

    def widened(self, factor: float) -> Certainties:
        """The same with the covariance for noise with a standard deviation `factor` times as large."""
        return self if self.covariance is None else replace(self, covariance=self.covariance.widened(factor))

    def write(self, directory: Path) -> None:
        """Writes it into a member's directory."""
        arrays: dict[str, Array] = {}
        remarks: JsonObject = {"networks": list(self.support)}
        for name, one in self.support.items():
            arrays |= {f"support.{name}": one.points, f"owner.{name}": one.owner}
        if self.covariance is not None:
            known = self.covariance
            remarks |= {"weights": list(known.names), "constants": list(known.constants), "spread": known.spread}
            arrays["vectors"] = known.vectors.astype(np.float32)
            arrays |= {"shares": known.shares, "coupling": known.coupling, "conditional": known.conditional}
        files.write_tensors(directory / COVARIANCE, arrays, remarks)


def read_certainties(directory: Path) -> Certainties:
    """The content of a member's file; empty if there is none (older runs, interrupted fits) or it is damaged."""
    path = directory / COVARIANCE
    if not path.is_file():
        return Certainties()
    try:
        arrays, remarks = files.read_tensors(path)
        support = {
            name: Support(arrays[f"support.{name}"], arrays[f"owner.{name}"]) for name in remarks.get("networks", ())
        }
        if "vectors" not in arrays:
            return Certainties(None, support)
        found = Covariance(
            tuple(remarks["weights"]),
            tuple(remarks["constants"]),
            float(remarks["spread"]),
            arrays["vectors"].astype(np.float64),
            *(arrays[name] for name in ("shares", "coupling", "conditional")),
        )
    except (ValueError, KeyError, TypeError):
        return Certainties()
    return Certainties(found, support)
