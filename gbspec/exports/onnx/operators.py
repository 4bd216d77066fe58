"""Functions of the language in ONNX's operators.

onnxruntime's CPU provider has no Softplus, Erf, Elu, Tan, inverse or hyperbolic functions in double precision; they are
spelled by exp, log, sqrt, sin and cos so that no digits are lost, and arctangent and error function by the rational
approximations of Cephes (Moshier, 1989), which are exact to a few units of the last digit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from gbspec.exports.onnx.graph import Graph

DIRECT = {
    "exp": "Exp", "log": "Log", "sin": "Sin", "cos": "Cos", "tanh": "Tanh", "sqrt": "Sqrt", "abs": "Abs",
    "sign": "Sign", "floor": "Floor", "negative": "Neg",
}  # fmt: skip
"""Functions that have an operator in both precisions."""
SINGLE = {
    "tan": "Tan", "sinh": "Sinh", "cosh": "Cosh", "asin": "Asin", "acos": "Acos", "atan": "Atan", "asinh": "Asinh",
    "acosh": "Acosh", "atanh": "Atanh", "softplus": "Softplus", "logistic": "Sigmoid", "erf": "Erf",
}  # fmt: skip
"""Functions that have one in single precision only (Sigmoid: in double precision it loses digits)."""

ATAN_P = (-8.750608600031904122785e-1, -1.615753718733365076637e1, -7.500855792314704667340e1,
          -1.228866684490136173410e2, -6.485021904942025371773e1)  # fmt: skip
ATAN_Q = (1.0, 2.485846490142306297962e1, 1.650270098316988542046e2, 4.328810604912902668951e2,
          4.853903996359136964868e2, 1.945506571482613964425e2)  # fmt: skip
ERF_T = (9.60497373987051638749, 9.00260197203842689217e1, 2.23200534594684319226e3, 7.00332514112805075473e3,
         5.55923013010394962768e4)  # fmt: skip
ERF_U = (1.0, 3.35617141647503099647e1, 5.21357949780152679795e2, 4.59432382970980127987e3, 2.26290000613890934246e4,
         4.92673942608635921086e4)  # fmt: skip
ERFC_P = (2.46196981473530512524e-10, 5.64189564831068821977e-1, 7.46321056442269912687, 4.86371970985681366614e1,
          1.96520832956077098242e2, 5.26445194995477358631e2, 9.34528527171957607540e2, 1.02755188689515710272e3,
          5.57535335369399327526e2)  # fmt: skip
ERFC_Q = (1.0, 1.32281951154744992508e1, 8.67072140885989742329e1, 3.54937778887819891062e2, 9.75708501743205489753e2,
          1.82390916687909736289e3, 2.24633760818710981792e3, 1.65666309194161350182e3,
          5.57535340817727675546e2)  # fmt: skip


class Operators:
    """Functions over the values of a graph; names are those of `gbspec.backends.printing`."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.double = graph.precision == "float64"

    def apply(self, name: str, *arguments: str) -> str:
        """The value of a function. Raises KeyError for one that has no rule."""
        g = self.graph
        if name in DIRECT:
            return g.op(DIRECT[name], *arguments)
        if name in SINGLE and not self.double:
            return g.op(SINGLE[name], *arguments)
        table: dict[str, Callable[..., str]] = {
            "maximum": lambda a, b: g.op("Max", a, b),
            "minimum": lambda a, b: g.op("Min", a, b),
            "atan2": self._atan2,
            **{word: getattr(self, f"_{word}") for word in SINGLE},
        }
        return table[name](*arguments)

    # -------------------------------------------------------------- arithmetic
    def add(self, a: str, b: str | float) -> str:
        """a + b."""
        return self.graph.op("Add", a, self._value(b))

    def mul(self, a: str, b: str | float) -> str:
        """a b."""
        return self.graph.op("Mul", a, self._value(b))

    def sub(self, a: str | float, b: str | float) -> str:
        """a - b."""
        return self.graph.op("Sub", self._value(a), self._value(b))

    def div(self, a: str | float, b: str | float) -> str:
        """a / b."""
        return self.graph.op("Div", self._value(a), self._value(b))

    def where(self, condition: str, a: str | float, b: str | float) -> str:
        """a where the condition holds, else b."""
        return self.graph.op("Where", condition, self._value(a), self._value(b))

    def less(self, a: str, b: str | float) -> str:
        """Whether a < b."""
        return self.graph.op("Less", a, self._value(b))

    def equal(self, a: str, b: str | float) -> str:
        """Whether a = b."""
        return self.graph.op("Equal", a, self._value(b))

    def _value(self, value: str | float) -> str:
        return value if isinstance(value, str) else self.graph.number(float(value))

    def _polynomial(self, coefficients: Sequence[float], x: str) -> str:
        """Horner's rule, the highest power first."""
        found = self._value(coefficients[0])
        for coefficient in coefficients[1:]:
            found = self.add(self.mul(found, x), coefficient)
        return found

    # -------------------------------------------------------------- double precision
    def log1p(self, x: str) -> str:
        """log(1 + x), exact for small x too (Kahan)."""
        u = self.add(x, 1.0)
        small = self.equal(u, 1.0)
        safe = self.where(small, 1.0, self.sub(u, 1.0))
        return self.where(small, x, self.mul(self.apply("log", u), self.div(x, safe)))

    def expm1(self, x: str) -> str:
        """exp(x) - 1, likewise."""
        u = self.apply("exp", x)
        less_one = self.sub(u, 1.0)
        logarithm = self.apply("log", u)
        flat = self.equal(u, 1.0)
        usable = self.where(flat, 1.0, logarithm)
        found = self.div(self.mul(less_one, x), usable)
        return self.where(flat, x, self.where(self.equal(less_one, -1.0), -1.0, found))

    def _logistic(self, x: str) -> str:
        return self.div(1.0, self.add(self.apply("exp", self.apply("negative", x)), 1.0))

    def _softplus(self, x: str) -> str:
        below = self.apply("exp", self.apply("negative", self.apply("abs", x)))
        return self.add(self.graph.op("Relu", x), self.log1p(below))

    def _tan(self, x: str) -> str:
        return self.div(self.apply("sin", x), self.apply("cos", x))

    def _sinh(self, x: str) -> str:
        e = self.expm1(self.apply("abs", x))
        return self.mul(self.apply("sign", x), self.mul(self.add(e, self.div(e, self.add(e, 1.0))), 0.5))

    def _cosh(self, x: str) -> str:
        return self.mul(self.add(self.apply("exp", x), self.apply("exp", self.apply("negative", x))), 0.5)

    def _asinh(self, x: str) -> str:
        size = self.apply("abs", x)
        square = self.mul(x, x)
        root = self.apply("sqrt", self.add(square, 1.0))
        return self.mul(self.apply("sign", x), self.log1p(self.add(size, self.div(square, self.add(root, 1.0)))))

    def _acosh(self, x: str) -> str:
        t = self.sub(x, 1.0)
        return self.log1p(self.add(t, self.apply("sqrt", self.add(self.mul(t, 2.0), self.mul(t, t)))))

    def _atanh(self, x: str) -> str:
        size = self.apply("abs", x)
        half = self.mul(self.log1p(self.div(self.mul(size, 2.0), self.sub(1.0, size))), 0.5)
        return self.mul(self.apply("sign", x), half)

    def _atan(self, x: str) -> str:
        size = self.apply("abs", x)
        middle, large = self.less(self.graph.number(0.66), size), self.less(self.graph.number(2.414213562373095), size)
        shifted = self.div(self.sub(size, 1.0), self.add(size, 1.0))
        usable = self.where(large, size, 1.0)
        reduced = self.where(large, self.div(-1.0, usable), self.where(middle, shifted, size))
        base = self.where(large, math.pi / 2, self.where(middle, math.pi / 4, 0.0))
        z = self.mul(reduced, reduced)
        ratio = self.div(self.mul(z, self._polynomial(ATAN_P, z)), self._polynomial(ATAN_Q, z))
        found = self.add(base, self.add(reduced, self.mul(reduced, ratio)))
        return self.mul(self.apply("sign", x), found)

    def _asin(self, x: str) -> str:
        root = self.apply("sqrt", self.mul(self.sub(1.0, x), self.add(x, 1.0)))
        return self._atan(self.div(x, root))

    def _acos(self, x: str) -> str:
        ratio = self.div(self.sub(1.0, x), self.add(x, 1.0))
        return self.mul(self._atan(self.apply("sqrt", ratio)), 2.0)

    def _atan2(self, y: str, x: str) -> str:
        flat = self.equal(x, 0.0)
        quotient = self.apply("atan", self.div(y, self.where(flat, 1.0, x)))
        turned = self.where(self.less(y, 0.0), -math.pi, math.pi)
        left = self.where(self.less(x, 0.0), turned, 0.0)
        upright = self.mul(self.apply("sign", y), math.pi / 2)
        return self.where(flat, upright, self.add(quotient, left))

    def _erf(self, x: str) -> str:
        z = self.mul(x, x)
        inner = self.div(self.mul(x, self._polynomial(ERF_T, z)), self._polynomial(ERF_U, z))
        size = self.graph.op("Min", self.apply("abs", x), self.graph.number(8.0))
        tail = self.apply("exp", self.apply("negative", self.mul(size, size)))
        beyond = self.div(self.mul(tail, self._polynomial(ERFC_P, size)), self._polynomial(ERFC_Q, size))
        outer = self.mul(self.apply("sign", x), self.sub(1.0, beyond))
        return self.where(self.less(self.apply("abs", x), 1.0), inner, outer)

    # -------------------------------------------------------------- activations
    def activation(self, kind: str, z: str) -> str:
        """An activation of a layer."""
        match kind:
            case "silu":
                if not self.double:
                    return self.mul(z, self.graph.op("Sigmoid", z))
                return self.div(z, self.add(self.apply("exp", self.apply("negative", z)), 1.0))
            case "relu":
                return self.graph.op("Relu", z)
            case "sigmoid":
                return self.apply("logistic", z)
            case "gelu":
                return self.mul(self.mul(z, 0.5), self.add(self.apply("erf", self.div(z, math.sqrt(2.0))), 1.0))
            case "elu" if not self.double:
                return self.graph.op("Elu", z)
            case "elu":
                low = self.graph.op("Min", z, self.graph.number(0.0))
                return self.where(self.less(self.graph.number(0.0), z), z, self.expm1(low))
        return self.apply(kind, z)
