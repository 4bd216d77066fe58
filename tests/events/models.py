"""Models with events, as texts."""

BALL = """model ball
time t from 0
state h in [0, 10]
state v in [-20, 20]
discrete n = 0
learn e = 0.75 in [0.5, 1]
learn g = 9.5 in [5, 15]
h' = v
v' = -g
initial h = 5
initial v = 0
event bounce when h <= 0 and v < 0: v = -e*v, n = n + 1
observe h
observe n
truth e = 0.8
truth g = 9.81
"""

THERMOSTAT = """model thermostat
time t from 0
state T in [10, 30]
discrete on = 1
learn low = 18.5 in [15, 20]
learn high = 21.5 in [20, 25]
learn k = 0.3 in [0.05, 1]
T' = k*(8 - T) + 6*on
initial T = 15
event start when T <= low: on = 1
event stop when T >= high: on = 0
observe T
truth low = 18
truth high = 22
truth k = 0.25
"""

MIXED = """model mixed
time t from 0
state a in [0, 4]
state b in [0, 4]
discrete mode = 0
input u linear
learn wait = 0.73 in [0, 2]
learn pause = 0.6 in [0.3, 1]
learn limit = 1.3 in [0.5, 3]
learn tlag = 0.21 in [0, 1]
learn own = 0.4 > 0 per trajectory
unknown f(a, b) by mlp(4, activation=tanh)
a' = 0.5 + 0.3*f + 0.3*u - own*a
b' = if(mode > 0, 0.8, 0.1)*a - 0.2*b
dose a lag tlag
event pulse at wait every pause until 2.7: b = b + 0.3*a
event full when a + b >= limit: a = 0.4*a, b = 0.5*b, mode = 1 - mode
event rest when u >= 0.8: a = a + 0.1*limit
observe a
observe total = a + b
"""
