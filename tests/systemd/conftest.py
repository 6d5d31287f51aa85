"""A package, and a machine to install it on: systemd as process 1 of fresh namespaces, `boot.sh`."""

import contextlib
import ctypes
import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

import pytest

CHECKOUT = Path(__file__).parents[2]
BOOT = Path(__file__).with_name("boot.sh")
NAMESPACES = ("--pid", "--fork", "--mount", "--mount-proc", "--cgroup", "--uts", "--ipc", "--net", "--kill-child")
VERSION = f"{sys.version_info[0]}.{sys.version_info[1]}"
PYTHON = f"env LD_LIBRARY_PATH=/opt/base/lib /opt/base/bin/python{VERSION}"
"How the machine finds this interpreter."
TRIAL = """mount -t tmpfs tmpfs /mnt && mkdir /mnt/upper /mnt/work /mnt/root /mnt/group
mount -t overlay overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work /mnt/root
mount -t cgroup2 cgroup2 /mnt/group"""
GROUPS = (Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/unified"))
GROUP = next((group for group in GROUPS if (group / "cgroup.procs").exists()), None)
DEATH_SIGNAL = 1
"PR_SET_PDEATHSIG: a test that is killed leaves no machine behind."
PATIENCE_S = 60.0
"Only a failure waits so long."


def missing() -> str:
    """Return why no such machine can be made here."""
    for program in ("unshare", "nsenter", "pivot_root", "systemctl"):
        if shutil.which(program) is None:
            return f"{program} is not installed"
    if not Path("/usr/lib/systemd/systemd").exists():
        return "systemd is not installed"
    # a container may allow the namespaces, and neither a view of its files nor a control group
    tried = subprocess.run(["unshare", *NAMESPACES, "sh", "-ec", TRIAL], capture_output=True, text=True, check=False)
    if tried.returncode:
        return f"namespaces or mounts are not allowed: {tried.stderr.strip()}"
    return f"{GROUP} may not be written" if GROUP is not None and not os.access(GROUP, os.W_OK) else ""


class Machine:
    """A booted machine, which has `shared` as /opt/shared."""

    imports: ClassVar = {"python": PYTHON, "library": "/opt/checkout:/opt/checkout/client/src:/opt/packages"}

    def __init__(self, folder: Path, shared: Path) -> None:
        self._folder, self._shared = folder, shared
        self._boot()

    def _boot(self) -> None:
        place = self._folder / "machine"
        place.mkdir(exist_ok=True)
        packages = sysconfig.get_path("purelib")
        # the new process 1 is the root of its own control group, and sees nothing of this machine's
        self._group = None if GROUP is None else GROUP / f"tormag-test-{os.getpid()}"
        if self._group is not None:
            self._group.mkdir(exist_ok=True)
        self.log = self._folder / "console.log"
        command = ["unshare", *NAMESPACES, "sh", str(BOOT)]
        command += [str(place), str(self._shared), str(CHECKOUT), sys.base_prefix, packages]
        with self.log.open("w") as log:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                preexec_fn=self._enter_group,
            )
        self.until(lambda: self.run("systemctl", "is-active", "basic.target", check=False) == "active", "booted")

    def start_again(self, folder: Path) -> None:
        self.close()
        self._folder = folder
        self._boot()

    def run(self, *command: str, check: bool = True) -> str:
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children")
        # there until the process is waited for
        first = children.read_text().split()[:1] if children.exists() else []
        if not first:
            assert self._process.poll() is None, self.log.read_text()
            return ""
        done = subprocess.run(
            ["nsenter", "--target", *first, "--all", *command],
            capture_output=True,
            text=True,
            check=False,
            timeout=PATIENCE_S,
            env={"PATH": "/usr/bin:/usr/sbin:/bin"},
        )
        assert not check or done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
        return done.stdout.strip()

    def shows(self, unit: str, *names: str) -> list[str]:
        shown = self.run("systemctl", "show", unit, *(f"--property={name}" for name in names))
        values = dict(line.split("=", 1) for line in shown.splitlines())
        return [values.get(name, "") for name in names]

    def until(self, reached: Callable[[], bool], what: str) -> None:
        until_s = time.monotonic() + PATIENCE_S
        while not reached():
            assert time.monotonic() < until_s, f"not within {PATIENCE_S:g} s: {what}\n{self.log.read_text()}"
            time.sleep(0.05)

    def close(self) -> None:
        self._process.kill()  # with --kill-child, its process 1 and so everything else
        self._process.wait()
        if self._group is not None:
            # the kernel removes a process after it has ended it
            until_s = time.monotonic() + PATIENCE_S
            while self._group.exists() and time.monotonic() < until_s:
                for folder, _, _ in os.walk(self._group, topdown=False):
                    with contextlib.suppress(OSError):
                        Path(folder).rmdir()

    def _enter_group(self) -> None:
        ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGKILL)
        if self._group is not None:
            (self._group / "cgroup.procs").write_text("0")


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Build the package of this checkout, with links to what a `Machine` imports."""
    if shutil.which("dpkg-deb") is None:
        pytest.skip("dpkg-deb is not installed")
    debians = subprocess.run(
        ["dpkg-query", "--show", "--showformat", "${Version}", "python3"], capture_output=True, text=True, check=False
    ).stdout
    if debians and not debians.startswith(f"{VERSION}."):
        pytest.skip(f"the package of Python {VERSION} is for a Debian that has it; this one's is {debians}")
    library, out = tmp_path / "library", tmp_path / "package"
    library.mkdir()
    for name in ("tormagd", "firmware_protocol", "client/src/tormagd_client"):
        shutil.copytree(CHECKOUT / name, library / Path(name).name, ignore=shutil.ignore_patterns("__pycache__"))
    for imported in Path(sysconfig.get_path("purelib")).iterdir():
        if not (library / imported.name).exists():
            (library / imported.name).symlink_to(f"/opt/packages/{imported.name}")
    for core in CHECKOUT.glob("*.so"):
        shutil.copy(core, library)
    environment = os.environ | {"PYTHON": sys.executable, "RUN_PYTHON": PYTHON, "COMPRESSION": "none"}
    made = subprocess.run(
        ["sh", str(CHECKOUT / "systemd/deb.sh"), str(library), str(out)],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stderr
    shutil.rmtree(library)
    (path,) = out.iterdir()
    return path


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    why_not = missing()
    if why_not:
        pytest.skip(f"no machine of its own: {why_not}")
    with contextlib.closing(Machine(tmp_path, tmp_path)) as made:
        yield made
