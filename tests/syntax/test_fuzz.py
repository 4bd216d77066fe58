"""A short campaign of mutated files; `python -m tests.fuzz` runs longer ones."""

from __future__ import annotations

from collections import Counter

import pytest

from tests.fuzz import MUTATIONS, campaign, corpus, outcome
from tests.fuzz_guided import loaded


def test_mutated_files_give_a_model_or_diagnostics() -> None:
    results = list(campaign(count=300, first=0, workers=1))
    failures = {number: found.detail for number, found, _ in results if found.kind == "failure"}
    assert not failures
    kinds = Counter(found.kind for _, found, _ in results)
    assert kinds["model"] > 3 and kinds["findings"] > 100  # the mutations neither break everything nor nothing


def test_the_campaign_notices_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gbspec.syntax.parse", lambda source, findings: 1 / 0)
    assert outcome("model m\n").kind == "failure"


def test_every_mutation_changes_some_text() -> None:
    import random

    text = corpus()[0]
    for mutation in MUTATIONS:
        assert any(mutation(text, random.Random(seed)) != text for seed in range(20)), mutation.__name__


def test_guided_fuzzing_sees_the_modules_of_the_readers() -> None:
    # packages load their modules when first used; what is loaded after the instrumentation is not seen
    names = loaded()
    for name in ("syntax.reading", "semantics.units", "lower.statements", "data.sheet", "data.cells", "runs.record"):
        assert f"gbspec.{name}" in names
