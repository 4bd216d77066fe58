"""`pytest -p tests.on_gpu tests/engines …`: every torch engine that the tests make for the processor works on a GPU.

So the tests of engines, written for the processor, are tests of the GPU too. `tests/training/test_device.py` compares
both itself and is run without this.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch

from gbspec.training.engines.torch.engine import TorchEngine


def pytest_configure() -> None:
    """Raises pytest.UsageError where there is no GPU."""
    if not torch.cuda.is_available():
        raise pytest.UsageError("torch finds no GPU on this machine")
    plain = TorchEngine.__init__

    def on_gpu(
        self: TorchEngine, problem: Any, parameters: Any, device: str = "cpu", *options: Any, **named: Any
    ) -> None:
        plain(self, problem, parameters, "cuda" if device == "cpu" else device, *options, **named)

    TorchEngine.__init__ = on_gpu  # type: ignore[method-assign]
