"""Time of `gbspec check`: every bundled model, and generated ones of increasing size.

    python -m benchmarks.check_time [--rounds 3] [--sizes 200 500 1000 2000]

Each figure is the median processor time of whole processes, imports and start-up included, compared with
importing only sympy. Generated models are reactions in a ring (every state with a balance, a process and an unknown
shared by all) and the same number of states as one array (diffusion by the method of lines).
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median

from benchmarks.harness import Timing, busyness, interleaved, markdown, parser, process, write
from gbspec.data.shipped import shipped_models


def ring(states: int) -> str:
    """Reactions in a ring; each state is consumed by one and produced by two of them."""
    lines = ["model ring", "learn k = 1 in [0, 10]", "unknown f(a in [0, 10]) >= 0 by mlp(8)"]
    for i in range(states):
        after, far = (i + 1) % states, (i + 7) % states
        lines += [
            f"state x{i} in [0, 10] = 1",
            f"process p{i}: x{i} -> 0.5*x{after} + x{far} rate k*f(x{i})",
            f"x{i}' = net(x{i}) - 0.1*x{i}",
            f"observe x{i}",
        ]
    return "\n".join(lines) + "\n"


def line(states: int) -> str:
    """Diffusion, flow and an unknown reaction along a line, as one array."""
    return f"""model line
const h = 1/{states}
learn D = 1 in [0, 10]
state c[1..{states}] in [0, 10] = 1
unknown r(c in [0, 10]) >= 0 by mlp(8)
c[i]' = D*(c[i-1] - 2*c[i] + c[i+1])/h^2 - r(c[i])
c[0] = 1
c[{states + 1}] = c[{states}]
observe c[1]
observe total = sum(c)
"""


FORMS: Mapping[str, Callable[[int], str]] = {"ring of reactions": ring, "array": line}


def table(timings: Mapping[str, Timing], alone: str) -> str:
    """Processor and wall seconds, and processor time over that of importing sympy."""
    base = median(timings[alone].cpu)
    rows = [
        [name, f"{median(t.cpu):.2f}", f"{t.median:.2f}", f"{median(t.cpu) / base:.1f}"] for name, t in timings.items()
    ]
    return markdown(["", "processor time, s", "wall time, s", "times `import sympy`"], rows)


def main() -> None:
    """Runs the benchmark and writes check_time.md and check_time.json."""
    options = parser(__doc__)
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--sizes", type=int, nargs="*", default=[200, 500, 1000, 2000])
    chosen = options.parse_args()
    alone = "`import sympy` alone"
    runs = {alone: process("-c", "import sympy")}
    runs |= {f"`{name}`": process("-m", "gbspec", "check", name) for name in shipped_models()}
    with tempfile.TemporaryDirectory() as folder:
        for form, text in FORMS.items():
            for size in chosen.sizes:
                path = Path(folder) / f"{form.split()[0]}{size}.gb"
                path.write_text(text(size))
                runs[f"{form}, {size:,} states"] = process("-m", "gbspec", "check", str(path))
        timings = interleaved(runs, chosen.rounds)
    result = {"busyness": round(busyness(timings), 3), "timings": {name: t.to_json() for name, t in timings.items()}}
    write("check_time", "How long `gbspec check` takes", table(timings, alone), result, chosen.output)


if __name__ == "__main__":
    main()
