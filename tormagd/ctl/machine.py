"""What `/proc` and `/sys` say about this machine, read under a root that tests can replace."""

import os
import re
from collections.abc import Sequence
from pathlib import Path

from tormagd_client.printable import printable


class Machine:
    """A machine described by the file system under `root`; paths are absolute on that machine."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def path(self, absolute: str) -> Path:
        return self.root / absolute.lstrip("/")

    def text(self, absolute: str) -> str | None:
        """Read a file's text, stripped; None if it cannot be read."""
        try:
            return self.path(absolute).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None

    def number(self, absolute: str) -> int | None:
        text = self.text(absolute)
        return int(text) if text is not None and re.fullmatch(r"\d+", text) else None

    def limit(self, name: str) -> float:
        """Return this process's soft limit; infinity for unlimited, 0 if it is not listed."""
        found = re.search(rf"^{name}\s+(\S+)", self.text("/proc/self/limits") or "", re.MULTILINE)
        return 0.0 if found is None else float(found[1].replace("unlimited", "inf"))

    def has_capability(self, bit: int) -> bool:
        """Tell whether this process holds a capability of capabilities(7)."""
        found = re.search(r"^CapEff:\s*([0-9a-f]+)$", self.text("/proc/self/status") or "", re.MULTILINE)
        return found is not None and bool(int(found[1], 16) >> bit & 1)

    def cores(self) -> int:
        ranges = re.findall(r"(\d+)(?:-(\d+))?", self.text("/sys/devices/system/cpu/online") or "0")
        return sum(int(last or first) - int(first) + 1 for first, last in ranges) or 1

    def stolen(self) -> tuple[int, int]:
        """Return the ticks that a hypervisor took from all processors since the start, and all ticks (proc_stat(5))."""
        first = (self.text("/proc/stat") or "").split("\n", 1)[0]
        fields = [int(field) for field in first.split()[1:9]]  # without guests, which count as users already
        return fields[7] if len(fields) == 8 else 0, sum(fields)

    def resolved(self, absolute: str) -> str:
        there, root = os.path.realpath(self.path(absolute)), os.path.realpath(self.root)
        return f"/{os.path.relpath(there, root)}"

    def holders(self, paths: Sequence[str]) -> tuple[dict[str, list[tuple[int, str]]], int]:
        """Return the processes that have each of `paths` open, and how many processes are hidden."""
        holding: dict[str, list[tuple[int, str]]] = {path: [] for path in paths}
        hidden = 0
        for process in sorted(self.path("/proc").glob("[0-9]*")):
            if process.name == str(os.getpid()):
                continue
            # a process may end meanwhile, or its files be another user's
            try:
                targets = {os.path.realpath(link) for link in (process / "fd").iterdir()}
            except PermissionError:
                hidden += 1
                continue
            except OSError:
                continue
            for path in targets & holding.keys():
                holding[path].append((int(process.name), self.process_name(int(process.name))))
        return holding, hidden

    def process_name(self, process_id: int) -> str:
        return printable(self.text(f"/proc/{process_id}/comm") or "?")

    def lock_owners(self, absolute: str) -> list[int]:
        """Return the ids of the processes that hold a flock on a file."""
        try:
            status = self.path(absolute).stat()
        except OSError:
            return []
        inode = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
        rows = [line.split() for line in (self.text("/proc/locks") or "").splitlines()]
        return sorted({int(row[4]) for row in rows if len(row) > 5 and row[1] == "FLOCK" and row[5] == inode})
