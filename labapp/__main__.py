"""``python -m labapp`` is the command ``labapp``."""

from __future__ import annotations

from labapp.cli import main

if __name__ == "__main__":
    main()
