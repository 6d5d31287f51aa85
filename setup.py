"""Compiles the core where a compiler and Python's headers are.

mypyc compiles the very `.py` that people read. Where that cannot be, they run as they are, with the same results to the
bit and a tenth of the speed; `firmware_protocol/build.py` says which. With TORMAG_COMPILE=require, failure to compile
is an error; with TORMAG_COMPILE=skip, compiling is not tried.
"""

import json
import os
import shutil
import sys
import sysconfig
import zlib
from concurrent.futures import ThreadPoolExecutor
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

# the hot rooms, in the order data flows: whatever a setpoint, a tick or a plan runs, and the simulated device
COMPILED = {
    "firmware_protocol": ("value", "schema", "checksum", "layouts", "wire", "codec", "framing"),
    "tormagd/element/physics": ("friction", "relaxation"),
    "tormagd/element/model": ("displacement", "force_curve"),
    "tormagd/element/inverse": ("solution", "newton"),
    "tormagd/hardware": (
        *("serial_port", "streams", "link", "link_statistics", "measurement", "connection"),
    ),
    "tormagd/control/safety": ("operating_state",),
    "tormagd/control": (*("interpolation", "records", "nominal", "measure", "core"),),
    "tormagd/control/assembly": ("conditions",),
    "tormagd/record": ("stream",),
    "tormagd/simulation": (
        *("curve", "axis", "element", "second_element", "tactile_pad"),
        *("hand", "plant", "motion", "firmware", "device", "closed_loop", "ideal_actuator"),
    ),
    "tormagd/daemon": (
        *("rate_group", "beat", "source", "inbox", "peers", "verdict"),
        *("control_loop", "inference_loop", "black_box", "commands", "telemetry_loop", "answers"),
        *("endpoint", "daemon"),
    ),
}
WHOLE = [f"tormagd/control/{room}" for room in ("believe", "ask", "aim", "move")]
"Rooms of which every file is compiled, also one that is added."
SOURCES = [f"{folder}/{name}.py" for folder, names in COMPILED.items() for name in names]
SOURCES += [path.as_posix() for room in WHOLE for path in sorted(Path(room).glob("[!_]*.py"))]
GROUP = "firmware_protocol.core"
"One library of all modules, so that calls between them are calls between C functions."
RECORD = Path("firmware_protocol/core.json")
REQUIRE, SKIP, AUTO = "require", "skip", "auto"

wanted = os.environ.get("TORMAG_COMPILE", AUTO)
if wanted not in (REQUIRE, SKIP, AUTO):
    raise SystemExit(f"TORMAG_COMPILE = {wanted!r}: allowed are {REQUIRE}, {SKIP} and {AUTO}")


def missing() -> str:
    """Return what a compiled core lacks here."""
    if wanted == SKIP:
        return "TORMAG_COMPILE=skip"
    compiler = os.environ.get("CC", sysconfig.get_config_var("CC") or "cc").split()[0]
    if shutil.which(compiler) is None:
        return f"no C compiler ({compiler})"
    header = Path(sysconfig.get_path("include"), "Python.h")
    if not header.is_file():
        return f"no {header}, which is in python3-dev or python3-devel"
    return ""


class BuildCore(build_ext):
    """Compiles, or records why not."""

    def run(self) -> None:
        lacking = missing()
        self.extensions = []
        if not lacking:
            try:
                self._take(self._translated())
                super().run()
            except (Exception, SystemExit) as error:
                if wanted == REQUIRE:
                    raise
                self.extensions = []
                lacking = f"compiling failed ({str(error)[:200]})"
        elif wanted == REQUIRE:
            raise SystemExit(f"TORMAG_COMPILE=require: {lacking}")
        if lacking:
            print(f"the core stays interpreted: {lacking}", file=sys.stderr)
        self._record(lacking)

    def _take(self, extensions: list[Extension]) -> None:
        where = self.build_lib, self.build_temp, self.inplace, self.editable_mode
        self.distribution.ext_modules = extensions
        self.initialize_options()
        self.build_lib, self.build_temp, self.inplace, self.editable_mode = where
        self.finalize_options()

    def _translated(self) -> list[Extension]:
        from mypyc.build import mypycify

        # the core's types from the client are found there, wherever the client is installed
        os.environ["MYPYPATH"] = str(Path("client/src").resolve())
        Path(self.build_temp).mkdir(parents=True, exist_ok=True)
        # torch's types take longer to read than all else, and the core needs none of them
        settings = Path(self.build_temp, "mypy.ini")
        settings.write_text("[mypy]\n[mypy-torch.*]\nfollow_imports = skip\n")
        options = [f"--config-file={settings}", "--ignore-missing-imports", f"--cache-dir={self.build_temp}/mypy"]
        extensions = mypycify(
            [*options, *SOURCES],
            opt_level="1",
            debug_level="0",
            multi_file=True,
            group_name=GROUP,
            target_dir=self.build_temp,
        )
        for extension in extensions:
            # where mypyc puts the headers of all files
            extension.include_dirs.append(str(Path(self.build_temp, RECORD.parent)))
            # another compiler's warning must not stop the build, and both builds round alike only without fused
            # multiplications. Hidden: calls between the C files are direct, which makes a tick a tenth faster
            kept = [option for option in extension.extra_compile_args if option != "-Werror"]
            extension.extra_compile_args = [*kept, "-ffp-contract=off", "-fvisibility=hidden"]
        return extensions

    def build_extensions(self) -> None:
        """Compile the C files on every processor, where distutils takes one after the other; then link them."""
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for extension in self.extensions:
                extension.extra_objects = [pool.submit(self._object, c, extension) for c in extension.sources]
        for extension in self.extensions:
            extension.sources, extension.extra_objects = [], [made.result() for made in extension.extra_objects]
            extension.depends = extension.extra_objects
        self.parallel = True
        super().build_extensions()

    def _object(self, source: str, extension: Extension) -> str:
        [compiled] = self.compiler.compile(
            [source],
            output_dir=self.build_temp,
            include_dirs=extension.include_dirs,
            extra_postargs=extension.extra_compile_args,
        )
        return compiled

    def _record(self, lacking: str) -> None:
        # even without a build: an earlier one's modules beside the sources must not be imported
        sources = {source: zlib.crc32(Path(source).read_bytes()) for source in SOURCES}
        known = {"python": EXTENSION_SUFFIXES[0], "interpreted": lacking, "sources": sources}
        places = [RECORD] if self.inplace or self.editable_mode else []
        if not self.editable_mode:
            places.append(Path(self.build_lib, RECORD))
        for place in places:
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(json.dumps(known, indent=1) + "\n")


setup(
    cmdclass={"build_ext": BuildCore},
    # a stand-in: the extensions are known only once the sources have been translated
    ext_modules=[Extension(f"{GROUP}__mypyc", sources=[])],
)
