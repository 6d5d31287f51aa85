"""Matplotlib with its own backend and settings, whatever a notebook or a `matplotlibrc` asks of other programs.

Whatever draws takes it from here, also the names of types.
"""

import os
from contextlib import chdir, nullcontext
from pathlib import Path

os.environ |= {"MPLBACKEND": "agg", "MATPLOTLIBRC": os.devnull}
# a file in the present folder goes before that
with chdir("/") if Path("matplotlibrc").exists() else nullcontext():
    from matplotlib import rcParams as rcParams
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
