"""What `tormag-lab` promises: its commands, how they refuse, and what they need."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tormag_lab import errors
from tormag_lab.main import COMMANDS, main
from tormagd import __version__
from tormagd.element.model.model_file import load_model

ROOT = Path(__file__).parents[2]
SOURCES = [
    path for folder in ("tormagd", "firmware_protocol", "lab/src") for path in sorted((ROOT / folder).rglob("*.py"))
]
PAGES = [
    *ROOT.glob("*.md"),
    ROOT / "Makefile",
    *(ROOT / "docs").rglob("*.md"),
    *(ROOT / "systemd").rglob("*.md"),
]
HEAVY = ("torch", "sklearn", "clarabel", "dask", "distributed", "pyarrow", "matplotlib")
WITHOUT = """
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {heavy!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
from tormag_lab.main import main
"""
COMMAND = "sys.exit(main(sys.argv[1:]))"
HELP = """
for name in sys.argv[1:]:
    try:
        main([name, "--help"])
    except SystemExit as ended:
        assert ended.code == 0, name
"""
LIGHT = ("identify-motor", "optimise-design", "tune-position")


def without_heavy(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """The program without the heavy packages, as from the Debian package."""
    line = [sys.executable, "-P", "-c", WITHOUT.format(heavy=HEAVY) + program, *arguments]
    return subprocess.run(line, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_says_what_it_does_and_takes_json(name, capsys):
    with pytest.raises(SystemExit, match="0"):
        main([name, "--help"])
    told = capsys.readouterr().out
    assert told.startswith(f"usage: tormag-lab {name} ")
    assert "--json" in told


@pytest.mark.parametrize(("arguments", "exit_code"), [([], 0), (["--help"], 0), (["train"], 2)])
def test_the_commands_are_listed(arguments, exit_code, capsys):
    assert main(arguments) == exit_code
    told = capsys.readouterr()
    assert all(f"  {name} " in (told.err if exit_code else told.out) for name in COMMANDS)
    assert "'train'" in told.err or not exit_code


def test_it_says_which_version_it_is(capsys):
    assert (main(["--version"]), capsys.readouterr().out) == (0, f"tormag-lab {__version__}\n")


FORCES, MOTOR, ROWS = (
    "t_s,force_N\n0,1\n",
    "t_s,input_V,position_mm\n",
    "displacement_mm,rate_mm_s,field_mT,cip_percent,force_N\n",
)
GOOD = ROWS + "".join(f"{0.02 * k},{k},{100 + k * k % 7},40,{1 + 0.1 * k}\n" for k in range(40))
TRAIN = ("train-model", "--element", "torque", "--insert", "MRE-50-40", "--hidden", "5", "--epochs", "5")
REFUSED: list[tuple[tuple[str, ...], str, str]] = [
    (("optimise-design", "--region", "1", "1", "1", "1"), "", "most_N = 1"),
    (("optimise-design", "--region", "1", "1", "2", "2", "--dask", "no://one"), "", "--dask no://one: unknown address"),
    (("tune-position", "--config", "absent.toml"), "", "absent.toml"),
    (("bench-sweep", "--plant", "absent", "--out", "x.csv"), "", "absent"),
    (("fleet", "/nowhere"), "", "/nowhere: no such folder or file"),
    (("fleet", "nothing://there"), "", "Protocol not known: nothing"),
    (("fleet", "."), "", "no .mcap in it; `tormagctl record` makes them"),
    *(
        (("bound", "given", *more), FORCES + text, reason)
        for text, more, reason in (
            ("1,nan\n2,1\n", (), "row 3 lacks a value"),
            ("1,1\n1,1\n", (), "row 4, time_s = 1"),
            ("1,1\n1e4,1\n", (), "t_s = 0.0 .. 10000.0"),
            ("1,1\n2,1\n", ("--plant", "sample_9"), "sample_9"),
        )
    ),
    (("twin", "absent.mcap"), "", "absent.mcap: No such file"),
    (("twin", "given"), "no recording", "given: not an intact MCAP file"),
    (("twin", "given", "--prior", "sample_9"), "no recording", "sample_9"),
    (("identify-motor", "absent"), "", "absent: No such file"),
    (("identify-motor", "given"), "t_s,input_V\n0,1\n", "position_mm"),
    *(
        (("identify-motor", "given"), MOTOR + text, reason)
        for text, reason in (
            ("0,1,x\n", "row 2"),
            ("".join(f"{k * 1e-3},0,nan\n" for k in range(200)), "row 2 lacks one"),
            ("".join(f"{k * k * 1e-3},0,0\n" for k in range(200)), "steps by"),
            ("".join(f"{k * 0.1},0,0\n" for k in range(200)), "Hz"),
            ("".join(f"{k * 1e-3:.3f},0,5\n" for k in range(5000)), "moves too little"),
            ("0,1,2\n", "rows"),
        )
    ),
    *(
        ((*TRAIN, data, "--out", "m.safetensors", *more), text, reason)
        for data, text, more, reason in (
            ("given", ROWS + "0,0,nan,40,1\n", (), "row 2 lacks one"),
            ("absent", "", (), "absent: No such file"),
            ("given", GOOD, ("--out", "absent/m.safetensors"), "cannot write"),
            ("given", GOOD, ("--out", "."), "cannot write .: allowed is a file"),
            ("given", GOOD, ("--hidden", "0"), "hidden = 0"),
            ("given", GOOD, ("--epochs", "0"), "epochs = 0"),
            ("given", GOOD, ("--insert", "two words"), "insert"),
            ("given", GOOD, ("--validation-share", "1"), "validation_share"),
            ("given", GOOD, ("--law", "--insert", "MRE-50-40", "MRE-50-30"), "--law: allowed is --element torque"),
            ("given", GOOD, ("--law", "--element", "tactile"), "--law: allowed is --element torque"),
            ("given", GOOD, ("--law", "--insert", "MRE-99-99"), "MRE-99-99"),
            ("given", GOOD.replace(",5,", ",-5,"), ("--law",), "rate_mm_s = -5.0 is not allowed: magnitudes"),
            ("given", re.sub(r",1\d\d,", ",300,", GOOD), ("--law",), "field_mT = 300"),
        )
    ),
]


@pytest.mark.parametrize(("arguments", "given", "reason"), REFUSED)
def test_what_cannot_be_used_is_one_line_and_exit_2(arguments, given, reason, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if given:
        (tmp_path / "given").write_text(given)
    assert main(arguments) == 2
    told = capsys.readouterr()
    assert told.err.startswith(f"tormag-lab {arguments[0]}: ")
    assert reason in told.err
    assert (told.out, told.err.count("\n")) == ("", 1)
    assert [path.name for path in tmp_path.iterdir()] == ["given"] * bool(given)


DESIGN, SWEEP = ("optimise-design", "--region", "1", "1", "2", "2"), ("bench-sweep", "--out", "x.csv")


@pytest.mark.parametrize(
    ("arguments", "allowed"),
    [
        *(((*DESIGN, "--starts", text), "1..10000") for text in ("-1", "0", "1.5")),
        ((*DESIGN, "--starts", "x"), "'x': allowed is a finite number"),
        *(
            ((*one, "--seed", "-1"), "0..2147483648")
            for one in (DESIGN, SWEEP, (*TRAIN, "x", "--out", "m"), ("reproduce-thesis",))
        ),
        *(
            ((*one, "--workers", text), "1..1024")
            for one in (DESIGN, ("fleet", "."), ("reproduce-thesis",))
            for text in ("0", "99999")
        ),
        (("reproduce-thesis", "--gap-speed", "0"), "mm/s"),
    ],
)
def test_an_option_outside_its_range_is_refused_before_anything_runs(arguments, allowed, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        main(arguments)
    assert allowed in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_console_without_torch_has_the_light_commands():
    done = without_heavy(HELP, *LIGHT)
    assert done.returncode == 0, done.stderr


def test_without_torch_the_law_trains_and_a_network_is_refused_with_the_command_that_brings_it(tmp_path):
    rows, out = tmp_path / "rows.csv", tmp_path / "m.safetensors"
    rows.write_text(GOOD)
    refused = "tormag-lab train-model: torch is not installed: pip install 'tormag-lab[all]'\n"
    for more, ends in ((), (2, refused)), (("--law",), (0, "")):
        done = without_heavy(COMMAND, *TRAIN, str(rows), "--out", str(out), *more)
        assert (done.returncode, done.stderr) == ends
    assert "law_exponent" in load_model(out, element="torque", insert="MRE-50-40").metadata.metrics


def test_where_tormagd_stands_in_a_folder_of_its_own_packages_are_brought_there(monkeypatch, tmp_path):
    monkeypatch.setattr(errors, "__file__", str(tmp_path / "tormagd" / "tormag_lab" / "errors.py"))
    assert errors.not_installed("torch").endswith(
        f"sudo python3 -m pip install --target {tmp_path}/tormagd 'torch==2.13.0'"
    )


def test_every_command_that_is_named_exists():
    known = set(COMMANDS) | {"NAME"}
    for path in (*SOURCES, *PAGES):
        text = path.read_text(encoding="utf-8")
        assert set(re.findall(r"tormag-lab ([a-zA-Z][\w-]*)", text)) <= known, path
        scripts = set(re.findall(r"\btools/(\w+)\.py", text)) if path in SOURCES else set()
        assert all((ROOT / "tools" / f"{name}.py").exists() for name in scripts), path
