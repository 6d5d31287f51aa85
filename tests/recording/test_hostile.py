"""Whatever a file holds, readers refuse it in a sentence or read it, within 200 MB."""

import json
import subprocess
import sys
from pathlib import Path

import hostile

READABLE = {
    "a small message of brackets", "a schema of brackets", "metadata of brackets", "ever new columns",
    "a million columns at once", "a time beyond all", "a summary that is the file", "a chunk within a chunk",
    "70,000 schemas in a chunk", "a message without a chunk, too short", "a footer without a summary",
    "an index that names the same metadata fifty times", "a summary of 30 MB", "a summary beyond all",
}  # fmt: skip
MAX_MB = 200
READ = """
import json, sys
from pathlib import Path
from tormagd.record.reader import BlackBoxFile, RecordingError, RecordingFile, read_recording as read, overview_of

def read_recording(path):
    read(path, dict[str, object], lambda seen: None)
said = {}
for path in map(Path, sys.argv[1:]):
    for look in (BlackBoxFile,) if path.name.startswith("black") else (overview_of, RecordingFile, read_recording):
        try:
            look(path)
        except RecordingError as error:
            said[f"{look.__name__} {path}"] = str(error)
peak = next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1]
print(json.dumps([int(peak) // 1024, said]))
"""


def test_hostile_files_are_refused_in_a_sentence_within_200_MB(tmp_path: Path) -> None:
    files = {str(path): name.partition(": ")[2] for name, path in hostile.write(tmp_path)}
    assert len(files) >= 25
    done = subprocess.run([sys.executable, "-P", "-c", READ, *files], capture_output=True, text=True, check=True)
    peak_MB, said = json.loads(done.stdout)
    assert peak_MB < MAX_MB
    assert [each for look, each in said.items() if look.split(" ", 1)[1] not in each or "\n" in each] == []
    assert max(map(len, said.values())) <= 400
    assert [each for look, each in said.items() if each.count(look.split(" ", 1)[1]) > 1] == []
    assert [each for each in said.values() if "Invalid argument" in each] == []
    bomb = next(path for path, name in files.items() if name.startswith("a thousand damaged"))
    assert "unpacks to over" in said[f"read_recording {bomb}"]
    # at a glance, before all of it is read
    glanced = {files[each.split(" ", 1)[1]] for each in said if not each.startswith("read_recording")}
    assert set(files.values()) - glanced <= READABLE
