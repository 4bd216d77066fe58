"""Networks as C: their weights in constant tables, their values, and derivatives along a direction."""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.backends import NetworkNumbers, activation_parts
from gbspec.exports.c.printer import ascii_text, number, table
from gbspec.ir import Network

LAYER = """\
/* b + W a; the weights are kept by columns, so that the inner loops run over neighbouring numbers. */
static void layer(int n_in, int n_out, const double *w, const double *b, const double *restrict a, double *restrict z) {
    int i, o;
    for (o = 0; o < n_out; o++) z[o] = b ? b[o] : 0.0;
    for (i = 0; i + 4 <= n_in; i += 4, w += 4 * n_out) {
        const double a0 = a[i], a1 = a[i + 1], a2 = a[i + 2], a3 = a[i + 3];
        for (o = 0; o < n_out; o++)
            z[o] += w[o] * a0 + w[n_out + o] * a1 + w[2 * n_out + o] * a2 + w[3 * n_out + o] * a3;
    }
    for (; i < n_in; i++, w += n_out)
        for (o = 0; o < n_out; o++) z[o] += w[o] * a[i];
}
"""

ACTIVATIONS = {
    "silu": ("x / (1.0 + exp(-x))", "const double p = 1.0 / (1.0 + exp(-x));", "p * (1.0 + x * (1.0 - p))"),
    "tanh": ("tanh(x)", "const double y = tanh(x);", "1.0 - y * y"),
    "softplus": ("x > 40.0 ? x : log1p(exp(x))", "", "1.0 / (1.0 + exp(-x))"),
    "relu": ("x < 0.0 ? 0.0 : x", "", "x > 0.0 ? 1.0 : 0.0"),
    "gelu": (
        "0.5 * x * (1.0 + erf(x / 1.4142135623730951))",
        "",
        "0.5 * (1.0 + erf(x / 1.4142135623730951)) + x * 0.3989422804014327 * exp(-0.5 * x * x)",
    ),
    "sigmoid": ("1.0 / (1.0 + exp(-x))", "const double p = 1.0 / (1.0 + exp(-x));", "p * (1.0 - p)"),
    "elu": ("x > 0.0 ? x : expm1(x)", "", "x > 0.0 ? 1.0 : exp(x)"),
    "sin": ("sin(x)", "", "cos(x)"),
}
"""The value of an activation at x, and its slope with a line before it."""


def shared(networks: tuple[Network, ...]) -> list[str]:
    """What all networks use: a layer, and the activations with their slopes."""
    kinds = {kind for n in networks for i in range(len(n.hidden)) for kind, _ in activation_parts(n, i)}
    lines = LAYER.splitlines() if networks else []
    for kind in sorted(kinds):
        value, before, slope = ACTIVATIONS[kind]
        lines += ["", f"static void apply_{kind}(int n, double *z) {{", "    int i;", "    for (i = 0; i < n; i++) {"]
        lines += ["        const double x = z[i];", f"        z[i] = {value};", "    }", "}", ""]
        lines += [f"static void apply_{kind}_along(int n, double *z, double *dz) {{", "    int i;"]
        lines += ["    for (i = 0; i < n; i++) {", "        const double x = z[i];"]
        lines += [f"        {line}" for line in (before,) if line]
        lines += [f"        dz[i] *= {slope};", f"        z[i] = {value};", "    }", "}"]
    return [*lines, ""] if lines else []


def network(index: int, network: Network, numbers: NetworkNumbers) -> list[str]:
    """The tables and the two functions of a network."""
    sizes, last = network.sizes, len(network.hidden)
    name = f"NETWORK_{index}"
    lines = [f"/* {ascii_text(', '.join(network.outputs))}: {'-'.join(map(str, sizes))} */"]
    for i, (weight, bias) in enumerate(numbers.layers):
        lines += _table(f"{name}_WEIGHT_{i}", weight.T) + _table(f"{name}_BIAS_{i}", bias)
    lines += _table(f"{name}_CENTER", numbers.input_center) + _table(f"{name}_SCALE", numbers.input_scale)
    if not numbers.raw:
        lines += _table(f"{name}_OUT_CENTER", numbers.output_center) + _table(f"{name}_OUT_SCALE", numbers.output_scale)
    widest = max(sizes)
    for along in (False, True):
        head = f"network_{index}{'_along' if along else ''}(const double *argument, "
        head += "const double *direction, double *out, double *moved)" if along else "double *out)"
        buffers = [f"{letter}{i}[{widest}]" for letter in ("z", "dz")[: 1 + along] for i in (0, 1)]
        body = ["int i;", f"double {', '.join(buffers)};", f"for (i = 0; i < {sizes[0]}; i++) {{"]
        body.append(f"    z0[i] = (argument[i] - {name}_CENTER[i]) / {name}_SCALE[i];")
        body += [f"    dz0[i] = direction[i] / {name}_SCALE[i];"] * along + ["}"]
        for i in range(last + 1):
            into, of, sized = (i + 1) % 2, i % 2, f"{sizes[i]}, {sizes[i + 1]}, {name}_WEIGHT_{i}"
            body.append(f"layer({sized}, {name}_BIAS_{i}, z{of}, z{into});")
            body += [f"layer({sized}, NULL, dz{of}, dz{into});"] * along
            if i < last:
                body += _activated(network, i, into, along)
        scaled = f"{name}_OUT_CENTER[i] + {name}_OUT_SCALE[i] * z" if not numbers.raw else "z"
        of = (last + 1) % 2
        body += [f"for (i = 0; i < {sizes[-1]}; i++) {{", f"    out[i] = {scaled}{of}[i];"]
        body += [f"    moved[i] = {'' if numbers.raw else f'{name}_OUT_SCALE[i] * '}dz{of}[i];"] * along + ["}"]
        lines += [f"static void {head} {{", *(f"    {line}" for line in body), "}", ""]
    return lines


def _activated(network: Network, layer: int, into: int, along: bool) -> list[str]:
    lines, begin = [], 0
    for kind, count in activation_parts(network, layer):
        place = f" + {begin}" if begin else ""
        more = f"_along({count}, z{into}{place}, dz{into}{place});" if along else f"({count}, z{into}{place});"
        lines.append(f"apply_{kind}{more}")
        begin += count
    return lines


def _table(name: str, values: Array) -> list[str]:
    return table("double", name, map(number, np.ravel(values)))
