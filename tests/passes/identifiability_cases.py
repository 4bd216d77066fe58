"""Cases of identifiability with thresholds, saturations, doses, inputs, branches and gauges, derived by hand.

Each has the text of its model, the number of directions, the constants in them, the unknowns that absorb, and the
reason for this verdict.
"""

from __future__ import annotations

ORAL = "state g\nstate c\nlearn ka = 1\nlearn ke = 0.3\ng' = -ka*g\nc' = ka*g - ke*c\n"
CELL = "state q in [0, 1]\ninput I in [-2, 2] held\nlearn Q = 2 in [0.1, 10]\nq' = -I/Q\n"
OVER = "state x in [0, {}]\nlearn k = 1\nx' = -k*max(x - 5, 0)\nobserve x\n"
LEVELS = "state x in [{}]\nlearn a = 2\nlearn b = 1\nx' = -(a + b*floor(x))*x\nobserve x\n"
SENSOR = (
    "input u in [0, 8] held\nstate x1 in [0, 14] = 5\nstate x2 in [{}, 14] = 12\nlearn k = 0.04 in [0.005, 0.3]\n"
    "unknown q1(x1)\nunknown q2(x2)\nx1' = k*u - q1\nx2' = q1 - q2\nobserve y = {}\n"
)
SIDES = "state x in [{}, 10]\nlearn a = 2\nlearn b = 1\nx' = -(a + b*sign(x - 2))*x\nobserve x\n"


def chain(first: str, last: str, starts: bool) -> str:
    """Seven states in a row, the last of which is observed; the first has a known source."""
    names = [f"x{i}" for i in range(1, 8)]
    flows = ["1", *(first if i == 1 else last if i == 6 else f"x{i}" for i in range(1, 7))]
    balances = [f"{x}' = {flow} - {x}\n" for x, flow in zip(names, flows, strict=True)]
    return "".join(
        [
            "time t from 0\nlearn k = 1 in [0.1, 10]\n",
            *(f"state {x}\n" for x in names),
            *balances,
            *(f"initial {x} = 0\n" for x in names if starts),
            "observe x7\n",
        ]
    )


Case = tuple[str, int, set[str], set[str], str]

FURTHER: dict[str, Case] = {
    "the last flow of a long chain that is empty at first": (
        chain("x1", "k*x6", True), 0, set(), set(), "k first shows in the seventh derivative of x7",
    ),
    "the first flow of a long chain that is empty at first": (
        chain("k*x1", "x6", True), 0, set(), set(), "as before: every flow is a factor of it",
    ),
    "a flow of a long chain between what is always empty": (
        chain("x1", "x6", True).replace("= 1 - x1", "= -x1").replace("x3 - x4", "k*x3 - x4"), 1, {"k"}, set(),
        "without a source the chain stays empty",
    ),
    "absorption of a dose": (
        ORAL + "dose g\ninitial g = 0\ninitial c = 0\nobserve c\n", 0, set(), set(),
        "after a dose D, c'(0) = ka*D and c''(0) = -ka*(ka + ke)*D",
    ),
    "absorption without a dose": (
        ORAL + "initial g = 0\nobserve c\n", 1, {"ka"}, set(), "g stays 0, so that ka multiplies nothing",
    ),
    "absorption from a free start": (
        ORAL + "observe c\n", 0, set(), set(), "c decays with both rates; ke belongs to what starts in c",
    ),
    "fraction and volume of a dose": (
        "learn F = 0.8\nlearn V = 2\n" + ORAL + "dose g times F\ninitial g = 0\ninitial c = 0\nobserve y = c/V\n",
        1, {"F", "V"}, set(), "y depends on F/V alone",
    ),
    "fraction and volume of a dose, a second compartment": (
        "learn F = 0.8\nlearn V = 2\n" + ORAL.replace("- ke*c", "- ke*c - k12*c + k21*p")
        + "learn k12 = 0.4\nlearn k21 = 0.6\nstate p\np' = k12*c - k21*p\n"
        + "dose g times F\ninitial g = 0\ninitial c = 0\ninitial p = 0\nobserve y = c/V\n",
        1, {"F", "V"}, set(), "y depends on F/V alone; the rates show in the sixth derivative, beyond the orders tried",
    ),
    "volume of a dose": (
        "learn V = 2\n" + ORAL + "dose g\ninitial g = 0\ninitial c = 0\nobserve y = c/V\n",
        0, set(), set(), "the amount is given: y'(0) = ka*D/V, and ka, ke follow from higher derivatives",
    ),
    "fraction of a dose into a measured state": (
        "state x\nlearn F = 0.8\nlearn k = 1\nx' = -k*x\ndose x times F\nobserve x\n", 0, set(), set(),
        "the jump of x is F*D",
    ),
    "fraction of a dose and scale of a channel": (
        "state x\nlearn F = 0.8\nlearn s = 2\nx' = -x\ndose x times F\nobserve y = s*x\n", 1, {"F", "s"}, set(),
        "x -> c*x with F -> c*F, s -> s/c: the start is free",
    ),
    "known dose gives the scale of a channel": (
        "state x\nlearn s = 2\nlearn k = 1\nx' = -k*x\ndose x\nobserve y = s*x\n", 0, set(), set(),
        "the jump of y is s*D",
    ),
    "lag of a dose": (
        "state x\nlearn k = 1\nlearn L = 0.5\nx' = -k*x\ndose x lag L\nobserve x\n", 0, set(), set(),
        "the time of the jump is seen",
    ),
    "dose of an unknown elimination": (
        "state x\nlearn F = 0.8\nlearn s = 2\nunknown f(x)\nx' = -f(x)\ndose x times F\nobserve y = s*x\n",
        1, {"F", "s"}, {"f"}, "x -> c*x with F -> c*F, s -> s/c, and f(x) -> c*f(x/c)",
    ),
    "threshold within the range": (OVER.format(10), 0, set(), set(), "above 5, x' = -k*(x - 5)"),
    "threshold beyond the range": (OVER.format(4), 1, {"k"}, set(), "x <= 4 < 5, so that the term is 0"),
    "threshold without a range": (
        "state x\nlearn k = 1\nx' = -k*max(x - 500, 0)\nobserve x\n", 0, set(), set(), "x may start above 500",
    ),
    "product above a threshold": (
        "state x in [0, 10]\nlearn a = 1\nlearn b = 2\nx' = -a*b*max(x - 5, 0)\nobserve x\n", 1, {"a", "b"}, set(),
        "only a*b enters, on either side",
    ),
    "the other branch separates": (
        "state x in [0, 10]\nlearn a = 1\nlearn b = 2\nx' = if(x > 5, -a*b*x, -a*x)\nobserve x\n", 0, set(), set(),
        "a from x < 5, then b from x > 5",
    ),
    "the other branch lies beyond the range": (
        "state x in [6, 10]\nlearn a = 1\nlearn b = 2\nx' = if(x > 5, -a*b*x, -a*x)\nobserve x\n", 1, {"a", "b"}, set(),
        "x > 5 always",
    ),
    "saturation that is never reached": (
        "state x in [0, 1]\nlearn b = 5 in [2, 9]\nx' = -min(x, b)\nobserve x\n", 1, {"b"}, set(), "x <= 1 < 2 <= b",
    ),
    "saturation that always holds": (
        "state x in [10, 20]\nlearn a = 1 in [1, 2]\nlearn b = 3 in [1, 5]\nx' = -min(a*x, b)\nobserve x\n",
        1, {"a"}, set(), "a*x >= 10 > 5 >= b",
    ),
    "saturation within the range": (
        "state x in [0, 10]\nlearn a = 1 in [0.5, 2]\nlearn b = 3 in [1, 5]\nx' = -min(a*x, b)\nobserve x\n",
        0, set(), set(), "a from small x, b from large x",
    ),
    "both sides of a sign": (SIDES.format(0), 0, set(), set(), "a + b above 2 and a - b below"),
    "one side of a sign": (SIDES.format(3), 1, {"a", "b"}, set(), "a + b alone where x > 2"),
    "several levels": (LEVELS.format("0, 3"), 0, set(), set(), "a, a + b, a + 2 b"),
    "a single level": (LEVELS.format("1.2, 1.8"), 1, {"a", "b"}, set(), "a + b alone where floor(x) = 1"),
    "a schedule": (
        "time t from 0\nstate x in [0, 3]\nlearn a = 2\nlearn b = 1\n"
        "x' = if(mod(t, 24) < 8, a, b) - x\nobserve x\n", 0, set(), set(), "a by day, b at night",
    ),
    "friction": (
        "state v in [-2, 2]\nlearn a = 1\nlearn b = 2\nv' = -a*sign(v) - b*v\nobserve v\n", 0, set(), set(),
        "a line in v on either side",
    ),
    "size of a value": (
        "state x in [-5, 5]\nlearn a = 1\nlearn b = 2\nx' = -a*abs(x) - b*x\nobserve x\n", 0, set(), set(),
        "slope -a - b above 0, a - b below",
    ),
    "size of a positive value": (
        "state x in [1, 5]\nlearn a = 1\nlearn b = 2\nx' = -a*abs(x) - b*x\nobserve x\n", 1, {"a", "b"}, set(),
        "slope -(a + b) alone",
    ),
    "branches of a condition": (
        "state c\ncondition sex\nlearn a = 1\nlearn b = 2\nc' = -if(sex > 0.5, a, b)*c\nobserve c\n", 0, set(), set(),
        "one rate from each group of trajectories",
    ),
    "a branch that no condition has": (
        "state c\ncondition sex in [0, 0.4]\nlearn a = 1\nlearn b = 2\nc' = -if(sex > 0.5, a, b)*c\nobserve c\n",
        1, {"a"}, set(), "sex <= 0.4",
    ),
    "a category": (
        "state c\ncondition sex\nlearn a = 1\nlearn b = 2\nc' = -if(sex == 1, a, b)*c\nobserve c\n", 0, set(), set(),
        "trajectories with sex = 1 show a, the others b",
    ),
    "branches of time": (
        "time t from 0\nstate x\nlearn a = 1\nlearn b = 2\nx' = -if(t > 5, a, b)*x\nobserve x\n", 0, set(), set(),
        "b before 5, a later",
    ),
    "branches that only some combinations show": (
        "state x in [0, 10]\nstate y in [0, 10]\nlearn a = 1\nlearn b = 2\nx' = -a*b*max(x - 5, 0)*max(y - 8, 0)\n"
        "y' = -b*max(5 - x, 0)*max(y - 8, 0)\nobserve x\nobserve y\n",
        0, set(), set(), "b where x < 5 and y > 8, a*b where x > 5 and y > 8",
    ),
    "a kinked term added to an unknown": (
        "state x in [0, 10]\nlearn k = 1\nunknown f(x)\nx' = f(x) - k*max(x - 5, 0)\nobserve x\n", 1, {"k"}, {"f"},
        "f takes up any function of x",
    ),
    "a kinked term in another variable": (
        "state x in [0, 10]\nstate y in [0, 10]\nlearn k = 1\nunknown f(x)\nx' = f(x) - k*max(y - 5, 0)\ny' = -y\n"
        "observe x\nobserve y\n",
        0, set(), set(), "f cannot depend on y",
    ),
    "an unknown in one branch": (
        "state x in [0, 10]\nlearn k = 1\nunknown f(x)\nx' = if(x > 5, f(x), -k*x)\nobserve x\n", 0, set(), set(),
        "k from x < 5, where f does not enter",
    ),
    "own offset": (
        "state x\nlearn k = 1\nlearn a = 1 per trajectory\nx' = -k*x + a\nobserve x\n", 0, set(), set(),
        "a is one number in a trajectory, while x changes",
    ),
    "own offset beside an input": (
        "state x\ninput F held\nlearn k = 1\nlearn a = 1 per trajectory\nx' = k*F + a\nobserve x\n", 0, set(), set(),
        "F changes within a trajectory, a does not",
    ),
    "own factor of an input": (
        "state x\ninput F held\nlearn k = 1\nlearn a = 1 per trajectory\nx' = k*a*F\nobserve x\n", 1, {"k"}, {"a"},
        "a takes up any factor",
    ),
    "gain of an input and scale of a channel": (
        "state x\ninput F held\nlearn g = 1\nlearn s = 2\nx' = -x + g*F\nobserve y = s*x\n", 1, {"g", "s"}, set(),
        "x -> c*x with g -> c*g, s -> s/c",
    ),
    "known input gives the scale of a channel": (
        "state x\ninput F held\nlearn k = 1\nlearn s = 2\nx' = -k*x + F\nobserve y = s*x\n", 0, set(), set(),
        "a step of F changes y' by s times the step",
    ),
    "cell with an unknown voltage": (
        CELL + "unknown ocv(q)\nobserve V = ocv(q)\n", 1, {"Q"}, {"ocv"},
        "q -> c*q with Q -> Q/c: voltage as a function of the charge drawn alone",
    ),
    "cell with an unknown voltage, first charge known": (
        CELL + "unknown ocv(q)\ninitial q = 1\nobserve V = ocv(q)\n", 1, {"Q"}, {"ocv"},
        "1 - q -> c*(1 - q) with Q -> Q/c",
    ),
    "cell with a linear voltage": (
        CELL + "learn a = 3\nlearn b = 1\nobserve V = a + b*q\n", 2, {"a", "b", "Q"}, set(),
        "V' = -b*I/Q; a is taken up by the first charge",
    ),
    "cell with a known curved voltage": (
        "state q in [0.1, 1]\ninput I in [-2, 2] held\nlearn Q = 2 in [0.1, 10]\nq' = -I/Q\nobserve V = 3 + log(q)\n",
        0, set(), set(), "V gives q, and V' = -I/(Q*q)",
    ),
    "cell with a resistance": (
        CELL + "learn R = 0.1\nunknown ocv(q)\nobserve V = ocv(q) - R*I\n", 1, {"Q"}, {"ocv"},
        "R from a step of I; Q as without it",
    ),
    "terms that a constant input does not tell apart": (
        "state q\nstate p\nstate y\ninput F held\nlearn a = 1\nlearn b = 2\nq' = F\np' = F^2\n"
        "y' = a*F*q + b*p\ninitial q = 0\ninitial p = 0\nobserve y\n",
        0, set(), set(), "(a + b)*F^2*t while F is constant; a change of F separates them",
    ),
    "large numbers": (
        "state x in [0, 1e6]\nlearn V = 5e4 in [1e3, 1e6]\nlearn K = 2e5 in [1e3, 1e6]\nx' = -V*x/(K + x)\nobserve x\n",
        0, set(), set(), "the shape of the curve gives V and K",
    ),
    "small rates": (
        "state x in [0, 1]\nstate y in [0, 1]\nlearn a = 1e-5\nlearn b = 3e-6\nx' = -a*x\ny' = a*x - b*y\nobserve x\n"
        "observe y\n",
        0, set(), set(), "two slopes, however small",
    ),
    "tanks in a row with unknown outflows, a sensor with an upper limit": (
        SENSOR.format(0, "min(x2, 10)"), 0, set(), set(), "below the limit y is x2: q2 from x2' at u = 0, k from x2''",
    ),
    "the same limit as a condition": (SENSOR.format(0, "if(x2 < 10, x2, 10)"), 0, set(), set(), "as before"),
    "the same limit as what is cut off": (SENSOR.format(0, "x2 - max(x2 - 10, 0)"), 0, set(), set(), "as before"),
    "a sensor that is always at its limit": (
        SENSOR.format(11, "min(x2, 10)"), 1, {"k"}, set(), "y is 10 whatever happens",
    ),
    "a sensor with a limit and an unknown scale": (
        SENSOR.replace("learn k", "learn s = 1 in [0.5, 2]\nlearn k").format(0, "min(s*x2, 10)"),
        1, {"s", "k"}, {"q1", "q2"}, "levels in other units, s and k with them: y is unchanged on both sides",
    ),
    "the logarithm of one of three states, whose sizes and constants differ by many decades": (
        "state T in [0, 1e6]\nstate I in [0, 1e6]\nstate V in [1, 1e8]\nlearn beta in [1e-10, 1e-6]\n"
        "learn delta in [0.01, 5]\nlearn p in [10, 10000]\nlearn c in [1, 50]\nunknown s(T)\n"
        "T' = 10000*s - beta*T*V\nI' = beta*T*V - delta*I\nV' = p*I - c*V\nobserve y = log(V)\n",
        1, {"p"}, {"s"}, "T and I in other units, p and s with them; free starts hide all else below the fourth order",
    ),
    "rates that differ by fifteen decades": (
        "time t from 0\nstate a\nstate b\nstate c\nstate d\nlearn fast = 1e9 in [1e8, 1e10]\n"
        "learn quick = 1e5 in [1e4, 1e6]\nlearn slow = 1e-6 in [1e-7, 1e-5]\na' = -fast*a\nb' = fast*a - quick*b\n"
        "c' = quick*b - slow*c\nd' = slow*c\ninitial a = 1\ninitial b = 0\ninitial c = 0\ninitial d = 0\n"
        "observe a\nobserve b\nobserve c\n",
        0, set(), set(), "c decays with the rate slow, which many digits tell beside the others",
    ),
}  # fmt: skip

UNDECIDED: dict[str, tuple[str, str]] = {
    "rates that differ by fifteen decades, with a branch": (
        "time t from 0\nstate a\nstate b\nstate c in [0, 2]\nstate d\nlearn fast = 1e9 in [1e8, 1e10]\n"
        "learn quick = 1e5 in [1e4, 1e6]\nlearn slow = 1e-6 in [1e-7, 1e-5]\na' = -fast*a\nb' = fast*a - quick*b\n"
        "c' = quick*b - slow*max(c, 0)\nd' = slow*max(c, 0)\ninitial a = 1\ninitial b = 0\n"
        "initial c = 0\ninitial d = 0\nobserve a\nobserve b\nobserve c\n",
        "c decays with the rate slow, which beside the others is below rounding",
    ),
    "overflow that a known start may reach": (
        "state h in [0, 5]\ninput F in [0, 9] held\nlearn k = 1\nlearn r = 2\nh' = F - k*h - r*max(h - 2, 0)\n"
        "initial h = 0\nobserve h\n",
        "whether h rises above 2 is up to F and k",
    ),
    "saturation that another start might reach": (
        "state x in [0, 1]\nlearn b = 5\nx' = -min(x, b)\nobserve x\n", "b has no bound, so that it may be below 1",
    ),
    "a threshold in a comparison": (
        "state x in [0, 10]\nlearn w = 5 in [1, 9]\nx' = if(x > w, -2*x, -x)\nobserve x\n",
        "where x' jumps shows w, but no formula has it",
    ),
}  # fmt: skip
