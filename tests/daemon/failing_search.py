"""A core whose plans fail when a test says so."""

from tormagd.control.assembly.build import Core
from tormagd.element.inverse.solution import FieldSolution
from tormagd.element.model.force_curve import ForceCurve


class FailingSearch:
    """Searches as the core's does, until its `error` is set."""

    def __init__(self, core: Core) -> None:
        self._search = core.element.search
        self.core = core._replace(element=core.element._replace(search=self))
        self.error: Exception | None = None

    def solve(self, curve: ForceCurve, force_N: float, last_field_mT: float | None) -> FieldSolution:
        if self.error is not None:
            raise self.error.with_traceback(None)  # the trace would grow each time, and take long to log
        return self._search.solve(curve, force_N, last_field_mT)
