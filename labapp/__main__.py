"""Entry point of the command ``labapp`` and of ``python -m labapp``."""

from __future__ import annotations

import signal
import sys
from typing import NoReturn

INTERRUPTED = 130


def main() -> NoReturn:
    """Run the command line; Ctrl-C while its modules are loaded ends the program, too.

    Ctrl-C afterwards, when all is done, is ignored: Python would end by the signal while it frees
    its memory, for up to half a second.
    """
    try:
        from labapp import cli

        cli.main()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


if __name__ == "__main__":
    main()
