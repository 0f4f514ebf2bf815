"""The frozen program's start: the command ``labapp``."""

import multiprocessing

if __name__ == "__main__":
    multiprocessing.freeze_support()  # a process that measures starts this program again
    from labapp.__main__ import main

    main()
