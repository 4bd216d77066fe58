"""Algebraic variables in the kernel: a function in C searches for the solution of each block of equations.

The kernel gets a model without algebraic variables. Each of them is an intermediate there,

    z = z0 - W g(z0, p)

with the solution z0 and the inverse W of the equations' derivatives as they were found at p: states, inputs, constants.
Both are constants in derivatives, and g(z0, p) is zero to rounding, so that z has the derivatives of the implicit
function, at the price of one evaluation of g. The search takes the steps of that of the generated module (`_newton` of
its template).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace

import sympy
from sympy.core.function import AppliedUndef

from gbspec.backends import CPrinter, Flat, NotCoveredError, Operation, Source, flatten, start_of, table_function
from gbspec.ir import Algebraic, EquationBlock, Expr, Input, Intermediate, Lookup, Model, derivative

MOST_VARIABLES = 8
"""Most variables of a block: the inverse of its derivatives is kept whole."""

_SEARCH = """\
/* Solutions of algebraic equations. */
#if defined(__GNUC__)
#define KEPT static __thread
#else
#define KEPT static _Thread_local
#endif
typedef void (*root_equations)(const double *p, const double *z, double *g, double *slopes);

static double root_largest(const double *values, const double *by, int n) {
    double most = 0.0;
    for (int i = 0; i < n; i++) {
        const double size = fabs(values[i]) * by[i];
        if (!(size <= most)) most = size;
        if (isnan(most)) return most;
    }
    return most;
}

/* b [n, m] becomes the solution of a x = b, NaN where a [n, n] is singular; a is overwritten. */
static void root_divide(int n, int m, double *a, double *b) {
    for (int j = 0; j < n; j++) {
        int pivot = j;
        for (int i = j + 1; i < n; i++)
            if (fabs(a[i*n + j]) > fabs(a[pivot*n + j])) pivot = i;
        if (!(fabs(a[pivot*n + j]) > 0.0)) {
            for (int i = 0; i < n*m; i++) b[i] = NAN;
            return;
        }
        for (int k = 0; k < n && pivot != j; k++) {
            const double kept = a[j*n + k];
            a[j*n + k] = a[pivot*n + k];
            a[pivot*n + k] = kept;
        }
        for (int k = 0; k < m && pivot != j; k++) {
            const double kept = b[j*m + k];
            b[j*m + k] = b[pivot*m + k];
            b[pivot*m + k] = kept;
        }
        for (int i = 0; i < n; i++) {
            const double share = a[i*n + j] / a[j*n + j];
            if (i == j) continue;
            for (int k = j; k < n; k++) a[i*n + k] -= share * a[j*n + k];
            for (int k = 0; k < m; k++) b[i*m + k] -= share * b[j*m + k];
        }
    }
    for (int i = 0; i < n; i++)
        for (int k = 0; k < m; k++) b[i*m + k] /= a[i*n + i];
}

/* The solution z [n], and the inverse of the derivatives there [n, n], or NaN. `work` has 2 n n + 7 n places. */
static void root_search(root_equations equations, int n, const double *p, const double *start, const double *low,
                        const double *high, const double *scale, double *z, double *inverse, double *work) {
    double *g = work, *fresh = g + n, *step = fresh + n, *weights = step + n, *trial = weights + n, *by = trial + n;
    double *slopes = by + 2*n, *its = slopes + n*n;
    double size = 1.0, merit = 0.0;
    int done = 0, taken = 1;
    for (int i = 0; i < n; i++) z[i] = trial[i] = start[i];
    equations(p, trial, g, slopes);
    for (int tick = 0; tick < TICKS; tick++) {
        if (taken) {
            for (int i = 0; i < n; i++) z[i] = trial[i];
            memcpy(its, slopes, n*n * sizeof(double));
            memcpy(step, g, n * sizeof(double));
            root_divide(n, 1, its, step);
            double room = INFINITY;
            for (int i = 0; i < n; i++) {
                double total = 0.0;
                for (int k = 0; k < n; k++) total += fabs(slopes[i*n + k]) * scale[k];
                weights[i] = 1.0 / (total > 0.0 ? total : 1.0);
                step[i] = -step[i];
                by[i] = 1.0 / (fabs(z[i]) + scale[i]);
                const double here = (step[i] > 0.0 ? high[i] - z[i] : z[i] - low[i]) / (fabs(step[i]) + 1e-300);
                if (!(here >= room)) room = here;
            }
            merit = root_largest(g, weights, n);
            if (root_largest(step, by, n) <= TOLERANCE) done = 1;
            size = room >= 1.0 ? 1.0 : INSIDE * room;
        } else
            size *= 0.5;
        for (int i = 0; i < n; i++) by[i] = 1.0 / scale[i];
        if (done || !(size * root_largest(step, by, n) >= LEAST)) break;
        for (int i = 0; i < n; i++) trial[i] = z[i] + size * step[i];
        equations(p, trial, fresh, its);
        taken = root_largest(fresh, weights, n) <= (1.0 - ENOUGH * size) * merit;
        if (taken) {
            memcpy(g, fresh, n * sizeof(double));
            memcpy(slopes, its, n*n * sizeof(double));
        }
    }
    for (int round = 0; round < 3; round++) {
        equations(p, z, g, slopes);
        if (round < 2) root_divide(n, 1, slopes, g);
        for (int i = 0; i < n && round < 2; i++) z[i] -= g[i];
    }
    for (int i = 0; i < n*n; i++) inverse[i] = i % (n + 1) ? 0.0 : 1.0;
    root_divide(n, n, slopes, inverse);
    for (int i = 0; i < n && !done; i++) z[i] = NAN;
}
"""

_CONSTANTS = {"TICKS": 60, "LEAST": 1e-8, "ENOUGH": 1e-4, "INSIDE": 0.9}
"""As in the module's template."""


@dataclass(frozen=True)
class _Block:
    """A block's equations at the variables `sought`, in terms of the symbols `given`."""

    items: tuple[Algebraic, ...]
    residuals: tuple[Expr, ...]
    given: tuple[sympy.Symbol, ...]

    @property
    def size(self) -> int:
        """The number of variables."""
        return len(self.items)

    @property
    def slopes(self) -> list[Expr]:
        """The residuals' derivatives by the variables, row by row."""
        return [derivative(value, item.symbol) for value in self.residuals for item in self.items]

    @property
    def name(self) -> str:
        """A name by all that the solution depends on."""
        about = [(item.name, item.start, item.range) for item in self.items]
        text = repr((about, [sympy.srepr(value) for value in self.residuals]))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def result(self, place: int) -> Expr:
        """A result of the search: the variables, then the inverse of the derivatives, row by row. Its derivatives are
        zero."""
        curve = SimpleNamespace(digest=f"{self.name}", degree=0)
        content = {"table": f"root_{self.name}", "curve": curve, "order": (place,), "nargs": len(self.given)}
        return type(f"root_{self.name}_{place}", (_Result,), content)(*self.given)


class _Result(Lookup):
    """A result of a search; the kernel calls a function in C for it, as for a table."""

    @classmethod
    def eval(cls, *arguments: Expr) -> Expr | None:
        """Nothing is evaluated here."""
        return None

    def slope(self, argument: int) -> Expr:
        """Zero: what is found is a constant in derivatives."""
        return sympy.S.Zero


def with_searches(model: Model) -> tuple[Model, list[_Block]]:
    """The model with algebraic variables as intermediates, and their blocks.

    Raises NotCoveredError where an unknown function stands in the equations.
    """
    blocks: list[_Block] = []
    formulas: list[Intermediate] = []
    for block in model.blocks if model.algebraics else ():
        if block.explicit:
            continue
        found = _block(model, block)
        blocks.append(found)
        formulas += _formulas(found)
    if not blocks:
        return model, []
    moved = tuple(
        replace(family, begin=family.begin + len(formulas)) if family.vector == "intermediates" else family
        for family in model.families
    )
    changed = replace(model, algebraics=(), intermediates=(*formulas, *model.intermediates), families=moved)
    return changed, blocks


def _block(model: Model, block: EquationBlock) -> _Block:
    table = {equation.name: equation.residual for equation in model.constraints}
    residuals = model.inlined([table[name] for name in block.equations])
    if any(value.has(AppliedUndef) for value in residuals):
        raise NotCoveredError("an unknown function stands in its algebraic equations")
    if len(block.variables) > MOST_VARIABLES:
        raise NotCoveredError(f"more than {MOST_VARIABLES} of its algebraic equations are solved together")
    own = {item.name: item for item in model.algebraics}
    items = tuple(own[name] for name in block.variables)
    sought = {item.symbol for item in items}
    given = sorted({s for value in residuals for s in value.free_symbols} - sought, key=lambda s: str(s.name))
    return _Block(items, residuals, tuple(given))


def _formulas(block: _Block) -> list[Intermediate]:
    """The variables, each with one correction that has the derivatives."""
    n = block.size
    found = {item.symbol: block.result(i) for i, item in enumerate(block.items)}
    left = [value.xreplace(found) for value in block.residuals]
    values = [
        sympy.Add(z, *(-block.result(n + i * n + j) * g for j, g in enumerate(left)))
        for i, z in enumerate(found.values())
    ]
    return [
        Intermediate(item.name, value, unit=item.unit, description=item.description, span=item.span)
        for item, value in zip(block.items, values, strict=True)
    ]


# ----------------------------------------------------------------------------------------------------------- C
def source_with(text: Source, model: Model, blocks: Sequence[_Block]) -> Source:
    """The kernel's source with the functions that search."""
    if not blocks:
        return text
    tolerance = "(sizeof(real) == 4 ? 7.6e-4 : 9.05e-8)"
    defined = [f"#define {name} {value}" for name, value in _CONSTANTS.items()]
    heads = [f"{_head(block)};" for block in blocks]
    bodies = [_function(model, block) for block in blocks]
    lines = [*heads, text.text, *defined, f"#define TOLERANCE {tolerance}", _SEARCH, *bodies]
    return Source("\n".join([*lines, ""]), text.sizes)


def _head(block: _Block) -> str:
    function = table_function(SimpleNamespace(digest=block.name))  # type: ignore[arg-type]  # whose digest alone counts
    places = ", ".join(f"double p{i}" for i in range(len(block.given)))
    return f"static double {function}({places}{', ' if places else ''}int which)"


def _function(model: Model, block: _Block) -> str:
    """The equations of a block in C, and the function that gives one of its results; the last ones are kept."""
    n, m, name = block.size, len(block.given), block.name
    rows = [
        f"    static const double {word}[{n}] = {{{', '.join(_number(value) for value in values)}}};"
        for word, values in zip(
            ("start", "low", "high", "scale"),
            zip(*map(_numbers, block.items), strict=True),
            strict=True,
        )
    ]
    lines = [
        *_equations(model, block),
        "",
        f"{_head(block)} {{",
        *rows,
        f"    const double p[{m + 1}] = {{{', '.join([*(f'p{i}' for i in range(m)), '1.0'])}}};",
        f"    KEPT double before[{m + 1}], found[{n + n * n}];",
        f"    double work[{2 * n * n + 7 * n}];",
        "    if (memcmp(before, p, sizeof p)) {",
        f"        root_search(root_{name}, {n}, p, start, low, high, scale, found, found + {n}, work);",
        "        memcpy(before, p, sizeof p);",
        "    }",
        "    return found[which];",
        "}",
    ]
    return "\n".join(lines)


def _equations(model: Model, block: _Block) -> list[str]:
    """Residuals and their derivatives at p and z."""
    places = {s: f"p[{i}]" for i, s in enumerate(block.given)}
    places |= {item.symbol: f"z[{i}]" for i, item in enumerate(block.items)}
    known = {item.symbol for group in (model.states, model.conditions, model.inputs) for item in group}
    known |= {item.symbol for item in (*model.constants, *model.learnables)} | {model.time.symbol}
    more = tuple(Input(s.name) for s in places if s not in known)
    plain = replace(
        model, inputs=(*model.inputs, *more), intermediates=(), algebraics=(), networks=(), unknowns=(), families=()
    )
    flat: Flat = flatten(plain, [*block.residuals, *block.slopes])
    names: dict[sympy.Symbol, str] = {}

    def name(found: sympy.Symbol) -> str:
        return names.setdefault(found, f"v{len(names)}")

    printer = CPrinter(name)
    lines = [f"static void root_{block.name}(const double *p, const double *z, double *g, double *slopes) {{"]
    lines += [f"    const real {name(s)} = {place}; (void){name(s)};" for s, place in places.items()]
    for step in flat.steps:
        assert isinstance(step, Operation), "equations without unknown functions call no network"
        kind = "real" if step.symbol.is_real else "int"
        lines.append(f"    const {kind} {name(step.symbol)} = {printer.print(step.value)};")
    targets = [f"g[{i}]" for i in range(block.size)] + [f"slopes[{i}]" for i in range(block.size**2)]
    lines += [f"    {target} = {printer.print(value)};" for target, value in zip(targets, flat.outputs, strict=True)]
    return [*lines, "}"]


def _numbers(item: Algebraic) -> tuple[float, float, float, float]:
    """Where a variable's search begins, the ends of its range, and its size: the length of the range, else the start,
    else 1."""
    start, low, high = start_of(item), -math.inf, math.inf
    if item.range is not None:
        low, high = item.range.low, item.range.high
    inside = math.isfinite(low) and math.isfinite(high)
    return start, low, high, high - low if inside else abs(start) or 1.0


def _number(value: float) -> str:
    return {math.inf: "INFINITY", -math.inf: "-INFINITY"}.get(value, repr(float(value)))
