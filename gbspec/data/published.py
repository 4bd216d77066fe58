"""The published tables that models and pages refer to: they are not part of gbspec; a message says where they are."""

from __future__ import annotations

from pathlib import Path

COPS = "the report ANL/MCS-TM-273 on the COPS collection (Argonne National Laboratory, 2004)"

PUBLISHED = {
    "hare_lynx": "hudson-bay-lynx-hare.csv of stan-dev/example-models (columns Year, Lynx, Hare)",
    "algae_rotifers": "the authors of Yoshida and others, Nature 424 (2003) 303-306",
    "theophylline": "`Theoph` in R (dose_mg is Dose times Wt)",
    "alpha_pinene": COPS,
    "gas_oil": COPS,
    "methanol": COPS,
    "tclab": "the folder data/ of dowlinglab/pyomo-doe",
    "phenobarbital": "`Phenobarb` in R's package nlme",
    "emps": "www.nonlinearbenchmark.org",
    "flexhouse": "the example on the heat dynamics of a building of CTSM-R",
}
"""Where each table can be had, by the name of its file; docs/data_sources.md has origin, columns and terms."""


def where_to_get(path: Path) -> str:
    """What to say of a table that is not there: where to get it, or nothing if it is not a published one."""
    source = PUBLISHED.get(path.stem)
    if source is None:
        return ""
    return f"`{path.name}` is published by others and not part of gbspec: see {source}; docs/data_sources.md says more"
