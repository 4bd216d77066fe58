"""Fits with a wrong postulate: the reactor with a wrong activation energy, in three forms.

    python -m benchmarks.studies.postulates -o docs/studies/postulates.md

The truth of `phi` is `Da*(1 - x1)*exp(x2)`. Each fit starts from `Da*(1 - x1)*exp(0.8*x2)`, corrected by the network as
a term, as a factor, and inside the exponential; and, for comparison, without a postulate. Data: the case's sampling.
The table has the errors of `gbspec validate` (L2).
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
import time
from pathlib import Path

WRONG = "Da*(1 - x1)*exp(0.8*x2)"
FORMS = {
    "none": "nn",
    "additive": f"{WRONG} + nn",
    "multiplicative": f"{WRONG}*nn",
    "composed": "Da*(1 - x1)*exp(0.8*x2 + nn)",
}
LINE = "| {} | {:.1e} | {:.1e} | {:.1e} | {:.1e} | {:.0f} |"


def errors(form: str, trajectories: int, noise: float, effort: str) -> tuple[float, ...]:
    """Errors of phi, right-hand side, solution and constants, and the seconds of processor time of the fit."""
    from gbspec import frontend
    from gbspec.data.cases import find_cases
    from gbspec.diagnostics import Findings, Source
    from gbspec.operations import analysing, fitting, models, tables
    from gbspec.training import TrainOptions

    path = frontend.resolve("urp_gb2")
    sampling = find_cases(path).of_model("urp_gb2").sampling
    data = tables.simulate(
        models.reference(frontend.load_model(path, Findings())),
        dataclasses.replace(sampling, trajectories=trajectories, noise=noise),
    )
    base = frontend.resolve("urp_gb1").read_text(encoding="utf-8")
    base = base.replace("unknown phi(x1, x2, Da)", f"unknown phi(x1, x2, Da) = {form}")
    texts = {"urp_gb1.gb": base, "urp_gb2.gb": path.read_text(encoding="utf-8")}
    model = frontend.load_model(path, Findings(), lambda name: Source(str(name), texts[Path(name).name]))
    began = time.process_time()
    with tempfile.TemporaryDirectory() as place:
        run = fitting.train(model, data, Path(place) / "run", TrainOptions(effort=effort, threads=1, workers=1))  # type: ignore[arg-type]
        seconds = time.process_time() - began
        found = analysing.validate(run, data, "mean").to_json()["truth"]
    assert isinstance(found, dict)
    return (
        found["functions"]["all"]["L2"],
        found["rhs"]["L2"],
        found["solution"]["L2"],
        found["constants"]["all"],
        seconds,
    )


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.studies.postulates", description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--trajectories", type=int, default=50)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--effort", default="normal")
    chosen = parser.parse_args()
    lines = [
        f"`python -m benchmarks.studies.postulates --trajectories {chosen.trajectories} --noise {chosen.noise:g} "
        f"--effort {chosen.effort}`: `urp_gb2`, `phi` postulated with exp(0.8 x2) instead of exp(x2), one member.",
        "",
        "| network | phi | right-hand side | solution | constants | CPU s |",
        "|---|---|---|---|---|---|",
    ]
    for name, form in FORMS.items():
        lines.append(LINE.format(name, *errors(form, chosen.trajectories, chosen.noise, chosen.effort)))
        chosen.output.parent.mkdir(parents=True, exist_ok=True)
        chosen.output.write_text("\n".join(lines) + "\n", encoding="utf-8")
        print(lines[-1], flush=True)


if __name__ == "__main__":
    main()
