"""Planning of adaptive steps and of frozen matrices by the kernel."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gbspec.arrays import Array
from gbspec.ir import METHODS, RosenbrockW
from gbspec.training.engines.native.inputs import KernelInputs, Latest
from gbspec.training.engines.native.kernel import Kernel
from gbspec.training.engines.native.tables import Tables
from gbspec.training.engines.native.threads import workspace
from gbspec.training.problem import MOST_STEPS, Integers, Parameters, Path, Problem, Steps, meshed

ROOM = 512
"""Steps for which there is room at first, for each trajectory of a tile."""


@dataclass(frozen=True)
class Planner:
    """Plans paths with a kernel, as `engines.torch.control` does with torch."""

    kernel: Kernel
    latest: Latest
    room: list[int] = field(default_factory=lambda: [0])
    """The room that was needed so far."""

    def __call__(self, problem: Problem, parameters: Parameters, theta: Array, path: Path) -> Path:
        """The path with the steps and matrices of the solution at a vector."""
        inputs = self.latest.at(problem, parameters, theta)
        tables, order = Tables(problem, path), np.argsort(-path.packed.steps, kind="stable").astype(np.int64)
        tile = self.kernel.library.sizes["TILE"]
        parts = [self._tile(problem, tables, inputs, order[i : i + tile]) for i in range(0, len(order), tile)]
        return meshed(path, Steps.joined(parts)) if parts else path

    def _tile(self, problem: Problem, tables: Tables, inputs: KernelInputs, who: Integers) -> Steps:
        """The steps of a tile of trajectories, or of fewer."""
        library, control = self.kernel.library, problem.control
        tile = library.sizes["TILE"]
        n = len(problem.model.states)
        matrices = isinstance(METHODS[problem.module.solver], RosenbrockW)
        factored = matrices and not problem.model.events
        room = max(ROOM, self.room[0]) + 2 * int(tables.steps[who].max(initial=0))
        while True:
            taken, cell = np.zeros(tile, dtype=np.int64), np.zeros((tile, room), dtype=np.int32)
            begin, length = np.zeros((tile, room)), np.zeros((tile, room))
            factors = np.empty((tile, room, n, n)) if matrices else None
            exchanges = np.empty((tile, room, n), dtype=np.int32) if factored else None
            walk = library.struct(
                "Walk",
                count=len(who),
                room=room,
                most=MOST_STEPS,
                who=np.resize(who, tile),
                rtol=np.array([-1.0 if control is None else control.rtol]),
                floor=np.zeros(n) if control is None else control.floor,
                taken=taken,
                cell=cell,
                begin=begin,
                length=length,
                factors=factors,
                exchanges=exchanges,
            )
            space = workspace(self.kernel.work_bytes(1))
            if library.control(tables.data(library), inputs.struct(library), walk, space):
                break
            room *= 4
            self.room[0] = room
        used = np.arange(room) < taken[:, None]
        used[len(who) :] = False
        lane = np.nonzero(used)[0]
        return Steps(
            np.resize(who, tile)[lane],
            cell[used].astype(np.int64),
            begin[used],
            length[used],
            np.zeros((len(lane), 0, 0)) if factors is None else factors[used],
            np.zeros((len(lane), 0), dtype=np.int32) if exchanges is None else exchanges[used],
        )
