"""The page of a commissioning: one HTML file with a row for each finding."""

from datetime import UTC, datetime
from html import escape

from tormagd.commission.finding import Finding
from tormagd.commission.sequence import STEPS, Report
from tormagd.view.html import page, table

FAIL = "FAIL"
HEADS = ("step", "finding", "measured", "allowed", "verdict", "what to do", "last time", "difference")
KIT = "python -m firmware_protocol.conformance PORT --json > FILE, then --conformance FILE"


def page_of(report: Report) -> str:
    title = f"Commissioning of device {report.serial_number}"
    before = f"; the last one began {_date(report.last_ns)}" if report.last_ns else ""
    parts = [
        f"<h1>{title}</h1>",
        f"<p>Begun {_date(report.began_ns)}{before}.</p>",
        _verdict(report),
        "<h2>Conformance of the firmware</h2>",
        _conformance(report),
    ]
    rows = [
        ("" if number else step.name, *row) for step in STEPS for number, row in enumerate(_rows(report, step.name))
    ]
    parts += ["<h2>The device</h2>", table(HEADS, rows, [row[4] == FAIL for row in rows])]
    return page(title, parts)


def _verdict(report: Report) -> str:
    said = []
    if report.stopped is not None:
        stopped = report.stopped
        said.append(
            f"Stopped in step {stopped.step}: {stopped.cause} ({stopped.code}). The gap was told to open. "
            f"What to do: {stopped.remedy}; then the same command with --resume."
        )
    elif not report.is_whole:
        said.append("It has not ended. The same command with --resume goes on.")
    if report.failed:
        said.append(f"Failed: {', '.join(each.name for each in report.failed)}.")
    if said:
        return "".join(f'<p class="bad">{escape(line)}</p>' for line in said)
    return "<p>Every row passed.</p>"


def _conformance(report: Report) -> str:
    if report.conformance is None:
        return f"<p>No report was given. The kit owns the device, so it runs without the daemon: {escape(KIT)}</p>"
    if not report.conformance:
        return "<p>All checks of the report passed.</p>"
    return table(("check", "seen", "expected"), report.conformance, [True] * len(report.conformance))


def _rows(report: Report, step: str) -> list[list[str]]:
    """Return the cells of a step's findings; one row where it was not done."""
    if step not in report.findings:
        is_without = step == "weight" and report.weight_N is None
        unknown = "--weight-N was not given: the sensor's gain is not known"
        return [[unknown if is_without else "not done", *[""] * 6]]
    return [_row(each, report.last.get(each.name)) for each in report.findings[step]]


def _row(each: Finding, last: float | None) -> list[str]:
    verdict, remedy = ("pass", "") if each.is_fine else (FAIL, each.remedy)
    since = ("", "")
    if last is not None and each.value is not None:
        since = (f"{last:.4g}", f"{round(each.value - last, 6):+.3g}")
    return [each.name, each.shown, each.allowed, verdict, remedy, *since]


def _date(time_ns: int) -> str:
    return f"{datetime.fromtimestamp(time_ns * 1e-9, UTC):%Y-%m-%d %H:%M} UTC"
