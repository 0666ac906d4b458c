"""The rod core against closed forms and an independent engine: walls, friction, catheters, moving vessels, order."""
