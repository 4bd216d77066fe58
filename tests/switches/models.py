"""Models whose right-hand sides switch, as texts."""

OVERFLOW = """model overflow
time t from 0
state h in [0, 3]
learn rim = 1.0 in [0.5, 2]
learn k = 2.0 in [0.1, 10]
h' = 3*sin(2*t)^2 - k*max(h - rim, 0) - h
initial h = 0.3
observe h
truth rim = 1.07
truth k = 2.5
"""

RELAY = """model relay
time t from 0
state x in [-3, 3]
state y in [-3, 3]
learn a = 0.4 in [0, 1]
learn f = 0.8 in [0.1, 3]
x' = y
y' = -4*x + if(x > a, -f, 0.3*f*cos(t))
initial x = 1
initial y = 0
observe x
truth a = 0.37
truth f = 0.9
"""
"""A force that jumps with the position."""

FRICTION = """model friction
time t from 0
state x in [-3, 3]
state v in [-3, 3]
learn c = 2.0 in [0, 5]
learn k = 4.0 in [1, 10]
x' = v
v' = -k*x - c*sign(v)
initial x = 3
initial v = 0.1
observe x
"""
"""Coulomb's friction, until it sticks."""

ORDER = """model order
time t from 0
state x in [0, 2]
learn k = 0.4 in [0.1, 10]
learn n = 1.3 in [0.2, 3]
x' = k*max(1 - x, 0)^n + 0.2*x
initial x = 0
observe x
"""
"""A power of what is nothing beyond a switch, with a learned exponent."""

SEVERAL = """model several
time t from 0
state a in [0, 4]
state b in [0, 4]
input u linear in [0, 2]
learn p = 0.7 in [0.1, 2]
learn q = 0.5 in [0.1, 2]
let excess = max(a - p, 0)
a' = u - q*excess - 0.3*abs(a - b)
b' = if(a > p and b > q, excess - 0.5*b, -0.4*b) + min(0.3, b*p, 0.1 + 0.2*a) - sqrt(max(b - 0.2, 0))
initial a = 0.2
initial b = 0.9
event dip when b <= 0.3: b = b + 0.6*p
observe a
observe total = a + b + excess
"""
"""Kinks and jumps, a switch in an intermediate that is observed, inputs, and an event."""
