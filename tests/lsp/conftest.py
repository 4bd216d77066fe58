from __future__ import annotations

from collections.abc import Iterator

import pytest

pytest.importorskip("pygls", reason="the extra `lsp` is not installed")

from tests.lsp.editor import Editor


@pytest.fixture(scope="session")
def editor() -> Iterator[Editor]:
    made = Editor()
    made.start()
    yield made
    assert made.stop() == 0
