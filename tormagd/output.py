"""Lines on a standard stream that may be closed or full, or whose reader may have gone."""

import os
from typing import TextIO


def write_line(text: str, stream: TextIO | None) -> OSError | None:
    """Write `text` and a line end at once; what kept that from being done, or None.

    Nothing is written to None, which Python has for a descriptor that was closed when it started. A stream that failed
    takes everything from then on and drops it: what was done is done, whoever reads of it or not.
    """
    if stream is None:
        return None
    try:
        print(text, file=stream, flush=True)
    except OSError as error:
        # or the interpreter would try again at its end, complain, and change the exit code
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)
        return error
    return None
