"""A system with one varying parameter: x' = f(x, p), with exact derivatives up to the third."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from gbspec.analysis.systems.compiled import Compiled
from gbspec.analysis.systems.system import System, require_autonomous, suggestion
from gbspec.backends import Casadi
from gbspec.diagnostics import Findings


class Family:
    """x' = f(x, p) for the parameter `name` (a condition, input or constant), all others at the system's values.

    Raises UserError if the system has no such parameter (GB872), if it depends on time explicitly (GB873), or if
    another number is missing (GB871).
    """

    def __init__(self, system: System, name: str) -> None:
        if name not in system.parameters:
            findings = Findings()
            findings.error(
                "GB872", f"`{name}` cannot be varied: `{system.name}` has no condition, input or constant of that name",
                None, help=suggestion(name, system.parameters), subject=name,
            )  # fmt: skip
            findings.raise_if_failed()
        low, high = system.range(name)
        placeholder = low if np.isfinite(low) else (high if np.isfinite(high) else 1.0)
        require_autonomous(
            system if np.isfinite(system.values.get(name, np.nan)) else system.with_values({name: placeholder}),
            "steady states and cycles",
        )
        self.system = system
        self.name = name
        self.size = system.size

    def at(self, value: float) -> System:
        """The system at one value of the parameter."""
        return self.system.with_values({self.name: value})

    @cached_property
    def _symbolic(self) -> tuple[Casadi, Casadi, Casadi]:
        """MX symbols x and p, and f(x, p)."""
        import casadi

        p = casadi.MX.sym("p")
        x, f = self.system.symbolic_rhs({self.name: p})
        return x, p, f

    @cached_property
    def rhs(self) -> Compiled:
        """(x, p) -> f [n]."""
        import casadi

        x, p, f = self._symbolic
        return Compiled(casadi.Function("f", [x, p], [f]))

    @cached_property
    def function(self) -> Casadi:
        """The casadi.Function (x, p) -> f, for integrators."""
        return self.rhs.function

    @cached_property
    def linear(self) -> Compiled:
        """(x, p) -> f [n], df/dx [n, n], df/dp [n]."""
        import casadi

        x, p, f = self._symbolic
        return Compiled(casadi.Function("linear", [x, p], [f, casadi.jacobian(f, x), casadi.jacobian(f, p)]))

    @cached_property
    def bilinear(self) -> Compiled:
        """(x, p, u, v) -> B(u, v) [n], the second derivative in directions u and v."""
        import casadi

        x, p, f = self._symbolic
        u, v = casadi.MX.sym("u", self.size), casadi.MX.sym("v", self.size)
        second = casadi.jtimes(casadi.jtimes(f, x, u), x, v)
        return Compiled(casadi.Function("bilinear", [x, p, u, v], [second]))

    @cached_property
    def trilinear(self) -> Compiled:
        """(x, p, u, v, w) -> C(u, v, w) [n], the third derivative in directions u, v and w."""
        import casadi

        x, p, f = self._symbolic
        u, v, w = (casadi.MX.sym(name, self.size) for name in "uvw")
        third = casadi.jtimes(casadi.jtimes(casadi.jtimes(f, x, u), x, v), x, w)
        return Compiled(casadi.Function("trilinear", [x, p, u, v, w], [third]))
