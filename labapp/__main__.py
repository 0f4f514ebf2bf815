"""Entry point of ``python -m labapp``, which runs the command ``labapp``."""

from __future__ import annotations

from labapp.cli import main

if __name__ == "__main__":
    main()
