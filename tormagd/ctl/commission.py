"""`tormagctl commission`: judge the device that is plugged in, step by step, and write one page on it."""

import sys
import time
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from tormagd.commission.calibration import calibration
from tormagd.commission.procedure import Known
from tormagd.commission.sequence import MAX_BYTES, STEPS, Findings, Report, Step, Stopped, begun, due, sequence
from tormagd.config import Config, checked
from tormagd.ctl.calibrate import agree
from tormagd.ctl.calibrate_run import Run, connected, known_of
from tormagd.ctl.outcome import CommandError, Exit, Outcome, as_usage_error, usage_error
from tormagd.ground.files import in_place_of, read_bounded
from tormagd.ground.terminal import write_line
from tormagd.scenes.scene import Scene
from tormagd.view.commission_page import page_of
from tormagd_client.blocking import Client
from tormagd_client.endpoints import ConfigError, Endpoints
from tormagd_client.errors import ClientError

SOURCE = "commission"
Read = TypeVar("Read")


class _Conformance(msgspec.Struct):
    """The fields used of the conformance kit's report."""

    checks: list["_Check"]


class _Check(msgspec.Struct):
    name: str
    passed: bool
    seen: str
    expected: str


def commission(
    endpoints: Endpoints,
    wait_s: float,
    folder: Path,
    is_resumed: bool,
    weight_N: float | None,
    conformance: Path | None,
    is_agreed: bool,
) -> Outcome:
    """Run all steps on the device, and keep findings and page in `folder`, by serial number."""
    checks = None if conformance is None else _failed_checks(conformance)
    with Client(endpoints, wait_s, SOURCE) as client:
        status, running = client.status(), client.describe()
        with as_usage_error(ConfigError, hint="check that tormagd and tormagctl are of the same version"):
            config, scene = checked(running.configuration, Config), checked(running.scene, Scene)
        known = known_of(config, status, scene.force.most_N, weight_N)
        serial_number = status.link.serial_number
        if serial_number is None:
            raise CommandError(Exit.REFUSED, "no_device", "no device is connected", "tormagctl firmware says why")
        path = folder / f"{serial_number:08x}.json"
        before = _decoded(path, Report, "it is no report: move it away") if path.exists() else None
        if before is not None and before.serial_number != serial_number:
            cause = f"{path}: serial_number = {before.serial_number}: allowed is {serial_number}, the device's"
            raise usage_error(cause, "it is of another device: move it away")
        if is_resumed:
            if before is None:
                raise usage_error(f"{path}: there is nothing to resume", "leave --resume out")
            if before.motor != config.motor:  # a calibration came into force: the findings are of another motor
                raise usage_error(f"{path}: [motor] has changed since, in the daemon", "leave --resume out")
            report = before.resumed(weight_N)
        else:
            report = begun(before, serial_number, time.time_ns(), weight_N, config.motor)
        if not is_agreed:
            agree()
        kept = Kept(path, report if checks is None else msgspec.structs.replace(report, conformance=checks))
        with connected(endpoints, client) as run:
            kept.follow(run, known)
    report = kept.report
    if report.is_whole:
        kept.write(".toml", calibration(report, config))
    text = [f"{path.with_suffix('.html')}: {'all rows passed' if report.is_sound else 'not all rows passed'}"]
    text += [f"{each.name}: {each.shown}, allowed {each.allowed}\n  next: {each.remedy}" for each in report.failed]
    if report.stopped is not None:
        text.append(f"stopped in {report.stopped.step}: {report.stopped.cause}\n  next: {report.stopped.remedy}")
    result = {"page": str(path.with_suffix(".html")), **msgspec.to_builtins(report)}
    return Outcome(result, "\n".join(text), Exit.DONE if report.is_sound else Exit.REFUSED)


class Kept:
    """A report that is written to its file after each step, with the page beside it."""

    def __init__(self, path: Path, report: Report) -> None:
        self._path, self.report, self._step = path, report, ""
        self._write()

    def follow(self, run: Run, known: Known) -> None:
        """Run the steps that are `due`, in order, and write the report after each."""
        steps = due(STEPS, known, self.report.findings)

        def begins(step: Step) -> None:
            self._step = step.name
            write_line(f"step {steps.index(step) + 1} of {len(steps)}, {step.name}: {step.says}", sys.stderr)
            run.progress.begin(step.name, step.lasts_s)

        def ends(step: Step, found: Findings) -> None:
            run.progress.end()
            self._note(findings=self.report.findings | {step.name: list(found)})

        try:
            self._note(stopped=run.follow(sequence(steps, known, begins, ends)))
        except ClientError as error:
            self._note(stopped=Stopped(self._step, error.code, error.message, error.hint))
            raise

    def _note(self, **changes: Any) -> None:
        self.report = msgspec.structs.replace(self.report, **changes)
        self._write()

    def _write(self) -> None:
        self.write(".json", msgspec.json.format(msgspec.json.encode(self.report)).decode() + "\n")
        self.write(".html", page_of(self.report))

    def write(self, suffix: str, text: str) -> None:
        with as_usage_error(OSError, hint="give a folder that you may write to"):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with in_place_of(self._path.with_suffix(suffix)) as beside:
                beside.write_text(text, encoding="utf-8")


def _failed_checks(path: Path) -> list[tuple[str, str, str]]:
    report = _decoded(path, _Conformance, "give what the kit prints with --json")
    return [(each.name, each.seen, each.expected) for each in report.checks if not each.passed]


def _decoded(path: Path, kind: type[Read], hint: str) -> Read:
    """Read a JSON file of limited size as a `kind`; on an error `hint` says what to do."""
    with as_usage_error(OSError, ValueError, hint=hint):
        try:
            return msgspec.json.decode(read_bounded(path, MAX_BYTES), type=kind)
        except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: {error}") from error
