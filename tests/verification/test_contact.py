"""Contact and friction against closed forms. Equations stand in `endopilot.verification.contact`."""

from __future__ import annotations

import pytest

from endopilot.verification import contact


@pytest.mark.parametrize("group", contact.CASES, ids=lambda group: group.__name__)
def test_closed_form(group) -> None:
    for case in group():
        assert case.error <= case.bar, case.case
