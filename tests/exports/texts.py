"""Models in which every construct of the language occurs that an export has to translate."""

from __future__ import annotations

from gbspec.backends import load_module
from gbspec.data.shipped import shipped_models
from gbspec.diagnostics import Findings, Source
from gbspec.exports import Exported
from gbspec.frontend import load_model
from gbspec.ir import METHODS, RK4, Explicit, Method, Model

BUNDLED = sorted(
    name
    for name, path in shipped_models().items()
    if path.parent.name not in ("robertson", "switching", "chemistry", "delayed")
)
"""The names of the bundled models but the stiff ones, where explicit steps multiply rounding errors, and those with
events, which only units carry out, or delays."""
EXPLICIT = sorted(name for name, method in METHODS.items() if isinstance(method, Explicit))
"""The methods whose steps can be exported."""

CHOICES = """model choices
time t
state x in [0, 1]
state y in [0, 3]
condition k in [0.5, 2]
input u in [0, 1] held
input w in [0, 1] linear
const lambda = 0.7
learn a = 1.3 in [0.1, 10]
unknown phi(x, w) by mlp(5, activation=silu)
x' = u - phi(x, w)*x + if(x > 0.5, sqrt(x), a*x^2) - max(x, y, lambda)
y' = min(k*y, 2) - abs(y - x)^1.5 + sin(t)*exp(-y) - y^a + if(x > 0.2 and not(y > 1 or k > 1), 1, -1)
observe x
observe z = x*y + tanh(w)
"""

DOSED = """model dosed
time t
condition weight in [50, 90] = 70
state depot
state central in [0, 5]
const part = 0.8
learn ka = 1.1 in [0.1, 5]
learn late = 0.02 in [0, 1]
unknown loss(central, depot) >= 0, zero at central = 0, increasing in central by mlp(4, 4)
initial depot = part*weight/70
dose depot times part lag late
dose central
depot' = -ka*depot
central' = ka*depot - loss(central, depot)*(weight/70)^0.75
observe central
"""


HAPPENING = """model happening
time t from 0
input F in [0, 1] = 0.4 held
const low = 0.5
state S in [0, 4] = 1
state v in [-3, 3] = 0
state h in [0, 3] = 1
discrete on = 0
discrete n = 0
dose S
S' = F*on - 0.6*S
v' = -1
h' = v
event feed when S <= low: on = 2
event stop when S >= 1.3 priority 1: on = 0
event bounce when h <= 0: v = -0.8*v, h = 0
event count when on > 1: n = n + 1
event pulse at 0.37 every 0.9 until 2.5: S = S + 0.1*v^2, n = n + 10
event begin armed when h >= 0.5: n = n + 100
initial S = 1
initial v = 0
initial h = 1
observe S
observe h
"""


SWITCHED = """model switched
time t
state x in [0, 2] = 0
state y in [-3, 3] = 0
learn a = 1.3 in [0.1, 10]
x' = if(t > 1.234567, 0.5, a)
y' = if(x > 0.7, 1, -2) + if(y < -1 and x < 1.5, -0.5, 0)
observe x
observe y
"""


REPEATED = """model repeated
time t
state x in [0, 2] = 0
state y in [-3, 3] = 0
learn a = 1.3 in [0.1, 10]
x' = if(mod(t, 0.8) < 0.3, a, 0) - 0.5*x
y' = floor(4*x) - ceil(2*y)
observe x
observe y
"""


def model_of(text: str) -> Model:
    """A model from its text."""
    return load_model("model.gb", Findings(), lambda path: Source(str(path), text))


def exported(model: Model, method: Method = RK4, seed: int = 1) -> Exported:
    """A model with random weights, whose inputs were trained in [0.2, 0.6]."""
    cls = load_module(model, method)
    instance = cls.random(seed)
    for network in cls.networks:
        for end, value in (("low", 0.2), ("high", 0.6)):
            instance.weights[f"network.{network['name']}.input_{end}"] = (
                0 * instance.weights[f"network.{network['name']}.input_center"] + value
            )
    return Exported(model, instance, model.name, step=0.01)
