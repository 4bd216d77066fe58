"""Models with tables of every kind."""

from __future__ import annotations

EVERY_KIND = """model tables
time t
state x in [0, 2]
state y in [0, 3]
condition k in [0.5, 2]
input u in [0, 1] held
learn a = 1.3 in [0.1, 10]
table linear1(x) = (-0.5, 0.2), (0.1, 0.9), (0.7, 0.3), (1.6, 1.4), (3, 1)
table smooth1(x) = (0, 0.2), (0.3, 0.9), (0.7, 1.1), (1.1, 1.05), (1.6, 1.4) pchip
table spline1(x) = (0, 0.2), (0.3, 0.9), (0.7, 1.1), (1.1, 1.05), (1.6, 1.4) cubic
table map(x, y) = (0, 0, 1), (0, 1, 2), (0, 2.5, -1), (0.8, 0, 0.5), (0.8, 1, 1.5), (0.8, 2.5, 0.1), (2, 0, 1),
    (2, 1, 0.2), (2, 2.5, 1.4)
table spline2(x, y) = (0, 0, 1), (0, 1, 2), (0, 2.5, -1), (0.8, 0, 0.5), (0.8, 1, 1.5), (0.8, 2.5, 0.1), (2, 0, 1),
    (2, 1, 0.2), (2, 2.5, 1.4) cubic
unknown phi(x, y) by mlp(5)
x' = linear1(a*x) - x*smooth1(y) + phi(x, y)*map(x, a*y) - u*spline1(x*k)
y' = spline2(x, y) - y*smooth1(x) + 0.1*phi(y, x)
observe x
observe z = spline2(y, x) + a*linear1(y)
"""
