"""The meaning of each word of the language in one line, for hover and completion."""

from __future__ import annotations

from gbspec.ir import NOISES as FORMS
from gbspec.syntax import ast

STATEMENTS: dict[str, str] = {s.entry.word: s.entry.meaning for s in ast.STATEMENTS if s.entry.spelled}
"""The words that begin a statement."""

CLAUSES: dict[str, str] = {
    "extends": "the file whose declarations this one replaces or adds to; in or below the same folder",
    "from": "when every trajectory starts",
    "in": "a range `[low, high]`; after `increasing`, `convex`, `odd`, `period 24` and the like the argument",
    "as": "the column of the data, if it has another name",
    "held": "the input keeps its value until the next filled cell",
    "linear": "the input is interpolated linearly between filled cells",
    "pchip": "between the points of a table: cubic pieces that rise and fall as the points do",
    "cubic": "between the points of a table: a cubic spline, smooth up to its second derivative",
    "outside": "what holds beyond the points of a table: `outside hold` or `outside error`",
    "hold": "`outside hold`: beyond the points of a table the nearest value holds",
    "error": "`outside error`: beyond the points of a table there is no value",
    "prior": "prior knowledge about the constant: `normal(mean, sd)` or `lognormal(median, cv)`",
    "noise": "the noise of a measurement: " + ", ".join(f"`{form.signature}`" for form in FORMS.values()),
    "poisson": "`noise poisson`: counts, with the prediction as their mean and their variance",
    "per": "`per trajectory`: each trajectory has its own value; `per trajectory ~ lognormal`: with a distribution",
    "trajectory": "`per trajectory`: each trajectory has its own value, with or without a distribution",
    "rate": "the rate of a process, or of a claim",
    "over": "how long an infusion lasts, where the table does not say: `dose S over 0.5`",
    "times": "the fraction of a dose that arrives",
    "lag": "how much later a dose arrives",
    "when": "the event happens when this condition becomes true",
    "every": "a timed event happens again, each so long after the one before",
    "until": "the last time at which a timed event happens",
    "after": "how long after its condition an event happens",
    "queue": "how many delayed times of one event can wait together; 1 if it is left out",
    "priority": "the order of events at one time: larger ones first",
    "transient": "a delayed event does not happen if its condition ends before",
    "sampled": "right sides see the values when the condition became true, not those when the event acts",
    "armed": "the event also happens at the start, if its condition is true there",
    "by": "the network that represents the unknown: `mlp(32, 32, activation=silu)`",
    "zero": "`zero at v = e`: the function vanishes there, for every weight",
    "at": "`zero at v = e`: the function vanishes there, for every weight; of an event: the time when it happens",
    "increasing": "`increasing in v`: the function never falls as v grows, for every weight",
    "decreasing": "`decreasing in v`: the function never rises as v grows, for every weight",
    "convex": "`convex in v`: the function's slope never falls as v grows, for every weight",
    "concave": "`concave in v`: the function's slope never rises as v grows, for every weight",
    "odd": "`odd in v`: f(-v) = -f(v), for every weight",
    "even": "`even in v`: f(-v) = f(v), for every weight",
    "period": "`period 24 in v`: f(v + 24) = f(v), for every weight",
    "equals": "`equals e at v = e0`: the function's value there, for every weight",
    "steady": "`initial steady`, `initial X steady`: the start is a steady state, reached from the declared starts",
    "with": "`initial steady with L = 0`: the value of an input or a condition while the steady state is sought",
    "then": "`initial steady then X = 1`: what a state is set to once the steady state was found",
    "learn": "the initial value is learned for each trajectory",
}
"""The words within statements."""

OPERATORS: dict[str, str] = {
    "if": "`if(condition, a, b)`: a if the condition holds, else b",
    "and": "both conditions hold",
    "or": "one of the conditions holds, or both",
    "not": "the condition does not hold",
}
"""The words within expressions."""

FUNCTIONS: dict[str, tuple[str, str]] = {
    "exp": ("exp(x)", "the exponential function"),
    "log": ("log(x)", "the natural logarithm"),
    "log10": ("log10(x)", "the logarithm to base 10"),
    "sqrt": ("sqrt(x)", "the square root"),
    "sin": ("sin(x)", "the sine, x in radians"),
    "cos": ("cos(x)", "the cosine, x in radians"),
    "tan": ("tan(x)", "the tangent, x in radians"),
    "tanh": ("tanh(x)", "the hyperbolic tangent"),
    "sinh": ("sinh(x)", "the hyperbolic sine"),
    "cosh": ("cosh(x)", "the hyperbolic cosine"),
    "asin": ("asin(x)", "the inverse of the sine, in radians"),
    "acos": ("acos(x)", "the inverse of the cosine, in radians"),
    "atan": ("atan(x)", "the inverse of the tangent, in radians"),
    "atan2": ("atan2(y, x)", "the angle of the point (x, y), in radians"),
    "asinh": ("asinh(x)", "the inverse of the hyperbolic sine"),
    "acosh": ("acosh(x)", "the inverse of the hyperbolic cosine"),
    "atanh": ("atanh(x)", "the inverse of the hyperbolic tangent"),
    "abs": ("abs(x)", "the absolute value"),
    "min": ("min(a, b, …)", "the smallest of its arguments"),
    "max": ("max(a, b, …)", "the largest of its arguments"),
    "sign": ("sign(x)", "-1, 0 or 1 as x is negative, zero or positive"),
    "floor": ("floor(x)", "the largest whole number that is not above x"),
    "ceil": ("ceil(x)", "the smallest whole number that is not below x"),
    "mod": ("mod(x, y)", "what is left of x above the multiple of y below it, with the sign of y: `mod(t, 24)`"),
    "net": ("net(X)", "the sum of all processes' contributions to the rate of change of the state X"),
    "delay": (
        "delay(X, tau)",
        "what a state, an input or a `let` was a time tau ago, unless the model declares `delay`",
    ),
    "sum": ("sum(c)", "the sum of all elements of an array of states"),
}
"""The functions of the language: how each is called, and its meaning."""

VALUES: dict[str, str] = {
    "pi": "the ratio of a circle's circumference to its diameter, 3.14159…",
    "nn": "the output of the network, in the postulate of an unknown",
}

DISTRIBUTIONS: dict[str, str] = {
    "normal": "a normal distribution: `prior normal(mean, sd)`, `noise normal(sd)`",
    "lognormal": "a lognormal distribution: `prior lognormal(median, cv)`, `noise lognormal(cv)`",
}

NOISES: dict[str, str] = {
    "student": "Student's distribution, for measurements with outliers: `noise student(scale, df)`",
    "negative_binomial": "counts that vary more than Poisson's, with the variance f + f^2/k at the prediction f: "
    "`noise negative_binomial(k)`",
}

NETWORKS: dict[str, str] = {
    "mlp": "a multilayer perceptron: the widths of its hidden layers, and `activation=`",
    "spline": "a smooth cubic spline of one or two arguments, in place of a network: the number of its coefficients",
}

OPTIONS: dict[str, str] = {"activation": "the function between the layers of the network"}


def meaning(word: str) -> str:
    """The line on a word of the language from any of the tables; empty if there is none."""
    if word in FUNCTIONS:
        return FUNCTIONS[word][1]
    tables = (STATEMENTS, CLAUSES, OPERATORS, VALUES, DISTRIBUTIONS, NOISES, NETWORKS, OPTIONS)
    return next((table[word] for table in tables if word in table), "")
