"""The derivatives of legs from those of their sub-steps, which are computed all together."""

from __future__ import annotations

import numpy as np

from gbspec.arrays import Array
from gbspec.training.engines.filter.functions import Functions
from gbspec.training.engines.filter.layout import At
from gbspec.training.engines.filter.local import Arrays
from gbspec.training.engines.filter.recursion import Flow, Moment, predicted
from gbspec.training.problem import Integers


def whole_legs(functions: Functions, at: At, owner: Integers, starts: Array, data: Arrays) -> tuple[Array, ...]:
    """The derivatives of mean, transition and added covariance of legs with D sub-steps, whose coordinates are `starts`
    [B, D, n]: in the parameters [B, ..., width], and those of the last two in the coordinates [B, n, n, n]."""
    b, depth, n = starts.shape
    t, h, u, doses, condition = data
    flat = starts.reshape(b * depth, n)
    many = np.repeat(owner, depth)
    tables = (t.reshape(-1), h.reshape(-1), u.reshape(b * depth, *u.shape[2:]), doses.reshape(b * depth, -1))
    found = functions.step(flat, at.k[many], at.w, (*tables, np.repeat(condition, depth, axis=0)))
    parts = [part.reshape(b, depth, *part.shape[1:]) for part in found.parts]
    states = [part.reshape(b, depth, *part.shape[1:]) for part in found.by_state]
    columns = [part.reshape(b, depth, *part.shape[1:]) for part in at.columns(found, many)]
    width = n + columns[0].shape[-1]
    moment = Moment(flat.reshape(b, depth, n)[:, 0], np.zeros((b, n, n)))
    moment.dm, moment.dp = np.zeros((b, n, width)), np.zeros((b, n, n, width))
    moment.dm[:, :, :n] = np.eye(n)
    a, da = np.tile(np.eye(n), (b, 1, 1)), np.zeros((b, n, n, width))
    for s in range(depth):
        shift = [np.concatenate([np.zeros((*c[:, s].shape[:-1], n)), c[:, s]], axis=-1) for c in columns]
        a_step, a_state = parts[1][:, s], states[1][:, s]
        change = shift[1] + np.matmul(a_state.reshape(b, n * n, n), moment.dm).reshape(b, n, n, width)
        along = np.matmul(np.swapaxes(a, 1, 2)[:, None], change)
        da = along + np.matmul(a_step, da.reshape(b, n, n * width)).reshape(b, n, n, width)
        a = np.matmul(a_step, a)
        flow = Flow(moment.m, parts[0][:, s], a_step, parts[2][:, s], a_state, states[2][:, s], *shift)
        moment = predicted(moment, flow)
    assert moment.dm is not None
    assert moment.dp is not None
    return moment.dm[..., n:], da[..., n:], moment.dp[..., n:], da[..., :n], moment.dp[..., :n]
