"""The element: what it is (physics), what was learned of it (model), which field gives a force (inverse)."""
