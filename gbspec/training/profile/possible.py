"""Which parameters have a profile, and what the fit says of them."""

from __future__ import annotations

from gbspec.diagnostics import Diagnostic, UserError
from gbspec.ir import Model
from gbspec.runs import Run
from gbspec.training.runs import of_all


def check(model: Model, name: str) -> None:
    """Raises UserError (GB858) for what is neither a learned constant that trajectories share, nor one whose
    distribution has a learned median, nor the spread of a distribution."""
    known = dict.fromkeys([*(k.name for k in model.learnables if of_all(k)), *_spreads(model)])
    if name not in known:
        listed = ", ".join(f"`{one}`" for one in known)
        help = f"constants and spreads with a profile are {listed}" if known else "the model has none that has"
        message = (
            f"`{name}` has no profile: it is neither a learned constant with one value or one median for all "
            "trajectories, nor a learned spread"
        )
        raise UserError([Diagnostic("GB858", message, None, help=help, subject=name)])


def of_fit(run: Run, name: str) -> tuple[float, tuple[float, float] | None]:
    """The estimate and the interval of the fit, of a constant or of a spread."""
    if name in run.fit.constants:
        return run.fit.constants[name].value, run.fit.constants[name].interval
    assert run.fit.population is not None
    effects = run.fit.population.effects
    key = _spreads(run.model)[name]
    found = effects.get(key) or effects[key.partition(" per ")[0]]
    return found.sd, found.sd_interval


def _spreads(model: Model) -> dict[str, str]:
    """The learned spreads of distributions, with the names of the records that have them."""
    out = dict[str, str]()
    for k in model.distributed:
        assert k.distribution is not None
        columns = ("", *(f" per {level.column}" for level in k.distribution.levels))
        names = (spread for spread, _ in k.distribution.spreads)
        out |= {name: f"{k.name}{per}" for name, per in zip(names, columns, strict=True) if name is not None}
    return out
