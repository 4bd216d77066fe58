"""The scalar parts of the equations as C loops over the trajectories of a tile, forward and in reverse.

Between two loops come the network calls whose arguments the first loop computes. A reverse loop recomputes the forward
values that it needs from the Runge-Kutta stage's state and the networks' outputs, which are stored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import sympy

from gbspec.backends.native.adjoint import contributions
from gbspec.backends.native.flat import Call, Flat, Leaf, Operation
from gbspec.backends.native.printer import CPrinter
from gbspec.ir import Model

INDENT = "        "


@dataclass(frozen=True)
class Site:
    """A network call and where its arguments and outputs are stored: `sites[number]` of the work space.

    `invariant`: the arguments are the same throughout a solution (the place of a zero, say), and the call is made once.
    """

    number: int
    call: Call
    level: int
    invariant: bool = False


class Equations:
    """One set of equations (right-hand side or observation) as C.

    `place` gives the C text of a leaf; `outputs` are written to `out`, cotangents read from `ob`, both [output][lane].
    `skip` is a condition under which a lane is skipped (its networks get zeros). `once`: loop-invariant calls are made
    separately, by `invariant_forward`; `timed`: `tb` and `ub` get the cotangents of time and inputs; `late_bar`: the C
    text of those of delayed values.
    """

    def __init__(
        self,
        model: Model,
        flat: Flat,
        first_site: int,
        place: Callable[[Leaf], str],
        name: str,
        skip: str = "",
        once: bool = False,
        timed: bool = False,
        late_bar: str = "ub[(INPUTS + {})*TILE + t]",
    ) -> None:
        self.model, self.flat, self.place, self.name, self.skip = model, flat, place, name, skip
        self.timed, self.late_bar = timed, late_bar
        self._names: dict[sympy.Symbol, str] = {}
        self._maker = {step.symbol: step for step in flat.steps if isinstance(step, Operation)}
        self._results = {s: (call, i) for call in flat.calls for i, s in enumerate(call.results)}
        self._known = len(model.constants)
        self._level: dict[sympy.Symbol, int] = {}
        self._active: set[sympy.Symbol] = set()
        self._moving: set[sympy.Symbol] = set()
        self._rank()
        self.sites = [
            Site(
                first_site + i,
                call,
                max((self._level_of(a) for a in call.arguments), default=0),
                once and not self._moving.intersection(call.arguments),
            )
            for i, call in enumerate(flat.calls)
        ]
        self._site = {call.results: site for call, site in zip(flat.calls, self.sites, strict=True)}
        self.printer = CPrinter(self._name)

    # -------------------------------------------------------------- analysis
    def _rank(self) -> None:
        """Finds each symbol's level (the depth of calls below it), whether it is active (a gradient passes through it),
        and whether it varies (it changes in time, or is active)."""
        for symbol, leaf in self.flat.leaves.items():
            learned = leaf.kind == "constant" and leaf.index >= self._known
            if leaf.kind in ("state", "delay") or learned or (self.timed and leaf.kind in ("time", "input")):
                self._active.add(symbol)
            if leaf.kind in ("state", "delay", "time", "input") or learned:
                self._moving.add(symbol)
        for step in self.flat.steps:
            if isinstance(step, Call):
                level = 1 + max((self._level_of(a) for a in step.arguments), default=0)
                self._level.update(dict.fromkeys(step.results, level))
                self._active.update(step.results)
                self._moving.update(step.results)
                continue
            used = step.value.free_symbols
            self._level[step.symbol] = max((self._level_of(s) for s in used), default=0)
            if used & self._active:
                self._active.add(step.symbol)
            if used & self._moving:
                self._moving.add(step.symbol)

    def _level_of(self, atom: sympy.Basic) -> int:
        return self._level.get(atom, 0)

    def _cone(self, targets: Iterable[sympy.Basic]) -> list[Operation]:
        """The operations that the targets need, in order; the networks' outputs are available."""
        needed: set[sympy.Symbol] = set()
        stack = [t for t in targets if isinstance(t, sympy.Symbol)]
        while stack:
            symbol = stack.pop()
            if symbol in needed or symbol not in self._maker:
                continue
            needed.add(symbol)
            stack.extend(self._maker[symbol].value.free_symbols)
        return [s for s in self.flat.steps if isinstance(s, Operation) and s.symbol in needed]

    def wanted(self, site: Site) -> list[bool]:
        """For each argument, whether its cotangent is needed."""
        return [argument in self._active for argument in site.call.arguments]

    # -------------------------------------------------------------- names
    def _name(self, symbol: sympy.Symbol) -> str:
        if symbol not in self._names:
            self._names[symbol] = f"v{len(self._names)}"
        return self._names[symbol]

    def _loads(self, used: set[sympy.Symbol]) -> list[str]:
        """Lines that read leaves and networks' outputs."""
        lines = [
            f"const real {self._name(symbol)} = {self.place(leaf)};"
            for symbol, leaf in self.flat.leaves.items()
            if symbol in used
        ]
        for call in self.flat.calls:
            for i, symbol in enumerate(call.results):
                if symbol in used:
                    lines.append(f"const real {self._name(symbol)} = {self._output('y', call, i)};")
        return lines

    def _output(self, array: str, call: Call, i: int) -> str:
        site = self._site[call.results]
        return f"S{site.number}_{array}[t*{len(call.results)} + {i}]"

    def _argument(self, array: str, site: Site, i: int) -> str:
        return f"S{site.number}_{array}[t*{len(site.call.arguments)} + {i}]"

    def _compute(self, cone: Sequence[Operation], targets: Iterable[sympy.Basic]) -> list[str]:
        """Lines that read the leaves of a cone and compute its operations."""
        used = {s for op in cone for s in op.value.free_symbols} | {t for t in targets if isinstance(t, sympy.Symbol)}
        lines = self._loads(used)
        for op in cone:
            kind = "real" if op.symbol.is_real else "int"
            lines.append(f"const {kind} {self._name(op.symbol)} = {self.printer.print(op.value)};")
        return lines

    # -------------------------------------------------------------- forward
    def forward(self) -> list[str]:
        """The body of the function that computes `out`."""
        lines = []
        for level in range(1 + max((site.level for site in self.sites), default=-1)):
            sites = [site for site in self.sites if site.level == level and not site.invariant]
            lines += self._pointers([s for s in self.sites if s.level < level], "y")
            lines += self._calls(sites)
        targets = self.flat.outputs
        stores = [f"out[{i}*TILE + t] = {self.printer.print(a)};" for i, a in enumerate(targets)]
        zeros = [f"out[{i}*TILE + t] = 0;" for i in range(len(targets))]
        lines += self._pointers(self.sites, "y")
        return lines + self._loop([*self._compute(self._cone(targets), targets), *stores], zeros)

    def invariant_forward(self) -> list[str]:
        """The body of the function that makes the loop-invariant calls."""
        return self._calls([site for site in self.sites if site.invariant])

    def _calls(self, sites: Sequence[Site]) -> list[str]:
        """A loop that computes the arguments of some calls, and the calls."""
        if not sites:
            return []
        targets = [a for site in sites for a in site.call.arguments]
        stores = [
            f"{self._argument('args', site, i)} = {self.printer.print(a)};"
            for site in sites
            for i, a in enumerate(site.call.arguments)
        ]
        zeros = [f"{self._argument('args', s, i)} = 0;" for s in sites for i in range(len(s.call.arguments))]
        return [
            *self._pointers(sites, "args"),
            *self._loop([*self._compute(self._cone(targets), targets), *stores], zeros),
            *(f"    net_forward({self._network(s)}, {'0' if s.invariant else 'block'});" for s in sites),
        ]

    @staticmethod
    def _network(site: Site) -> str:
        """The first arguments of a network's functions."""
        return f"&w->nets[{site.call.network}], &w->sites[{site.number}]"

    def _loop(self, body: Sequence[str], skipped: Sequence[str] = ()) -> list[str]:
        skip = [f"if ({self.skip}) {{ {' '.join(skipped)} continue; }}"] if self.skip else []
        return ["    for (int t = 0; t < TILE; t++) {", *(INDENT + line for line in (*skip, *body)), "    }"]

    def _pointers(self, sites: Iterable[Site], *arrays: str) -> list[str]:
        """Lines that define names for the beginnings of a site's arrays in this block."""
        widths = {"args": "inputs", "ab": "inputs", "y": "outputs", "yb": "outputs"}
        lines = []
        for site in sites:
            for array in arrays:
                if array == "ab" or site.invariant:
                    start = f"w->sites[{site.number}].{array}"
                else:
                    width = len(site.call.arguments) if widths[array] == "inputs" else len(site.call.results)
                    start = f"w->sites[{site.number}].{array} + block*(TILE*{width})"
                lines.append(f"#define S{site.number}_{array} ({start})")
        return lines

    # -------------------------------------------------------------- reverse
    def reverse(self) -> list[str]:
        """The body of the function that adds the contributions of the outputs' cotangents `ob` to `xb` and `kb`."""
        lines = self._pointers(self.sites, "args", "ab", "y", "yb")
        lines += [f"    zero(S{s.number}_yb, TILE*{len(s.call.results)});" for s in self.sites if not s.invariant]
        seeds = [(a, f"ob[{i}*TILE + t]") for i, a in enumerate(self.flat.outputs)]
        lines += self._back(seeds)
        for level in reversed(range(1 + max((site.level for site in self.sites), default=-1))):
            sites = [site for site in self.sites if site.level == level and not site.invariant]
            for site in sites:
                mask = sum(1 << i for i, wanted in enumerate(self.wanted(site)) if wanted)
                lines.append(f"    net_backward({self._network(site)}, block, {mask}u);")
            seeds = [
                (a, self._argument("ab", site, i))
                for site in sites
                for i, a in enumerate(site.call.arguments)
                if a in self._active
            ]
            lines += self._back(seeds)
        return lines

    def _back(self, seeds: Sequence[tuple[sympy.Basic, str]]) -> list[str]:
        """One reverse loop, from the cotangents of some values to those of leaves and networks' outputs."""
        seeds = [(a, text) for a, text in seeds if a in self._active]
        if not seeds:
            return []
        targets = [a for a, _ in seeds]
        cone = self._cone(targets)
        terms: dict[sympy.Symbol, list[str]] = {}
        for atom, text in seeds:
            terms.setdefault(atom, []).append(text)
        body = []
        read: set[sympy.Symbol] = set()
        for op in reversed(cone):
            if op.symbol not in self._active or op.symbol not in terms:
                continue
            bar = sympy.Symbol(f"bar {self._name(op.symbol)}", real=True)
            self._names[bar] = f"b_{self._name(op.symbol)}"
            body.append(f"const real {self._names[bar]} = {' + '.join(terms.pop(op.symbol))};")
            for symbol, term in contributions(op, bar):
                if symbol in self._active:
                    terms.setdefault(symbol, []).append(self.printer.print(term))
                    read |= term.free_symbols
        body += [line for symbol, parts in terms.items() for line in self._deposit(symbol, " + ".join(parts))]
        return self._loop([*self._compute(cone, [*targets, *read]), *body])

    def _deposit(self, symbol: sympy.Symbol, text: str) -> list[str]:
        if symbol in self._results:
            call, i = self._results[symbol]
            return [f"{self._output('yb', call, i)} += {text};"]
        leaf = self.flat.leaves[symbol]
        if leaf.kind == "state":
            return [f"xb[{leaf.index}*TILE + t] += {text};"]
        if leaf.kind == "time":
            return [f"tb[t] += {text};"]
        if leaf.kind == "input":
            return [f"ub[{leaf.index}*TILE + t] += {text};"]
        if leaf.kind == "delay":
            return [f"{self.late_bar.format(leaf.index)} += {text};"]
        return [f"kb[{leaf.index - self._known}*TILE + t] += {text};"]
