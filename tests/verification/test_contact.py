"""Contact and friction against closed forms. Equations stand in `endopilot.simulation.verify_contact`."""

from __future__ import annotations

import pytest

from endopilot.simulation import verify_contact


@pytest.mark.parametrize("group", verify_contact.CASES, ids=lambda group: group.__name__)
def test_closed_form(group) -> None:
    for case in group():
        assert case.error <= case.bar, case.case
